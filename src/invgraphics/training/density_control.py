"""Adaptive density control of Gaussians (3DGS, §5.2): clone and split where images pull, prune what nobody sees."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from typing_extensions import override

from invgraphics.core import Field, Quantity, Renderer
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.errors import InputError
from invgraphics.training.hooks import FitState, Hook


@dataclass(frozen=True)
class DensityControlConfig:
    """The 3DGS rules, on a schedule of progress so that they fit any budget; ``stop = 0`` leaves the Gaussians as they are.

    With a renderer's ``absolute_gradients`` the gradients are those of AbsGS (Ye et al. 2024), whose threshold is higher: 8e-4.

    Attributes:
        start: progress at which growing begins (paper: 500 of 30,000 steps).
        start_steps: steps after which it begins at the latest, however long the budget; 0 leaves it to ``start``.
        stop: progress at which it ends (paper: 15,000 of 30,000).
        every: steps between two rounds.
        threshold: mean norm of dL/d(NDC xy) above which a Gaussian grows.
        dense: share of the scene's extent that divides cloning (smaller) from splitting (larger).
        prune_opacity: opacity below which a Gaussian goes.
        prune_extent: share of the scene's extent above which a Gaussian goes, after the first reset.
        prune_pixels: radius in pixels above which a Gaussian goes, after the first reset; 0 never.
        resets: progress values at which opacities are pulled down to at most twice ``prune_opacity``.
        white_reset: whether they are also pulled down at ``start`` where the scene's background is white, before splats of the
            background's colour settle in front of it.
        max_primitives: growth stops here; those with the largest gradients come first.
        pace: progress, from the start of growth on, over which the limit on their number rises to ``max_primitives``, by equal
            factors; 0 lets them grow as fast as their gradients say.
        clone: whether small Gaussians are cloned.
        split: whether large Gaussians are split.
        share_opacity: whether a clone and its parent take opacities that together look like the parent's, 1 - √(1 - o) (Rota
            Bulò et al. 2024, §3.3), rather than both keeping it (3DGS).
    """

    start: float = 1 / 60
    start_steps: int = 0
    stop: float = 0.5
    every: int = 100
    threshold: float = 2e-4
    dense: float = 0.01
    prune_opacity: float = 0.005
    prune_extent: float = 0.1
    prune_pixels: float = 0.0
    resets: tuple[float, ...] = ()
    white_reset: bool = False
    max_primitives: int = 1_000_000
    pace: float = 0.0
    clone: bool = True
    split: bool = True
    share_opacity: bool = False

    def __post_init__(self) -> None:
        if self.every < 1 or self.max_primitives < 1:
            raise ValueError("'every' and 'max_primitives' must be at least 1.")

    def capped(self, most: int) -> DensityControlConfig:
        """The same, growing to at most ``most`` Gaussians."""
        return replace(self, max_primitives=most)

    def build(self) -> Hook:
        """The hook."""
        return DensityControl(self)


class Splats(Protocol):
    """The part of a Gaussian field that density control edits."""

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    opacity_logits: Float[Tensor, " n"]

    def replace(self, tensors: dict[str, Tensor]) -> None:
        """Swap all parameters for new ones."""
        ...


def paced_limit(first: int, most: int, passed: float, pace: float) -> int:
    """Number of primitives that growth may have reached: from ``first`` to ``most`` by equal factors over ``pace`` of a fit.

    Args:
        first: number when growth began.
        most: number in the end.
        passed: progress since growth began.
        pace: progress until the end; 0 for no limit but ``most``.
    """
    if not pace or first >= most:
        return most
    return int(first * (most / first) ** min(1.0, max(0.0, passed) / pace))


def check_splats(hook: str, field: Field) -> None:
    """Refuse a field without Gaussians that can be edited.

    Raises:
        InputError: names the hook and the field.
    """
    if Quantity.GAUSSIANS not in field.provides or not hasattr(field, "replace"):
        raise InputError(f"The hook '{hook}' needs Gaussians, which {type(field).__name__} does not have.")


class DensityControl(Hook):
    """Gathers screen-space gradients and regrows the Gaussians at intervals.

    The gradient is 3DGS's: dL/d(NDC xy), the pixel gradient times (W/2, H/2), averaged over the views that see the Gaussian.
    """

    SPLIT_INTO = 2
    SPLIT_SHRINK = 1.6

    def __init__(self, config: DensityControlConfig) -> None:
        self._config = config
        self._pull = torch.zeros(0)
        self._seen = torch.zeros(0)
        self._radius = torch.zeros(0)
        self._resets_done = 0
        self._started = -1.0
        self._first = 0

    @override
    def check(self, field: Field, renderer: Renderer) -> None:
        check_splats("density_control", field)

    @override
    def after_backward(self, state: FitState) -> None:
        screen = state.trace.screen if state.trace is not None else None
        if screen is None or screen.gradient is None or state.ctx.progress >= self._config.stop:
            return
        if len(self._pull) != len(screen.radii):
            self._restart(len(screen.radii), screen.radii)
        ndc = screen.gradient * screen.means2d.new_tensor([screen.width / 2, screen.height / 2])
        visible = screen.radii > 0
        self._pull += torch.where(visible, ndc.norm(dim=1), 0)
        self._seen += visible
        self._radius = torch.maximum(self._radius, screen.radii.detach())

    @override
    def after_step(self, state: FitState) -> None:
        config, progress = self._config, state.ctx.progress
        field = cast(Splats, state.field)
        begins = self._started < 0 and self._begun(state)
        if begins:
            self._started = progress
        due = (state.step + 1) % config.every == 0 and len(self._pull) == len(field.means)
        if due and self._started >= 0 and progress < config.stop:
            self._regrow(state)
        if self._resets_done < len(config.resets) and progress >= config.resets[self._resets_done]:
            self._resets_done += 1
            self._reset(state)
        if begins and config.white_reset and bool((state.scene.background >= 1).all()):
            self._reset(state)

    def _begun(self, state: FitState) -> bool:
        """Whether growth has begun: by progress, or by steps in budgets that are long."""
        steps = self._config.start_steps
        return state.ctx.progress >= self._config.start or (0 < steps <= state.step)

    @torch.no_grad()
    def _reset(self, state: FitState) -> None:
        ceiling = 2 * self._config.prune_opacity
        cast(Splats, state.field).opacity_logits.clamp_(max=math.log(ceiling / (1 - ceiling)))
        state.optimiser.forget("field.opacity_logits")

    @torch.no_grad()
    def _regrow(self, state: FitState) -> None:
        config, field = self._config, cast(Splats, state.field)
        pull = self._pull / self._seen.clamp_min(1)
        largest = field.log_scales.exp().amax(dim=1)
        keep = ~self._to_prune(field, largest, state.scene.extent)
        small = largest <= config.dense * state.scene.extent
        able = keep & torch.where(small, config.clone, config.split)
        grows = self._to_grow(torch.where(able, pull, 0.0), self._limit(state.ctx.progress, len(keep)) - int(keep.sum()))
        cloned, split = (grows & small).nonzero()[:, 0], (grows & ~small).nonzero()[:, 0]
        keep[split] = False
        if not bool(keep.any()) and len(split) == 0:
            keep[torch.argmax(field.opacity_logits)] = True  # a field of nothing could never grow again
        self._apply(state, keep.nonzero()[:, 0], cloned, split)

    def _limit(self, progress: float, count: int) -> int:
        """Most Gaussians there may be now."""
        config = self._config
        self._first = self._first or count
        return paced_limit(self._first, config.max_primitives, progress - self._started, config.pace)

    def _to_grow(self, pull: Float[Tensor, " n"], room: int) -> Bool[Tensor, " n"]:
        """Above the threshold; where room is short, the strongest only."""
        grows = pull > self._config.threshold
        if int(grows.sum()) > max(room, 0):
            ranked = torch.argsort(pull, descending=True, stable=True)
            grows = torch.zeros_like(grows)
            grows[ranked[: max(room, 0)]] = True
            grows &= pull > self._config.threshold
        return grows

    def _to_prune(self, field: Splats, largest: Float[Tensor, " n"], extent: float) -> Bool[Tensor, " n"]:
        config = self._config
        prune = torch.sigmoid(field.opacity_logits) < config.prune_opacity
        if self._resets_done:
            prune |= largest > config.prune_extent * extent
            if config.prune_pixels:
                prune |= self._radius > config.prune_pixels
        return prune

    def _apply(self, state: FitState, keep: Int[Tensor, " k"], cloned: Int[Tensor, " c"], split: Int[Tensor, " s"]) -> None:
        field = state.field
        old = {name: parameter.detach() for name, parameter in field.named_parameters()}
        parts = split.repeat(self.SPLIT_INTO)
        rows = torch.cat([keep, cloned, parts])
        new = {name: values[rows].clone() for name, values in old.items()}
        first = len(keep) + len(cloned)
        if self._config.share_opacity:
            pairs = torch.cat([torch.searchsorted(keep, cloned), torch.arange(len(keep), first, device=rows.device)])
            half = 1 - (1 - new["opacity_logits"][pairs].sigmoid()).sqrt()
            new["opacity_logits"][pairs] = torch.logit(half)
        offset = torch.randn(len(parts), 3, generator=state.ctx.generator).to(rows.device) * old["log_scales"][parts].exp()
        rotation = quaternion_to_matrix(old["quaternions"][parts])
        new["means"][first:] += (rotation @ offset[:, :, None])[:, :, 0]
        new["log_scales"][first:] -= math.log(self.SPLIT_SHRINK)
        cast(Splats, field).replace(new)
        for name, parameter in field.named_parameters():
            state.optimiser.rechoose(f"field.{name}", cast(nn.Parameter, parameter), keep, len(rows) - len(keep))
        self._restart(len(rows), new["means"])

    def _restart(self, count: int, like: Tensor) -> None:
        self._pull, self._seen, self._radius = (torch.zeros(count, device=like.device) for _ in range(3))

    @override
    def state_dict(self) -> dict[str, Tensor]:
        gathered = {"pull": self._pull, "seen": self._seen, "radius": self._radius}
        return gathered | {
            "resets_done": torch.tensor(self._resets_done),
            "started": torch.tensor(self._started),
            "first": torch.tensor(self._first),
        }

    @override
    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._pull, self._seen, self._radius = state["pull"], state["seen"], state["radius"]
        self._resets_done, self._started = int(state["resets_done"]), float(state["started"])
        self._first = int(state["first"])
