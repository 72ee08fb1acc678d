"""Pruning of sparse voxel grids by the weight that training rays give them (Plenoxels, Fridovich-Keil et al. 2022, §3.2)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import max_pool3d
from typing_extensions import Protocol, override, runtime_checkable

from invgraphics.core import Field, RayRenderer, Renderer, Trace, View
from invgraphics.core.lattice import LatticeEncoding, LatticeField
from invgraphics.errors import InputError
from invgraphics.training.hooks import FitState
from invgraphics.training.milestones import MilestoneHook, check_milestones
from invgraphics.training.penalties import LATTICES
from invgraphics.training.views.pixels import RandomPixels

RAYS_AT_ONCE = 1024
"""Rays that are traced at once: in fog each has hundreds of samples."""


@runtime_checkable
class Prunable(Protocol):
    """Protocol of sparse grids: how vertices are emptied. Their parameter is called ``rows``."""

    def keep(self, kept: Bool[Tensor, "x y z"]) -> Int[Tensor, " k"]:
        """Empty all vertices but those ``kept``; returns the old rows of those left."""
        ...


@dataclass(frozen=True)
class PruneConfig:
    """Emptying of voxels that no training ray sees with weight, at given points of the fit.

    Attributes:
        at: progress of each pruning, increasing. Where an up-sampling has the same progress, the hook that comes first in the
            recipe acts first (Plenoxels prunes while it resamples).
        weight: a vertex is kept that has a sample of this weight in one of its cells, times 1 / vertices along z (Plenoxels:
            0.256).
        dilation: vertices around it that are kept too (Plenoxels: 2).
        rays: random training rays that are traced (Plenoxels: all).
    """

    at: tuple[float, ...]
    weight: float = 0.256
    dilation: int = 2
    rays: int = 1 << 16

    def __post_init__(self) -> None:
        check_milestones(self.at)
        if self.weight < 0 or self.dilation < 0 or self.rays < 1:
            raise ValueError("'weight' and 'dilation' must not be negative, and 'rays' must be at least 1.")

    def build(self) -> Prune:
        """The hook."""
        return Prune(self)


class Prune(MilestoneHook):
    """Empties vertices of all sparse grids of a field at each milestone."""

    name = "prune"
    requires = LATTICES

    def __init__(self, config: PruneConfig) -> None:
        super().__init__(config.at)
        self._config = config

    @override
    def check_fit(self, field: Field, renderer: Renderer) -> None:
        if not _grids(field) or not isinstance(renderer, RayRenderer):
            raise InputError(f"The hook '{self.name}' needs sparse voxel grids and a renderer of rays.")

    @override
    def act(self, state: FitState, due: int) -> None:
        assert isinstance(state.renderer, RayRenderer)
        grids = _grids(state.field)
        bounds, sizes = cast(LatticeField, state.field).bounds, [cast(LatticeEncoding, grid).resolution for grid in grids]
        most = {size: torch.zeros(size, device=bounds.lo.device) for size in sizes}
        for position, weight in ray_weights(state, state.renderer, self._config.rays):
            unit = bounds.to_unit(position)
            for size, largest in most.items():
                torch.maximum(largest, heaviest(unit, weight, size), out=largest)
        for grid, size in zip(grids, sizes, strict=True):
            prune(state, grid, dilated(most[size] >= self._config.weight / size[2], self._config.dilation))


def _grids(field: Field) -> list[Prunable]:
    """Sparse grids of a field with lattices."""
    return [encoding for encoding in cast(LatticeField, field).lattice_encodings().values() if isinstance(encoding, Prunable)]


def trace_random_rays(state: FitState, renderer: RayRenderer, count: int) -> Iterator[Trace]:
    """Render ``count`` random training rays as evaluation does, an equal share per view; yields traces of some at a time.

    No ray goes through masked-out pixels: nothing is fitted to what it sees.
    """
    cameras = state.cameras()
    ctx = replace(state.ctx, training=False)
    share = -(-count // len(cameras))
    for camera, view in zip(cameras, state.scene.train, strict=True):
        pixels = _random_places(view, share, state.ctx.generator).to(camera.focal)
        for rays in camera.rays(pixels).to(ctx.bounds.lo.device).chunks(RAYS_AT_ONCE):
            _, trace = renderer.render_rays(state.field, rays, ctx)
            yield trace


def _random_places(view: View, count: int, generator: torch.Generator | None) -> Float[Tensor, "n 2"]:
    """Random image points (x, y) of a view, in pixels that its mask leaves."""
    place = torch.rand(count, 2, generator=generator) * torch.tensor([view.camera.width, view.camera.height])
    if view.mask is None:
        return place
    flat = RandomPixels(generator or torch.default_generator).draw(0, view, count)
    return view.camera.pixel_centres_of(flat) - 0.5 + place.frac()


@torch.no_grad()
def ray_weights(
    state: FitState, renderer: RayRenderer, count: int
) -> Iterator[tuple[Float[Tensor, "m 3"], Float[Tensor, " m"]]]:
    """Positions and weights of the samples on ``count`` random training rays, some rays at a time."""
    for trace in trace_random_rays(state, renderer, count):
        assert trace.samples is not None
        assert trace.weights is not None
        yield trace.samples.position, trace.weights


def heaviest(unit: Float[Tensor, "m 3"], weights: Float[Tensor, " m"], resolution: Sequence[int]) -> Float[Tensor, "x y z"]:
    """Largest weight of a sample in one of the cells around each vertex; samples outside the unit cube are ignored."""
    inside = ((unit >= 0) & (unit <= 1)).all(dim=1)
    unit, weights = unit[inside], weights[inside]
    cells = torch.tensor(resolution, device=unit.device) - 1
    x, y, z = torch.minimum((unit * cells).long(), cells - 1).unbind(dim=1)
    found = weights.new_zeros([size - 1 for size in resolution])
    found.view(-1).scatter_reduce_(0, (x * found.shape[1] + y) * found.shape[2] + z, weights, reduce="amax")
    return max_pool3d(found[None, None], 2, stride=1, padding=1)[0, 0]  # of up to eight cells around a vertex


def dilated(mask: Bool[Tensor, "x y z"], by: int) -> Bool[Tensor, "x y z"]:
    """The mask and all vertices within ``by`` of it along every axis."""
    return mask if by == 0 else max_pool3d(mask[None, None].float(), 2 * by + 1, stride=1, padding=by)[0, 0] > 0


def prune(state: FitState, grid: Prunable, kept: Bool[Tensor, "x y z"]) -> None:
    """Empty the vertices of a grid that are not ``kept``; the optimiser's moments of the others stay."""
    names = {id(parameter): f"field.{name}" for name, parameter in state.field.named_parameters()}
    module = cast(nn.Module, grid)
    name = names[id(module.get_parameter("rows"))]
    rows = grid.keep(kept)
    state.optimiser.reindex_rows(name, module.get_parameter("rows"), rows, 0)
