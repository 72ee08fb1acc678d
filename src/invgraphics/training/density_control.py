"""Adaptive density control of Gaussians (3DGS, §5.2): grow (clone, split), prune, reset opacities."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Field, RayRenderer, Renderer
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.errors import InputError
from invgraphics.training.gaussians import GAUSSIANS, GaussianParameters, GrowthRound, cap_at
from invgraphics.training.hooks import FitState, Hook
from invgraphics.training.rows import replace_rows

LARGEST_OPACITY = 1 - 1e-6
"""Opacity to which a reset of a strongly filtered Gaussian is limited."""
STATISTICS = "gradient_sum", "clone_gradient_sum", "views", "max_radius"
"""What is gathered of each Gaussian between two rounds."""
WHITE_RESET_STEP = 500
"""Step of 3DGS's reset against a white background; Gaussians that are reset much sooner do not become opaque again."""


@dataclass(frozen=True)
class DensityControlConfig:
    """The 3DGS rules, on a schedule of progress so that they fit any budget; ``stop = 0`` leaves the Gaussians as they are.

    With a renderer's ``absolute_gradients`` those decide (AbsGS, Ye et al. 2024), whose thresholds are higher.

    Attributes:
        start: progress at which growth begins (paper: 500 of 30,000 steps).
        latest_start_step: step at which it begins at the latest, however long the budget; 0 leaves it to ``start``.
        stop: progress at which it ends (paper: 15,000 of 30,000).
        every: steps between two rounds of growing and pruning.
        threshold: mean norm of dL/d(NDC xy) above which a Gaussian grows.
        split_threshold: the same for splitting, of absolute gradients; cloning then goes by ordinary ones, as in AbsGS. 0:
            ``threshold`` decides both, of absolute gradients where the renderer has them (gsplat).
        dense: share of the scene's extent that divides cloning (smaller) from splitting (larger).
        prune_opacity: opacity below which a Gaussian is pruned.
        prune_extent: share of the scene's extent above which a Gaussian is pruned, after the first reset.
        prune_pixels: radius in pixels above which a Gaussian is pruned, after the first reset; 0 never. Algorithm 1 of 3DGS
            has it; its code, and so its scores, do not: it clears the radii before it reads them (its issue 123).
        resets: progress values at which opacities, as a 3D filter leaves them, are reset to at most twice ``prune_opacity``.
        reset_spacing: least number of steps before the first reset and between two; one that is due sooner is skipped. Within
            fewer steps Gaussians do not become opaque again, and most are pruned.
        white_reset: whether they are also reset at ``start`` where the scene's background is white, before splats of the
            background's colour settle in front of it; skipped before step 500 (3DGS's own) or ``reset_spacing``, if sooner.
        max_primitives: cap on the number of Gaussians; those with the largest gradients grow first.
        cap_ramp: progress, from the start of growth on, over which the cap rises from the first number to ``max_primitives``,
            by equal factors; 0 for at once.
        clone: whether small Gaussians are cloned.
        split: whether large Gaussians are split.
        revised_opacity: whether a clone and its parent take the opacity 1 - √(1 - o), which composites to the parent's o (Rota
            Bulò et al. 2024, "Revising densification", §3.3), rather than both keeping it (3DGS). Opacities are taken without
            the 3D filter's attenuation: where that is strong, the two composite to more than what is seen of the parent (1.08
            times at the median of a toy scene of large pixels).
    """

    start: float = 1 / 60
    latest_start_step: int = 0
    stop: float = 0.5
    every: int = 100
    threshold: float = 2e-4
    split_threshold: float = 0.0
    dense: float = 0.01
    prune_opacity: float = 0.005
    prune_extent: float = 0.1
    prune_pixels: float = 0.0
    resets: tuple[float, ...] = ()
    reset_spacing: int = 0
    white_reset: bool = False
    max_primitives: int = 1_000_000
    cap_ramp: float = 0.0
    clone: bool = True
    split: bool = True
    revised_opacity: bool = False

    def __post_init__(self) -> None:
        if self.every < 1 or self.max_primitives < 1:
            raise ValueError("'every' and 'max_primitives' must be at least 1.")
        if self.reset_spacing < 0 or self.split_threshold < 0:
            raise ValueError("'reset_spacing' and 'split_threshold' must not be negative.")

    def capped(self, most: int) -> DensityControlConfig:
        """The same, growing to at most ``most`` Gaussians."""
        return replace(self, max_primitives=most)

    def build(self) -> DensityControl:
        """The hook."""
        return DensityControl(self)


_FIRST_NAMES = {
    "gradient_sum": "pull",
    "views": "seen",
    "max_radius": "radius",
    "first_count": "first",
    "resets_due": "resets_done",
}
"""Tensors of a checkpoint -> what they were called in those of earlier versions."""


class DensityControl(Hook):
    """Accumulates screen-space gradients, then grows, prunes and resets the Gaussians on schedule.

    The gradient is 3DGS's: dL/d(NDC xy), the pixel gradient times (W/2, H/2), averaged over the views that see the Gaussian.
    Opacities are reset before the next step, when the 3D filter is that of the Gaussians after their growth.

    Attributes:
        last_round: the latest round in this process; ``None`` before the first.
    """

    name = "density_control"
    requires = GAUSSIANS
    SPLIT_INTO = 2
    SPLIT_SHRINK = 1.6

    def __init__(self, config: DensityControlConfig) -> None:
        self._config = config
        self._gradient_sum = torch.zeros(0)
        self._clone_gradient_sum = torch.zeros(0)
        self._views = torch.zeros(0)
        self._max_radius = torch.zeros(0)
        self._resets_due = 0
        self._last_reset, self._reset_pending = 0, False
        self._started = -1.0
        self._first_count = 0
        self.last_round: GrowthRound | None = None

    @override
    def check_fit(self, field: Field, renderer: Renderer) -> None:
        if isinstance(renderer, RayRenderer):
            raise InputError(f"The hook '{self.name}' needs a renderer that splats.", "Gaussians of any grow by 'relocation'.")

    @override
    def rescale_progress(self, before: float, after: float) -> None:
        """Move growth's start to its step's new progress, and count those resets as done that lie before the new progress."""
        if self._started >= 0 and before:
            self._started *= after / before
        self._resets_due = sum(reset <= after for reset in self._config.resets)

    @override
    def before_step(self, state: FitState) -> None:
        """Reset opacities, where that became due in the step before."""
        if self._reset_pending:
            self._reset_pending = False
            self._reset_opacities(state)

    @override
    def after_backward(self, state: FitState) -> None:
        """Accumulate gradient norms, numbers of views and largest radii of the Gaussians in view."""
        screen = state.trace.screen if state.trace is not None else None
        if screen is None or screen.gradient is None or state.ctx.progress >= self._config.stop:
            return
        if len(self._gradient_sum) != len(screen.radii):
            self._clear_statistics(len(screen.radii), screen.radii)
        pixels_per_ndc = screen.means2d.new_tensor([screen.width / 2, screen.height / 2])
        visible = screen.radii > 0
        self._gradient_sum += torch.where(visible, (screen.gradient * pixels_per_ndc).norm(dim=1), 0)
        if self._config.split_threshold and screen.means2d.grad is not None:
            self._clone_gradient_sum += torch.where(visible, (screen.means2d.grad * pixels_per_ndc).norm(dim=1), 0)
        self._views += visible
        self._max_radius = torch.maximum(self._max_radius, screen.radii.detach())

    @override
    def after_step(self, state: FitState) -> None:
        """Grow and prune as scheduled; a reset that is due waits for the next step."""
        config, progress = self._config, state.ctx.progress
        field = cast(GaussianParameters, state.field)
        starts = self._started < 0 and self._due_to_start(state)
        if starts:
            self._started = progress
        due = (state.step + 1) % config.every == 0 and len(self._gradient_sum) == len(field.means)
        if due and self._started >= 0 and progress < config.stop:
            self._grow_and_prune(state)
        if self._resets_due < len(config.resets) and progress >= config.resets[self._resets_due]:
            self._resets_due += 1
            if progress < config.stop and state.step + 1 - self._last_reset >= config.reset_spacing:
                self._last_reset, self._reset_pending = state.step + 1, True
        self._reset_pending |= starts and self._resets_at_start(state)

    def _due_to_start(self, state: FitState) -> bool:
        """Whether growth may begin: by progress, or by steps in long budgets."""
        return state.ctx.progress >= self._config.start or 0 < self._config.latest_start_step <= state.step

    def _resets_at_start(self, state: FitState) -> bool:
        """Whether opacities are reset as growth begins: against a white background, unless that is too early to recover."""
        soonest = min(self._config.reset_spacing, WHITE_RESET_STEP)
        due = self._config.white_reset and state.ctx.progress < self._config.stop and state.step + 1 >= soonest
        return due and bool((state.scene.background >= 1).all())

    @torch.no_grad()
    def _reset_opacities(self, state: FitState) -> None:
        """Clamp filtered opacities to twice the pruning threshold, and zero their moments."""
        field = cast(GaussianParameters, state.field)
        ceiling = (2 * self._config.prune_opacity / field.filter_attenuation()).clamp_max(LARGEST_OPACITY)
        torch.minimum(field.opacity_logits, ceiling.logit(), out=field.opacity_logits)
        state.optimiser.reset_moments("field.opacity_logits")

    @torch.no_grad()
    def _grow_and_prune(self, state: FitState) -> None:
        """One round: clone small Gaussians with large gradients, split large ones, prune transparent and oversized ones."""
        config, field = self._config, cast(GaussianParameters, state.field)
        largest = field.log_scales.exp().amax(dim=1)
        keep = ~self._to_prune(field, largest, state.scene.extent)
        small = largest <= config.dense * state.scene.extent
        may_grow = keep & torch.where(small, config.clone, config.split)
        room = self._cap(state.ctx.progress, len(keep)) - int(keep.sum())
        grows = self._to_grow(torch.where(may_grow, self._gradient(small), 0.0), room)
        to_clone, to_split = grows & small, grows & ~small
        keep &= ~to_split
        if not bool((keep | to_split).any()):
            keep[torch.argmax(field.opacity_logits)] = True  # an empty field could never grow again
        self.last_round = GrowthRound(state.step + 1, to_clone, to_split, ~(keep | to_split))
        self._rebuild(state, *(mask.nonzero()[:, 0] for mask in (keep, to_clone, to_split)))

    def _gradient(self, small: Bool[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Mean gradients, to be compared with ``threshold``: that of splitting is brought to it."""
        config, views = self._config, self._views.clamp_min(1)
        if not config.split_threshold:
            return self._gradient_sum / views
        to_split = self._gradient_sum * (config.threshold / config.split_threshold)
        return torch.where(small, self._clone_gradient_sum, to_split) / views

    def _cap(self, progress: float, count: int) -> int:
        """Most Gaussians at this point of the fit."""
        self._first_count = self._first_count or count
        return cap_at(self._first_count, self._config.max_primitives, progress - self._started, self._config.cap_ramp)

    def _to_grow(self, gradient: Float[Tensor, " n"], room: int) -> Bool[Tensor, " n"]:
        """Gaussians whose gradient is above the threshold; at most ``room`` of them, the largest gradients first."""
        grows = gradient > self._config.threshold
        if int(grows.sum()) > max(room, 0):
            grows[torch.argsort(gradient, descending=True, stable=True)[max(room, 0) :]] = False
        return grows

    def _to_prune(self, field: GaussianParameters, largest: Float[Tensor, " n"], extent: float) -> Bool[Tensor, " n"]:
        """Gaussians that are transparent or, after the first reset, too large in the scene or on a screen."""
        config = self._config
        prune = torch.sigmoid(field.opacity_logits) < config.prune_opacity
        if self._last_reset:
            prune |= largest > config.prune_extent * extent
            if config.prune_pixels:
                prune |= self._max_radius > config.prune_pixels
        return prune

    def _rebuild(self, state: FitState, keep: Int[Tensor, " k"], cloned: Int[Tensor, " c"], split: Int[Tensor, " s"]) -> None:
        """Replace the field's rows by those to keep, the clones, and the parts of those to split."""
        old = {name: parameter.detach() for name, parameter in state.field.named_parameters()}
        parts = split.repeat(self.SPLIT_INTO)
        rows = torch.cat([keep, cloned, parts])
        new = {name: values[rows].clone() for name, values in old.items()}
        first = len(keep) + len(cloned)
        if self._config.revised_opacity:
            pairs = torch.cat([torch.searchsorted(keep, cloned), torch.arange(len(keep), first, device=rows.device)])
            revised = 1 - (1 - new["opacity_logits"][pairs].sigmoid()).sqrt()
            new["opacity_logits"][pairs] = torch.logit(revised)
        offset = torch.randn(len(parts), 3, generator=state.ctx.generator).to(rows.device) * old["log_scales"][parts].exp()
        rotation = quaternion_to_matrix(old["quaternions"][parts])
        new["means"][first:] += (rotation @ offset[:, :, None])[:, :, 0]
        new["log_scales"][first:] -= math.log(self.SPLIT_SHRINK)
        replace_rows(state, new, keep, len(rows) - len(keep))
        self._clear_statistics(len(rows), new["means"])

    def _clear_statistics(self, count: int, like: Tensor) -> None:
        zeros = [torch.zeros(count, device=like.device) for _ in STATISTICS]
        self._gradient_sum, self._clone_gradient_sum, self._views, self._max_radius = zeros

    @override
    def state_dict(self) -> dict[str, Tensor]:
        return {name: getattr(self, f"_{name}") for name in STATISTICS} | {
            "resets_due": torch.tensor(self._resets_due),
            "last_reset": torch.tensor(self._last_reset),
            "reset_pending": torch.tensor(self._reset_pending),
            "started": torch.tensor(self._started, dtype=torch.float64),
            "first_count": torch.tensor(self._first_count),
        }

    @override
    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        state = {name: state[first] for name, first in _FIRST_NAMES.items() if first in state} | state
        self._gradient_sum, self._views, self._max_radius = state["gradient_sum"], state["views"], state["max_radius"]
        self._clone_gradient_sum = state.get("clone_gradient_sum", torch.zeros_like(self._gradient_sum))
        self._reset_pending = bool(state.get("reset_pending", False))
        self._resets_due, self._started = int(state["resets_due"]), float(state["started"])
        self._last_reset = int(state.get("last_reset", state["resets_due"]))
        self._first_count = int(state["first_count"])
