"""A sampler that remembers where the scene is empty (Instant-NGP, appendix E) and stops behind opaque surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Bounds, Context, Rays, Sampler, Samples, Scene, Trace
from invgraphics.core.field import Density
from invgraphics.kernels.types import MarchSteps
from invgraphics.renderers.samplers import uniform


@dataclass(frozen=True)
class OccupancyConfig:
    """Marching through an occupancy grid; the defaults are Instant-NGP's where nothing else is said.

    Attributes:
        resolution: cells along each edge of the unit cube.
        steps_per_diagonal: steps that a march across the bounds' diagonal takes.
        cone: growth of the step with distance; ``None`` means 0 in a box and 4 / ``steps_per_diagonal`` (Instant-NGP's
            1/256) in a contracted space.
        grace: training steps before the first refresh. What is thinner than the threshold before it was ever seen would be
            culled, never be sampled, and never grow.
        decay: what a cell's memory is multiplied with when the cell is looked at again.
        threshold: least optical depth of a step that counts as occupied; the grid's mean, where that is smaller.
        warmup: training steps during which a refresh looks at all cells.
        every: training steps between two refreshes.
        cells: cells that a refresh looks at after warm-up, half of them drawn from the occupied ones.
        stop: when to march in waves and leave out samples behind opaque surfaces, at the price of a density look-up.
        transmittance: a ray stops when less than this is left of its light.
        wave: samples per ray between two looks at the transmittance.
    """

    resolution: int = 128
    steps_per_diagonal: int = 1024
    cone: float | None = None
    grace: int = 0
    decay: float = 0.95
    threshold: float = 0.01
    warmup: int = 256
    every: int = 16
    cells: int = 1 << 17
    stop: Literal["always", "evaluation", "never"] = "always"
    transmittance: float = 1e-3
    wave: int = 32

    def __post_init__(self) -> None:
        for key in ("resolution", "steps_per_diagonal", "every", "cells", "wave"):
            if getattr(self, key) < 1:
                raise ValueError(f"{key} must be at least 1, not {getattr(self, key)}")
        if not 0 <= self.decay <= 1 or not 0 <= self.transmittance < 1:
            raise ValueError(f"decay must be in [0, 1] and transmittance in [0, 1), not {self.decay} and {self.transmittance}")
        if min(self.threshold, self.warmup, self.grace, self.cone or 0) < 0:
            raise ValueError("threshold, warmup, grace and cone must not be negative")

    def build(self, scene: Scene) -> Occupancy:
        """The sampler, every cell occupied."""
        return Occupancy(self, scene.bounds)


class Occupancy(Sampler):
    """Marches in fixed steps and keeps those in occupied cells.

    Attributes:
        ema: fading maximum of the optical depth that one step has in each cell.
        occupied: cells worth a sample.
        step: number of updates asked for so far.
    """

    ema: Float[Tensor, "r r r"]
    occupied: Bool[Tensor, "r r r"]
    step: Int[Tensor, ""]

    def __init__(self, config: OccupancyConfig, bounds: Bounds) -> None:
        super().__init__()
        self.config = config
        shape = (config.resolution,) * 3
        self.register_buffer("ema", torch.zeros(shape))
        self.register_buffer("occupied", torch.ones(shape, dtype=torch.bool))
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))
        growing = 4 / config.steps_per_diagonal if bounds.space == "contracted" else 0.0
        self.cone = growing if config.cone is None else config.cone
        self.length = 2 * bounds.radius / config.steps_per_diagonal

    def sample(self, rays: Rays, density: Density, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        """Samples in occupied cells, in front of what is opaque."""
        ray, t0, t1 = self._march(rays, density, ctx)
        return Samples.on(rays, ray, t0, t1), ()

    @torch.no_grad()
    def _march(self, rays: Rays, density: Density, ctx: Context) -> tuple[Tensor, Tensor, Tensor]:
        """March all rays in waves: intervals in an order sorted by ray, then distance."""
        stopping = self.config.stop == "always" or (self.config.stop == "evaluation" and not ctx.training)
        steps = MarchSteps(self.length, self.cone, self.config.wave) if stopping else MarchSteps(self.length, self.cone)
        start = rays.near.clone()
        if ctx.training:
            # The whole lattice of steps is shifted, so that over many visits every distance gets its turn.
            start += uniform((len(rays),), ctx, like=start) * (self.cone * start).clamp_min(self.length)
        optical_depth = torch.zeros_like(start)
        waves: list[tuple[Tensor, Tensor, Tensor]] = []
        marching = torch.nonzero(start < rays.far)[:, 0]
        while len(marching):
            march = kernels.ray_march(rays[marching], self.occupied, ctx.bounds, steps, start[marching])
            start[marching] = march.resume
            ray, t0, t1 = marching[march.ray], march.t0, march.t1
            going = march.resume < rays.far[marching]
            if stopping:
                tau = density(Samples.on(rays, ray, t0, t1)) * (t1 - t0)
                before, total = running_sums(tau, march.ray, len(marching), self.config.wave)
                reached = torch.exp(-(optical_depth[ray] + before)) >= self.config.transmittance
                ray, t0, t1 = ray[reached], t0[reached], t1[reached]
                optical_depth[marching] += total
                going &= torch.exp(-optical_depth[marching]) >= self.config.transmittance
            waves.append((ray, t0, t1))
            marching = marching[going]
        if not waves:
            return torch.zeros(0, dtype=torch.int64, device=start.device), start[:0], start[:0]
        ray, t0, t1 = (torch.cat(parts) for parts in zip(*waves, strict=True))
        order = torch.argsort(ray, stable=True)
        return ray[order], t0[order], t1[order]

    @torch.no_grad()
    def update(self, density: Density, ctx: Context) -> None:
        """Count a training step; every so often, look at cells again."""
        step = int(self.step)
        self.step += 1
        if step >= self.config.grace and step % self.config.every == 0:
            cells = self._all_cells() if step < self.config.warmup else self._some_cells(ctx)
            self._refresh(cells, density, ctx)

    def _all_cells(self) -> Int[Tensor, " k"]:
        return torch.arange(self.ema.numel(), device=self.ema.device)

    def _some_cells(self, ctx: Context) -> Int[Tensor, " k"]:
        """Flat cell indices: half uniform, half from the occupied cells; a cell can be drawn twice."""
        occupied = torch.nonzero(self.occupied.flatten())[:, 0]
        half = self.config.cells // 2
        anywhere = self._draw(self.ema.numel(), self.config.cells - half, ctx)
        return torch.cat([anywhere, occupied[self._draw(len(occupied), half, ctx)]]) if len(occupied) else anywhere

    def _draw(self, below: int, count: int, ctx: Context) -> Int[Tensor, " count"]:
        return torch.randint(below, (count,), generator=ctx.generator, device=self.ema.device)

    def _refresh(self, cells: Int[Tensor, " k"], density: Density, ctx: Context) -> None:
        """Look at one random point in each of ``cells`` and decide anew which cells are occupied."""
        fresh = torch.full_like(self.ema, -1.0).flatten()
        for part in cells.split(ctx.chunk):
            thickness = self._thickness(part, density, ctx).to(fresh.dtype)
            fresh.scatter_reduce_(0, part, thickness, reduce="amax")
        fresh = fresh.view_as(self.ema)
        self.ema.copy_(torch.where(fresh < 0, self.ema, torch.maximum(self.ema * self.config.decay, fresh)))
        # The mean of equal float32 numbers must not exceed them, or an even fog would vanish: sum in float64.
        mean = float(self.ema.mean(dtype=torch.float64))
        self.occupied.copy_(self.ema >= min(self.config.threshold, mean))

    def _thickness(self, cells: Int[Tensor, " k"], density: Density, ctx: Context) -> Float[Tensor, " k"]:
        """Optical depth of one step at a random point of each cell.

        Steps grow with the distance from the camera, which a cell does not know; the distance from the middle of the
        bounds stands in for it.
        """
        corner = torch.stack(torch.unravel_index(cells, self.ema.shape), dim=1)
        unit = (corner + uniform((len(cells), 3), ctx, like=self.ema)) / self.config.resolution
        position = ctx.bounds.from_unit(unit.to(ctx.bounds.lo.dtype))
        distance = (position - ctx.bounds.centre).norm(dim=1)
        return density(Samples.at(position)) * (self.cone * distance).clamp_min(self.length)


def running_sums(
    values: Float[Tensor, " m"], ray: Int[Tensor, " m"], rays: int, most: int
) -> tuple[Float[Tensor, " m"], Float[Tensor, " n"]]:
    """Per ray, the sum of the values in front of each sample, and the sum of all.

    Args:
        values: one per sample.
        ray: ray of each sample, non-decreasing.
        rays: number of rays.
        most: no ray has more samples than this.
    """
    counts = torch.bincount(ray, minlength=rays)
    nth = torch.arange(len(ray), device=ray.device) - (counts.cumsum(0) - counts)[ray]
    table = values.new_zeros(rays, most)
    table[ray, nth] = values
    sums = torch.nn.functional.pad(table.cumsum(dim=1), (1, 0))
    return sums[ray, nth], sums[:, -1]
