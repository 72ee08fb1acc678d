"""Hierarchical intervals, paired effects with Holm's correction, Pareto fronts and verdicts."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
