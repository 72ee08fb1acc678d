"""Hooks: called around each step of a fit. Here their base, and the schedule of spherical-harmonics bands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol, cast

import torch
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Batch, Camera, Context, Field, Renderer, Rendering, Scene, Trace
from invgraphics.training.checks import Requirement
from invgraphics.training.optimiser import Optimiser

if TYPE_CHECKING:
    from collections.abc import Sequence

    from invgraphics.training.poses import Poses


@dataclass
class FitState:
    """State of a fit that hooks read and edit.

    Attributes:
        field: the field being fitted.
        renderer: the renderer it is fitted through.
        optimiser: its optimiser.
        scene: the scene, for its extent, points and background.
        ctx: context of the current step (progress, generator).
        step: steps done before the current one.
        trace: trace of the current step; ``None`` before rendering.
        rendering: rendering of the current step, without background.
        batch: photographs of the current step.
        poses: of the training views where they are fitted too; ``None`` where they are as given.
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
    poses: Poses | None = None

    @torch.no_grad()
    def cameras(self) -> list[Camera]:
        """Cameras of the training views, as they are at this point of the fit."""
        if self.poses is None:
            return [view.camera for view in self.scene.train]
        return self.poses.cameras(torch.arange(len(self.scene.train)))


class Hook:
    """Called around each step. Tensors that a hook keeps between steps are part of the checkpoint.

    Attributes:
        name: of its config in recipes, for messages.
        requires: what it needs of the field; ``None`` for nothing. Checked when a recipe is resolved, where the config's
            ``build`` is annotated with the hook's class, and again when a fit begins.
    """

    name: ClassVar[str] = ""
    requires: ClassVar[Requirement | None] = None

    @classmethod
    def check(cls, field: Field | type[Field]) -> None:
        """Refuse a field, or a class of fields, that lacks what the hook requires.

        Raises:
            InputError: names the hook, what it needs, and the field.
        """
        if cls.requires is not None:
            cls.requires.check(f"hook '{cls.name or cls.__name__}'", field)

    def check_fit(self, field: Field, renderer: Renderer) -> None:
        """Refuse a field and a renderer that the hook could not act on later; called before the first step of a fit.

        Raises:
            InputError: names the hook, and what it needs.
        """

    def before_step(self, state: FitState) -> None:
        """Called before the step's rays are drawn."""

    def after_backward(self, state: FitState) -> None:
        """Called between the backward pass and the optimiser's step."""

    def after_step(self, state: FitState) -> None:
        """Called after the optimiser's step."""

    def rescale_progress(self, before: float, after: float) -> None:
        """Called when another budget gives the steps so far the progress ``after`` instead of ``before``."""

    def state_dict(self) -> dict[str, Tensor]:
        """Tensors that a resumed fit needs."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state_dict`."""


@dataclass(frozen=True)
class ShDegreeConfig:
    """Schedule of the spherical-harmonics degree in use: one band more at a time (3DGS: each 1000 of 30,000 steps).

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

    def build(self) -> ShDegree:
        """The hook."""
        return ShDegree(self)


class SphericalHarmonics(Protocol):
    """The part of a field that `ShDegree` sets: the degree that is stored, and the degree in use."""

    active_degree: int

    @property
    def sh_degree(self) -> int:
        """Degree of the coefficients that are stored."""
        ...


class ShDegree(Hook):
    """Sets the field's ``active_degree`` before each step."""

    name = "sh_degree"
    requires = Requirement("spherical harmonics", SphericalHarmonics)

    def __init__(self, config: ShDegreeConfig) -> None:
        self._config = config

    @override
    def before_step(self, state: FitState) -> None:
        config = self._config
        passed = state.ctx.progress - config.start
        bands = 0 if passed < 0 else 1 + int(passed / max(config.interval, 1e-9))
        bands = max(bands, state.step // config.steps) if config.steps else bands
        field = cast(SphericalHarmonics, state.field)
        field.active_degree = min(bands, field.sh_degree)


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
