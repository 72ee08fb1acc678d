"""Penalties: frozen configs that are called with a field, a renderer and the context, and return a scalar beside the losses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core import Context, Field, Quantity, Renderer, Samples
from invgraphics.core.lattice import Lattice, LatticeField, Role
from invgraphics.errors import InputError
from invgraphics.training.checks import Requirement

Penalty = Callable[[Field, Renderer, Context], Tensor]
"""A term of the objective that depends on the model alone. Randomness comes from the context's generator."""

LATTICES = Requirement("encodings made of lattices", LatticeField)

CELLS = 256
"""Cells along the box's mean edge, per whose length differences are taken: independent of the resolution (Plenoxels, §3.4)."""
_ROOT_EPS = 1e-9


def check_penalty(penalty: Any, field: Field | type[Field]) -> None:
    """Refuse a field, or a class of fields, that lacks what a penalty ``requires``.

    Raises:
        InputError: names the penalty, what it needs, and the field.
    """
    requires = getattr(penalty, "requires", None)
    if isinstance(requires, Requirement):
        requires.check(f"penalty '{getattr(penalty, 'name', type(penalty).__name__)}'", field)


@dataclass(frozen=True)
class TotalVariationPenalty:
    """Differences between neighbouring vertices of lattices (Plenoxels, Fridovich-Keil et al. 2022, equation 3).

    Mean over vertices, summed over channels and over the role's lattices, of the length of the gradient of a channel: its
    differences along all axes, per 1/256 of the box's mean edge, so that resolutions and voxels of any proportions compare.

    Attributes:
        weight: factor (Plenoxels, synthetic scenes: 1e-5 for density, 1e-3 for harmonics).
        role: which lattices.
        norm: ``isotropic``: length of the gradient (Plenoxels); ``squared``: its square (TensoRF).
        fraction: share of the vertices that a step evaluates, contiguous in memory from a random one (Plenoxels: 0.01).
        until: progress at which it ends (Plenoxels: the first up-sampling).
    """

    name: ClassVar[str] = "total_variation"
    requires: ClassVar[Requirement] = LATTICES

    weight: float = 1e-5
    role: Role = "geometry"
    norm: Literal["isotropic", "squared"] = "isotropic"
    fraction: float = 1.0
    until: float = 1.0

    def __post_init__(self) -> None:
        if self.weight < 0 or not 0 < self.fraction <= 1:
            raise ValueError("'weight' must not be negative, and 'fraction' lies in (0, 1].")

    def __call__(self, field: Field, renderer: Renderer, ctx: Context) -> Float[Tensor, ""]:
        """The weighted total variation; 0 once it has ended."""
        total = ctx.bounds.lo.new_zeros(())
        if ctx.progress >= self.until:
            return total
        half = lattice_field(field, self.name).bounds.half
        for lattice in lattices_of(field, self.role, self.name):
            edges = torch.stack([half[column] for column in lattice.columns]) / half.prod().pow(1 / 3)
            total = total + total_variation(lattice, edges, self._vertices(lattice, ctx), self.norm)
        return self.weight * total

    def _vertices(self, lattice: Lattice, ctx: Context) -> Int[Tensor, " k"]:
        """Flat indices of the vertices that this step evaluates."""
        count, device = math.prod(lattice.resolution), lattice.features.device
        if self.fraction == 1:
            return torch.arange(count, device=device)
        start = int(torch.randint(count, (1,), generator=ctx.generator, device=_generator_device(ctx)))
        return (start + torch.arange(math.ceil(self.fraction * count), device=device)) % count


def total_variation(
    lattice: Lattice, edges: Float[Tensor, " d"], vertices: Int[Tensor, " k"], norm: Literal["isotropic", "squared"]
) -> Float[Tensor, ""]:
    """Mean over ``vertices``, summed over channels, of the length of the gradient, or of its square; see the penalty.

    A vertex at the upper end of an axis has no neighbour there, and no difference; empty vertices of a linked lattice are 0.

    Args:
        lattice: dense or linked.
        edges: of the box along the lattice's axes, in units of the mean edge.
        vertices: flat indices, in the order of memory.
        norm: as of the penalty.
    """
    size = torch.tensor(lattice.resolution, device=vertices.device)
    strides = size.flip(0).cumprod(0).flip(0) // size
    place = vertices[:, None] // strides % size
    neighbours = vertices[:, None] + torch.where(place + 1 < size, strides, 0)
    wanted = torch.cat([vertices[:, None], neighbours], dim=1).flatten()
    values = _values(lattice, wanted).unflatten(0, (len(vertices), -1))
    differences = (values[:, 1:] - values[:, :1]) * ((size - 1) / (CELLS * edges))[:, None]
    squared = differences.square().sum(dim=1)
    # The root is infinitely steep at 0, where all of a new grid is.
    lengths = squared if norm == "squared" else (squared + _ROOT_EPS).sqrt()
    return lengths.sum() / max(len(vertices), 1)


def _values(lattice: Lattice, vertices: Int[Tensor, " k"]) -> Float[Tensor, "k c"]:
    """Features at flat vertices. One gather, so that the backward pass makes one gradient of the lattice's size."""
    rows = lattice.rows
    if lattice.links is None:
        return rows.index_select(0, vertices)
    links = lattice.links.flatten()[vertices].long()
    linked = (links >= 0) & (links < len(rows))
    return rows.index_select(0, torch.where(linked, links, 0)) * linked[:, None]


@dataclass(frozen=True)
class L1Penalty:
    """Mean absolute feature of each lattice of a role, summed over them: empty space is the cheapest (TensoRF, equation 14).

    Attributes:
        weight: factor (TensoRF: 8e-5).
        later: factor from ``change`` on (TensoRF, after its first alpha mask: 4e-5); ``None`` for no change.
        change: progress of that.
        role: which lattices.
    """

    name: ClassVar[str] = "l1"
    requires: ClassVar[Requirement] = LATTICES

    weight: float = 8e-5
    later: float | None = None
    change: float = 1 / 15
    role: Role = "geometry"

    def __post_init__(self) -> None:
        if min(self.weight, self.later or 0.0) < 0:
            raise ValueError("'weight' and 'later' must not be negative.")

    def __call__(self, field: Field, renderer: Renderer, ctx: Context) -> Float[Tensor, ""]:
        """The weighted sum of means."""
        weight = self.later if self.later is not None and ctx.progress >= self.change else self.weight
        return weight * torch.stack([x.features.abs().mean() for x in lattices_of(field, self.role, self.name)]).sum()


@dataclass(frozen=True)
class SparsityPenalty:
    """Cauchy penalty log(1 + 2 σ²) on the density (Plenoxels, equation 4; Hedman et al. 2021), against fog.

    The mean over random points of the scene's box or, in endless space, of the contracted ball, where Plenoxels sums over the
    samples of a step's rays: a mean over points needs no rays and does not depend on how many are taken. σ is per local length
    unit.

    Attributes:
        weight: factor.
        points: number of random points a step.
    """

    name: ClassVar[str] = "sparsity"
    requires: ClassVar[Requirement] = Requirement("a density", quantities=Quantity.DENSITY)

    weight: float = 1e-4
    points: int = 4096

    def __post_init__(self) -> None:
        if self.weight < 0 or self.points < 1:
            raise ValueError("'weight' must not be negative, and 'points' must be at least 1.")

    def __call__(self, field: Field, renderer: Renderer, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean."""
        position = ctx.bounds.from_unit(_even_in(ctx, self.points))
        density = field.query(Samples.at(position), Quantity.DENSITY).density
        assert density is not None
        return self.weight * torch.log1p(2 * density.square()).mean()


def _even_in(ctx: Context, count: int) -> Float[Tensor, "n 3"]:
    """Random points of the unit cube, even in what the bounds describe: all of it, or the contracted ball in it."""
    unit = ctx.rand((count, 3), like=ctx.bounds.lo)
    if ctx.bounds.space == "box":
        return unit
    height, turn = 2 * unit[:, 0] - 1, 2 * math.pi * unit[:, 1]
    across = (1 - height.square()).clamp_min(0).sqrt()
    direction = torch.stack([across * turn.cos(), across * turn.sin(), height], dim=1)
    return 0.5 + 0.5 * unit[:, 2:].pow(1 / 3) * direction


def lattice_field(field: Field, name: str) -> LatticeField:
    """The field as one with lattices.

    Raises:
        InputError: it has none; the sentence names the penalty.
    """
    LATTICES.check(f"penalty '{name}'", field)
    assert isinstance(field, LatticeField)
    return field


def lattices_of(field: Field, role: Role, name: str) -> tuple[Lattice, ...]:
    """Lattices of a role, at least one.

    Raises:
        InputError: the field has none; the sentence names the penalty.
    """
    encodings = lattice_field(field, name).lattice_encodings()
    if role not in encodings:
        known = ", ".join(encodings) or "none: its encodings are no grids, factors or planes"
        raise InputError(
            f"The penalty '{name}' needs lattices for {role}, which this field does not have.", f"It has: {known}."
        )
    return encodings[role].lattices()


def _generator_device(ctx: Context) -> torch.device:
    return ctx.bounds.lo.device if ctx.generator is None else ctx.generator.device
