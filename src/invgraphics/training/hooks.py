"""Things that happen between the steps of a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Batch, Context, Field, Renderer, Rendering, Scene, Trace
from invgraphics.errors import InputError
from invgraphics.training.optimiser import Optimiser

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass
class FitState:
    """What hooks see of a fit.

    Attributes:
        field: the field being fitted.
        renderer: the renderer it is seen through.
        optimiser: its optimiser.
        scene: the scene, for its extent, points and background.
        ctx: context of the current step (progress, generator).
        step: steps done before the current one.
        trace: trace of the current step; ``None`` before rendering.
        rendering: picture of the current step.
        batch: what it is compared with.
    """

    field: Field
    renderer: Renderer
    optimiser: Optimiser
    scene: Scene
    ctx: Context
    step: int = 0
    trace: Trace | None = None
    rendering: Rendering | None = None
    batch: Batch | None = None


class Hook:
    """Called around each step. A hook that keeps tensors between steps gives them to the checkpoint."""

    def check(self, field: Field, renderer: Renderer) -> None:
        """Refuse, with an `InputError`, a field or renderer that this hook cannot serve."""

    def before_step(self, state: FitState) -> None:
        """Before anything of the step; ``trace`` and ``batch`` are those of the step before."""

    def after_backward(self, state: FitState) -> None:
        """Gradients are there, parameters not yet moved."""

    def after_step(self, state: FitState) -> None:
        """Parameters have moved."""

    def state_dict(self) -> dict[str, Tensor]:
        """Tensors a resumed fit needs."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state_dict`."""


@dataclass(frozen=True)
class ShDegreeConfig:
    """Spherical-harmonics bands are switched on one after another (3DGS adds one each 1000 of 30,000 steps).

    Attributes:
        interval: progress between two bands.
        start: progress at which the first band beyond the constant one comes.
        steps: most steps before each band, however long the budget (3DGS: 1000); 0 leaves it to ``start`` and ``interval``.
    """

    interval: float = 1 / 30
    start: float = 1 / 30
    steps: int = 0

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise ValueError(f"'steps' must not be negative, not {self.steps}.")

    def build(self) -> Hook:
        """The hook."""
        return _ShDegree(self)


class _ShDegree(Hook):
    def __init__(self, config: ShDegreeConfig) -> None:
        self._config = config

    @override
    def check(self, field: Field, renderer: Renderer) -> None:
        if not hasattr(field, "active_degree") or not hasattr(field, "sh_degree"):
            raise InputError(f"The hook 'sh_degree' needs spherical harmonics, which {type(field).__name__} has not.")

    @override
    def before_step(self, state: FitState) -> None:
        config = self._config
        passed = state.ctx.progress - config.start
        bands = 0 if passed < 0 else 1 + int(passed / max(config.interval, 1e-9))
        bands = max(bands, state.step // config.steps) if config.steps else bands
        limit: int = state.field.sh_degree  # type: ignore[assignment]
        state.field.active_degree = min(bands, limit)  # type: ignore[assignment]


def prefixed(hooks: Sequence[Hook]) -> dict[str, Tensor]:
    """All hooks' tensors, keyed by position."""
    return {f"{i}/{key}": value for i, hook in enumerate(hooks) for key, value in hook.state_dict().items()}


def load_prefixed(hooks: Sequence[Hook], state: dict[str, Tensor]) -> None:
    """Inverse of `prefixed`."""
    for i, hook in enumerate(hooks):
        own = {key.partition("/")[2]: value for key, value in state.items() if key.startswith(f"{i}/")}
        if own:
            hook.load_state_dict(own)


def generator_state(generator: torch.Generator) -> dict[str, Tensor]:
    """Both random states: the fit's own and torch's global one."""
    return {"fit": generator.get_state(), "global": torch.get_rng_state()}
