"""Run folders in, tables, figures and pages out. Reads files only."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
