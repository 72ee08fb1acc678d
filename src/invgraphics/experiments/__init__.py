"""Fitting, evaluating and comparing methods: requests become run folders, and runs a comparison."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
