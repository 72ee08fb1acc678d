"""Lazy imports of submodules on first access: ``ig.core.transforms`` after ``import invgraphics as ig`` alone."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from types import ModuleType


def submodules(package: str) -> Callable[[str], ModuleType]:
    """Return a ``__getattr__`` for a package that imports its submodules on first use, as SciPy and scikit-image do (SPEC 1).

    Args:
        package: the package's ``__name__``.
    """

    def load(name: str) -> ModuleType:
        if name.startswith("_") or importlib.util.find_spec(f"{package}.{name}") is None:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return importlib.import_module(f"{package}.{name}")

    return load
