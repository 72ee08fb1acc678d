"""Growth and pruning of neural point clouds (Point-NeRF, Xu et al. 2022, §4.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Context, Field, RayRenderer, Renderer
from invgraphics.errors import InputError
from invgraphics.kernels.near import near_points
from invgraphics.renderers.quadrature import heaviest_of_rays
from invgraphics.training.checks import Requirement
from invgraphics.training.hooks import FitState
from invgraphics.training.milestones import MilestoneHook, check_milestones
from invgraphics.training.prune import trace_random_rays
from invgraphics.training.rows import replace_rows

NEIGHBOURS = 4
"""Points whose means a new one starts with."""


class PointParameters(Protocol):
    """The part of a field of n points that `PointControl` edits; parameters are stored before activation."""

    positions: Float[Tensor, "n 3"]
    features: Float[Tensor, "n f"]
    raw_rgb: Float[Tensor, "n 3"]
    confidence_logits: Float[Tensor, " n"]
    radius: Float[Tensor, ""]

    def replace(self, tensors: dict[str, Tensor]) -> None:
        """Replace all points by new ones, of any number."""
        ...


POINTS = Requirement("points with confidences", PointParameters)
"""For hooks and penalties that need neural points."""


@dataclass(frozen=True)
class PointControlConfig:
    """Rounds of pruning, then growing, at given points of the fit.

    Attributes:
        at: progress of each round, increasing.
        prune_confidence: points of less confidence are removed (Point-NeRF: 0.1).
        rays: random training rays that are probed in a round (Point-NeRF: all).
        opacity: a ray's strongest sample can become a point if it weighs at least this.
        distance: and if it is at least this far from every point, in radii of the neighbour search.
        max_growth: most new points of a round, as a share of those before it; those of the largest weight are taken.
        max_primitives: cap on the number of points.
    """

    at: tuple[float, ...]
    prune_confidence: float = 0.1
    rays: int = 1 << 14
    opacity: float = 0.3
    distance: float = 0.35
    max_growth: float = 0.2
    max_primitives: int = 1_000_000

    def __post_init__(self) -> None:
        check_milestones(self.at)
        if not (0 <= self.prune_confidence < 1 and 0 <= self.opacity <= 1 and self.distance > 0 and self.max_growth >= 0):
            raise ValueError("'prune_confidence' and 'opacity' must be in [0, 1], 'distance' above 0, 'max_growth' at least 0.")
        if self.rays < 1 or self.max_primitives < 1:
            raise ValueError("'rays' and 'max_primitives' must be at least 1.")

    def capped(self, most: int) -> PointControlConfig:
        """The same, growing to at most ``most`` points."""
        return replace(self, max_primitives=most)

    def build(self) -> PointControl:
        """The hook."""
        return PointControl(self)


class PointControl(MilestoneHook):
    """Removes points of low confidence, and adds points where rays are stopped far from any."""

    name = "point_control"
    requires = POINTS

    def __init__(self, config: PointControlConfig) -> None:
        super().__init__(config.at)
        self._config = config

    @override
    def check_fit(self, field: Field, renderer: Renderer) -> None:
        if not isinstance(renderer, RayRenderer):
            raise InputError(f"The hook '{self.name}' needs a renderer of rays.")

    @override
    @torch.no_grad()
    def act(self, state: FitState, due: int) -> None:
        assert isinstance(state.renderer, RayRenderer)
        config, field = self._config, cast(PointParameters, state.field)
        keep = field.confidence_logits.sigmoid() >= config.prune_confidence
        if not bool(keep.any()):
            keep[field.confidence_logits.argmax()] = True  # an empty field could never grow again
        position, weight = strongest_samples(state, state.renderer, config.rays)
        new = self._to_add(field, position, weight, keep)
        rows = keep.nonzero()[:, 0]
        index, squared = near_points(new, field.positions, NEIGHBOURS, float(field.radius))
        old = {name: getattr(field, name).detach() for name in ("features", "raw_rgb", "confidence_logits")}
        tensors = {name: torch.cat([values[rows], _mean_of(values, index, squared)]) for name, values in old.items()}
        replace_rows(state, {"positions": torch.cat([field.positions[rows], new]), **tensors}, rows, len(new))

    def _to_add(
        self, field: PointParameters, position: Float[Tensor, "k 3"], weight: Float[Tensor, " k"], keep: Bool[Tensor, " n"]
    ) -> Float[Tensor, "c 3"]:
        """Positions of new points: strong samples far from every point, at most one in a cell of that distance."""
        config = self._config
        apart = config.distance * float(field.radius)
        position = position[weight >= config.opacity]
        weight = weight[weight >= config.opacity]
        alone = near_points(position, field.positions, 1, apart)[0][:, 0] < 0
        order = weight[alone].argsort(descending=True, stable=True)
        position = position[alone][order]
        room = min(int(config.max_growth * len(keep)), config.max_primitives - int(keep.sum()))
        return position[_first_of_each(position.div(apart).floor().long())][: max(room, 0)]


@torch.no_grad()
def strongest_samples(state: FitState, renderer: RayRenderer, count: int) -> tuple[Float[Tensor, "k 3"], Float[Tensor, " k"]]:
    """Position and weight of the heaviest sample of ``count`` random training rays, as far as they have samples."""
    positions, weights = [], []
    for trace in trace_random_rays(state, renderer, count):
        assert trace.samples is not None
        assert trace.weights is not None
        strongest = heaviest_of_rays(trace.weights, trace.samples.ray, trace.rays)
        positions.append(trace.samples.position[strongest])
        weights.append(trace.weights[strongest])
    return torch.cat(positions), torch.cat(weights)


def _first_of_each(cell: Int[Tensor, "k 3"]) -> Int[Tensor, " c"]:
    """Indices of the first row of each value, ascending."""
    _, group = torch.unique(cell, dim=0, return_inverse=True)
    first = torch.full((int(group.max()) + 1 if len(group) else 0,), len(cell), device=cell.device)
    first = first.scatter_reduce(0, group, torch.arange(len(cell), device=cell.device), reduce="amin")
    return first.sort().values


def _mean_of(values: Tensor, index: Int[Tensor, "c k"], squared: Float[Tensor, "c k"]) -> Tensor:
    """Means of the neighbours' rows with weights of inverse distance."""
    weight = torch.where(index >= 0, squared.clamp_min(1e-12).rsqrt(), 0.0)
    weight = weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-12)
    return torch.einsum("ck,ck...->c...", weight, values[index.clamp_min(0)])


@dataclass(frozen=True)
class ConfidencePenalty:
    """Mean of log γ + log(1 - γ) over the confidences γ of points, which drives them to 0 or 1 (Point-NeRF, equation 12).

    Attributes:
        weight: factor.
        least: confidences are clamped to at least this, and to at most 1 less it.
    """

    name: ClassVar[str] = "confidence"
    requires: ClassVar[Requirement] = POINTS

    weight: float = 1e-4
    least: float = 1e-3

    def __post_init__(self) -> None:
        if self.weight < 0 or not 0 < self.least < 0.5:
            raise ValueError("'weight' must not be negative, and 'least' must lie between 0 and 0.5.")

    def __call__(self, field: Field, renderer: Renderer, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean."""
        gamma = cast(PointParameters, field).confidence_logits.sigmoid().clamp(self.least, 1 - self.least)
        return self.weight * (gamma.log() + (1 - gamma).log()).mean()
