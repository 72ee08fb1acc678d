"""Parts that scripts, notebooks and modules register in their own process."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError, did_you_mean
from invgraphics.plugins.entry_points import foreign
from invgraphics.plugins.registries import BY_CLASS, REGISTRIES, is_built_in

MODULES = "INVGRAPHICS_MODULES"
"""Environment variable: modules, with commas between them, that are imported because they `register` parts."""
SCRIPT = "__main__"
"""Module of scripts and notebooks, which other processes cannot import."""
ANONYMOUS = "a script or notebook"
"""Stands for their name in records."""


@dataclass(frozen=True)
class Registered:
    """A part that a module has registered.

    Attributes:
        part: the class, or what else the registry holds.
        module: that has registered it.
    """

    part: Any
    module: str

    @property
    def target(self) -> str:
        """Module and name of the part, as of an entry point."""
        return f"{self.module}:{getattr(self.part, '__qualname__', type(self.part).__name__)}"


_REGISTERED: dict[tuple[str, str], Registered] = {}
"""(registry, name) -> part."""


def register(registry: str, name: str, part: Any = None) -> Any:
    """Register a part under a name in this process, by which recipes find it; decorates a class, or takes what it is given.

    Again from the same module, as when a notebook's cell runs again, it replaces the part. Other processes, as those of
    `compare`, find parts of modules that they can import; those of a script or notebook are for `fit`.

    Args:
        registry: ``fields``, ``encodings``, ``renderers``, ``samplers``, ``losses``, ``penalties``, ``hooks``, ``metrics``,
            ``scenes`` (loaders), ``formats``, ``exporters``, ``executors``; or ``recipes``: TOML, called ``renderer/name``.
        name: by which it is found.
        part: what is registered; ``None`` to decorate a class.

    Returns:
        The part; or the decorator.

    Raises:
        InputError: no such registry, or the name or the class is taken.
    """
    module = str(sys._getframe(1).f_globals.get("__name__", SCRIPT))
    if registry not in REGISTRIES:
        raise InputError(
            f"There is no registry '{registry}'.{did_you_mean(registry, REGISTRIES)}", f"Known: {', '.join(REGISTRIES)}."
        )
    return partial(_register, registry, name, module) if part is None else _register(registry, name, module, part)


def _register(registry: str, name: str, module: str, part: Any) -> Any:
    known, expected = _REGISTERED.get((registry, name)), "Choose another name."
    if is_built_in(registry, name) or name in foreign(registry) or (known is not None and known.module != module):
        raise InputError(f"'{name}' of the {registry} is taken.", expected)
    for (kind, other), one in _REGISTERED.items():
        if kind == registry in BY_CLASS and other != name and one.part is part:
            raise InputError(f"{part.__name__} is registered as '{other}' already, by which runs name it.", "Use that name.")
    _REGISTERED[registry, name] = Registered(part, module)
    return part


def registered() -> dict[tuple[str, str], Registered]:
    """All registered parts, those of the modules in the environment included."""
    _import_modules(os.environ.get(MODULES, ""))
    return _REGISTERED


@cache
def _import_modules(modules: str) -> None:
    for module in filter(None, (word.strip() for word in modules.split(","))):
        try:
            importlib.import_module(module)
        except Exception as error:  # it may raise anything
            remedy = (
                "`python -m invgraphics` finds modules of the current folder, `invgraphics` those in folders of PYTHONPATH."
            )
            sentence = f"The module '{module}', which ${MODULES} names, cannot be imported: {error!r}."
            raise InputError(sentence, remedy if isinstance(error, ModuleNotFoundError) else "") from error


def environment() -> dict[str, str]:
    """Environment variables by which another process finds the parts that modules have registered here."""
    modules = sorted({one.module for one in registered().values()} - {SCRIPT})
    paths = os.pathsep.join(dict.fromkeys(str(Path(path).absolute()) for path in sys.path))
    return {MODULES: ",".join(modules), "PYTHONPATH": paths} if modules else {}


def check_importable(table: Mapping[str, Any], method: str = "") -> None:
    """Check that other processes can import all parts of a recipe.

    Args:
        table: a resolved recipe.
        method: its name.

    Raises:
        InputError: a part is registered in a script or notebook.
    """
    used = names_in(table, method)
    for (registry, name), one in registered().items():
        if name in used and one.module == SCRIPT:
            sentence = (
                f"'{name}' of the {registry} is registered in this script or notebook, and each fit has a process of its own."
            )
            raise InputError(sentence, "Define it in a module that can be imported, or fit the method alone by ig.fit.")


def of_module(one: Registered) -> str:
    """Where a part was registered, in words."""
    return ANONYMOUS if one.module == SCRIPT else f"module {one.module}"


def names_in(table: Mapping[str, Any], method: str) -> set[str]:
    """All ``type`` entries of a recipe, and its own name, without the changes that may follow it."""
    used = {method, method.partition(":")[0]}
    waiting: list[Any] = [table]
    while waiting:
        part = waiting.pop()
        if isinstance(part, Mapping):
            used |= {part["type"]} if isinstance(part.get("type"), str) else set()
            waiting += part.values()
        elif isinstance(part, list | tuple):
            waiting += part
    return used
