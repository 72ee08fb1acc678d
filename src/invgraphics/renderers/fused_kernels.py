"""Fused kernels of ray marching: one call finds, queries and composites the samples of fields that hand out parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from invgraphics import kernels
from invgraphics.core.fused import FusedLattice
from invgraphics.core.ngp import FusedNGP


def fused_kernel(operation: Literal["march", "render"], parts: FusedNGP | FusedLattice | None) -> Callable[..., Any] | None:
    """The fused kernel for a field's parameters; ``None`` where only the reference supports them."""
    if parts is None:
        return None
    lattices = isinstance(parts, FusedLattice)
    name = f"{'lattice' if lattices else 'ngp'}_{operation}"
    like = parts.geometry.lattices[0].features if lattices else parts.table
    return getattr(kernels, name) if kernels.compiled(name, like) else None
