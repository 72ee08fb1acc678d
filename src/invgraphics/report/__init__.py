"""Reports from run folders: statistics, tables, figures and pages; reads stored results only."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
