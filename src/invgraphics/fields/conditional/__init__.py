"""Fields over a class of objects: networks whose layers depend on a code."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
