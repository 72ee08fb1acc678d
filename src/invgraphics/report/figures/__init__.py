"""Figures of a report: interval plots, heat maps, curves, Pareto fronts, ray diagrams and image maps."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
