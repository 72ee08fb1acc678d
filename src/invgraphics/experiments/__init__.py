"""From a request to a run folder, and from many runs to a comparison."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
