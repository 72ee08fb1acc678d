"""Occupancy-grid sampler with empty-space skipping (Instant-NGP, appendix E) and early ray termination."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from typing_extensions import override

from invgraphics import kernels
from invgraphics.core import Bounds, Context, Field, Quantity, Rays, Sampler, Samples, Scene, Trace
from invgraphics.kernels.reference.march import step_lengths
from invgraphics.kernels.types import March, MarchSteps
from invgraphics.renderers.fused_kernels import fused_kernel
from invgraphics.renderers.samplers import check_samples
from invgraphics.renderers.termination import joined, visible_samples
from invgraphics.renderers.visibility import cells_near_points, flat_cells, visible_cells

Cells = Bool[Tensor, "r r r"]
LATE_STEPS_START = 0.5
"""Progress of a fit at which its late steps begin to replace the usual ones."""


@dataclass(frozen=True)
class OccupancyConfig:
    """Settings of occupancy-grid ray marching, after Instant-NGP, where all cells decay at every refresh.

    Attributes:
        resolution: cells along each edge of the unit cube.
        steps_per_diagonal: steps that a march across the bounds' diagonal takes.
        evaluation_steps: the same outside training; ``None`` takes as many. In training the steps are shifted at random, so
            that a field fitted with long ones is sharper when it is seen with short ones.
        early_steps: the same at the start of training; moves to ``steps_per_diagonal`` over the fit's first quarter. Early
            on, density is diffuse: fewer, longer steps suffice and leave time for more rays. ``None``: no change.
        late_steps: the same at the end of training; the number moves there over the second half of the fit. Shorter steps
            resolve thin structures, once these are all that is left to be learned. ``None``: no change.
        cone: growth of the step with distance; ``None`` means 0 in a box and steps of equal contracted length in a contracted
            space, where Instant-NGP's is 1/256.
        grace: training steps before the first refresh. Cells below the threshold before they were ever trained
            would be culled and never recover.
        decay: factor of a cell's EMA at each of its updates (nerfacc: ``ema_decay``).
        early_decay: the same at the start; its distance from 1 falls to that of ``decay`` by half of the fit. Early fog
            must be forgotten quickly, but random points seldom hit a thin structure. ``None``: ``decay`` throughout.
        threshold: least optical depth of a step that counts as occupied; the grid's mean, where that is smaller.
        warmup: training steps after ``grace`` in which a refresh updates all cells: those never updated count as empty.
        every: training steps between two refreshes.
        points_until: progress of a fit until which only cells within ``point_cells`` cells of one of the scene's points, where
            it has some, are sampled: a start from points for fields without primitives.
        cells: cells updated per refresh after warm-up, half of them drawn from the occupied ones (Instant-NGP: 2^20).
        stop: when to leave out samples behind opaque surfaces, at the cost of a density query.
        transmittance: a ray stops when less than this is left of its light.
        chunk: samples per ray before the transmittance is tested first; each later chunk is half as long again. A GPU has one.
    """

    resolution: int = 128
    steps_per_diagonal: int = 1024
    evaluation_steps: int | None = None
    early_steps: int | None = None
    late_steps: int | None = None
    cone: float | None = None
    grace: int = 0
    decay: float = 0.95
    early_decay: float | None = None
    threshold: float = 0.01
    warmup: int = 256
    every: int = 16
    points_until: float = 0.0
    point_cells: int = 3
    cells: int = 1 << 17
    stop: Literal["always", "evaluation", "never"] = "always"
    transmittance: float = 1e-3
    chunk: int = 16

    def __post_init__(self) -> None:
        for key in ("resolution", "every", "cells", "point_cells"):
            if getattr(self, key) < 1:
                raise ValueError(f"{key} must be at least 1, not {getattr(self, key)}")
        for key in ("steps_per_diagonal", "evaluation_steps", "early_steps", "late_steps", "chunk"):
            if getattr(self, key) is not None:
                check_samples(**{key: getattr(self, key)})
        if not 0 <= (0.5 if self.early_decay is None else self.early_decay) < 1:
            raise ValueError(f"early_decay must be in [0, 1), not {self.early_decay}")
        if not 0 <= self.decay <= 1 or not 0 <= self.transmittance < 1:
            raise ValueError(f"decay must be in [0, 1] and transmittance in [0, 1), not {self.decay} and {self.transmittance}")
        if not 0 <= self.points_until <= 1:
            raise ValueError(f"points_until must be in [0, 1], not {self.points_until}")
        if min(self.threshold, self.warmup, self.grace, self.cone or 0) < 0:
            raise ValueError("threshold, warmup, grace and cone must not be negative")

    @property
    def samples_per_ray(self) -> int:
        """Samples on each ray before any cell is known to be empty, at least."""
        return self.chunk

    @property
    def state_bytes(self) -> int:
        """Memory of the grid and of a refresh: the EMA and its successor, bits, and indices of all cells; later, of some."""
        return 17 * self.resolution**3 + 32 * self.cells

    def decay_at(self, progress: float) -> float:
        """Decay of the occupancy EMA at a progress of the fit in [0, 1]."""
        if self.early_decay is None:
            return self.decay
        share = min(1.0, 2 * progress)
        return 1 - (1 - self.early_decay) ** (1 - share) * (1 - self.decay) ** share

    def steps_at(self, progress: float) -> float:
        """Number of march steps across the bounds' diagonal in training, at a progress of the fit in [0, 1]."""
        usual = self.steps_per_diagonal
        early, late = self.early_steps or usual, self.late_steps or usual
        share = max(0.0, (progress - LATE_STEPS_START) / (1 - LATE_STEPS_START))
        return early * (usual / early) ** min(1.0, 4 * progress) * (late / usual) ** share

    def build(self, scene: Scene) -> OccupancyGridSampler:
        """Build the sampler with every cell occupied, in unbounded space only cells visible in a training view."""
        cameras = [view.camera for view in scene.train] if scene.bounds.space == "contracted" else []
        visible = visible_cells(scene.bounds, self.resolution, cameras) if cameras else None
        points = scene.points.position if scene.points is not None and self.points_until > 0 else None
        near = None if points is None else cells_near_points(scene.bounds, self.resolution, points, self.point_cells)
        return OccupancyGridSampler(self, scene.bounds, visible, near)


class OccupancyGridSampler(Sampler):
    """Ray marcher in fixed steps, which keeps samples in occupied cells.

    Attributes:
        ema: decaying maximum of the optical depth of one step in each cell.
        occupied: cells that are sampled.
        visible: cells that may be occupied; ``None`` for all. Not part of the state: it follows from the scene.
        near_points: those that may be occupied early in a fit, likewise.
        step: number of calls of `update` so far.
    """

    ema: Float[Tensor, "r r r"]
    occupied: Cells
    visible: Cells | None
    near_points: Cells | None
    step: Int[Tensor, ""]

    def __init__(
        self, config: OccupancyConfig, bounds: Bounds, visible: Cells | None = None, near_points: Cells | None = None
    ) -> None:
        super().__init__()
        self.config = config
        shape = (config.resolution,) * 3
        self.register_buffer("ema", torch.zeros(shape))
        self.register_buffer("occupied", torch.ones(shape, dtype=torch.bool) if visible is None else visible.clone())
        self.register_buffer("visible", visible, persistent=False)
        self.register_buffer("near_points", near_points, persistent=False)
        self._restrict_occupied(near_points)
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))
        self.contracted = bounds.space == "contracted" and config.cone is None
        self.cone = config.cone or 0.0
        self.length = 2 * bounds.radius / config.steps_per_diagonal

    @override
    def untrained(self) -> OccupancyGridSampler:
        """Copy of the sampler with every visible cell occupied, as before training."""
        fresh = copy.deepcopy(self)
        fresh.ema.zero_()
        fresh.step.zero_()
        fresh.occupied.fill_(True)
        fresh._restrict_occupied(fresh.visible)
        return fresh

    def sample(self, rays: Rays, field: Field, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        """Sample occupied cells in front of opaque surfaces; returns densities too, where the field was queried."""
        if self.config.stop == "never" or (self.config.stop == "evaluation" and ctx.training):
            march = self._march(rays, ctx)
            return Samples.on(rays, march.ray, march.t0, march.t1), ()
        want = Quantity.DENSITY
        if torch.is_grad_enabled():
            march = self._march_fused(rays, field, ctx)
            if march is not None:
                return Samples.on(rays, march.ray, march.t0, march.t1), ()
        else:
            # Features are of use to the renderer only where it needs no gradients through them.
            want |= field.provides & Quantity.FEATURES
        query = partial(field.query_no_grad, want=want)
        chunk = self.config.chunk if rays.origins.device.type == "cpu" else None
        return visible_samples(rays, self._march(rays, ctx), query, self.config.transmittance, chunk), ()

    @torch.no_grad()
    def _march_fused(self, rays: Rays, field: Field, ctx: Context) -> March | None:
        """March with early termination by a fused kernel, where it supports the field and these steps; else ``None``."""
        parts, steps = field.fused(ctx.bounds), self.steps(ctx)
        even = ctx.bounds.space == "box" or steps.contracted
        march = fused_kernel("march", parts) if even and steps.cone == 0 else None
        if march is None:
            return None
        start = self._start(rays, steps, ctx)
        return march(rays, self.occupied, ctx.bounds, steps, parts, start, self.config.transmittance)

    @override
    @torch.no_grad()
    def composite_fused(
        self, rays: Rays, width: int, field: Field, ctx: Context, max_error: float
    ) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]] | None:
        """See `Sampler.composite_fused`; there are kernels for fields over a hash grid or over lattices (`Field.fused`)."""
        parts = field.fused(ctx.bounds)
        render = None if self.config.stop == "never" else fused_kernel("render", parts)
        if render is None:
            return None
        limits = self.config.transmittance, max_error
        return render(rays, self.occupied, ctx.bounds, self.steps(ctx), parts, *limits, width)

    def steps(self, ctx: Context) -> MarchSteps:
        """Current step lengths of the march."""
        usual = self.config.steps_per_diagonal
        now = self.config.steps_at(ctx.progress) if ctx.training else self.config.evaluation_steps or usual
        return MarchSteps(self.length * usual / now, self.cone * usual / now, contracted=self.contracted)

    def _start(self, rays: Rays, steps: MarchSteps, ctx: Context) -> Float[Tensor, " n"]:
        """Start distances of rays; in training each ray's lattice of steps is jittered as a whole."""
        if not ctx.training:
            return rays.near
        return rays.near + ctx.rand((len(rays),), like=rays.near) * step_lengths(rays, rays.near, ctx.bounds, steps)

    @torch.no_grad()
    def _march(self, rays: Rays, ctx: Context) -> March:
        """March all rays to their ends; returns the intervals in occupied cells."""
        steps = self.steps(ctx)
        march = kernels.ray_march(rays, self.occupied, ctx.bounds, steps, self._start(rays, steps, ctx))
        parts, going = [march], torch.nonzero(march.resume < rays.far)[:, 0]
        start = march.resume[going]
        while len(going):
            part = kernels.ray_march(rays[going], self.occupied, ctx.bounds, steps, start)
            parts.append(replace(part, ray=going[part.ray]))
            unfinished = part.resume < rays.far[going]
            going, start = going[unfinished], part.resume[unfinished]
        return parts[0] if len(parts) == 1 else joined(parts)

    @torch.no_grad()
    def update(self, field: Field, ctx: Context) -> None:
        """Count a training step, and refresh the occupancy grid every `OccupancyConfig.every` steps after ``grace``."""
        step = int(self.step)
        self.step += 1
        if step == 0:
            self._restrict_occupied(field.support(ctx.bounds, self.config.resolution))
        if step >= self.config.grace and step % self.config.every == 0:
            everywhere = step < self.config.grace + max(self.config.warmup, self.config.every)
            self._refresh(flat_cells(self.visible, self.ema) if everywhere else self._sampled_cells(ctx), field, ctx)

    def _sampled_cells(self, ctx: Context) -> Int[Tensor, " k"]:
        """Draw flat cell indices with replacement: half from all visible cells, half from occupied ones."""
        occupied, visible = torch.nonzero(self.occupied.flatten())[:, 0], flat_cells(self.visible, self.ema)
        half = self.config.cells // 2
        anywhere = visible[self._draw(len(visible), self.config.cells - half, ctx)]
        return torch.cat([anywhere, occupied[self._draw(len(occupied), half, ctx)]]) if len(occupied) else anywhere

    def _draw(self, below: int, count: int, ctx: Context) -> Int[Tensor, " count"]:
        device = self.ema.device if ctx.generator is None else ctx.generator.device
        return torch.randint(below, (count,), generator=ctx.generator, device=device).to(self.ema.device)

    def _refresh(self, cells: Int[Tensor, " k"], field: Field, ctx: Context) -> None:
        """Update the EMA at one random point in each of ``cells``, and threshold it to the occupancy grid."""
        fresh = torch.full_like(self.ema, -1.0).flatten()
        support = field.support(ctx.bounds, self.config.resolution)
        if support is not None:
            known = support.flatten()[cells]
            fresh[cells[~known]], cells = 0.0, cells[known]
        for part in cells.split(ctx.chunk):
            thickness = self._step_optical_depth(part, field, ctx).to(fresh.dtype)
            fresh.scatter_reduce_(0, part, thickness, reduce="amax")
        fresh, decay = fresh.view_as(self.ema), self.config.decay_at(ctx.progress)
        self.ema.copy_(torch.where(fresh < 0, self.ema, torch.maximum(self.ema * decay, fresh)))
        # The mean of equal float32 numbers must not exceed them, or an even fog would vanish: sum in float64.
        mean = float((self.ema if self.visible is None else self.ema[self.visible]).mean(dtype=torch.float64))
        self.occupied.copy_(self.ema >= min(self.config.threshold, mean))
        self._restrict_occupied(self.visible)
        self._restrict_occupied(support)
        if ctx.progress < self.config.points_until:
            self._restrict_occupied(self.near_points)

    def _restrict_occupied(self, mask: Cells | None) -> None:
        """Clear occupied cells outside ``mask``; no change if it is ``None``."""
        if mask is not None:
            self.occupied &= mask

    def _step_optical_depth(self, cells: Int[Tensor, " k"], field: Field, ctx: Context) -> Float[Tensor, " k"]:
        """Optical depth of one step at a random point of each cell.

        Steps of equal contracted length are taken along the radius. With a cone they grow with the distance from the camera,
        which is not known here; the distance from the centre of the bounds replaces it. Steps that become shorter late in a
        fit do not count as lower optical depth.
        """
        corner = torch.stack(torch.unravel_index(cells, self.ema.shape), dim=1)
        unit = (corner + ctx.rand((len(cells), 3), like=self.ema)) / self.config.resolution
        position = ctx.bounds.from_unit(unit.to(ctx.bounds.lo.dtype))
        steps = self.steps(replace(ctx, progress=min(ctx.progress, LATE_STEPS_START)))
        if steps.contracted:
            return field.density_no_grad(Samples.at(position)) * steps.step / ctx.bounds.radial_scale(position)
        distance = (position - ctx.bounds.centre).norm(dim=1)
        return field.density_no_grad(Samples.at(position)) * (steps.cone * distance).clamp_min(steps.step)
