"""The schema of a recipe file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from dataclasses import field as default
from typing import Annotated, Any

from invgraphics.config import Slot
from invgraphics.training.batches import BatchConfig
from invgraphics.training.optimiser import OptimiserConfig
from invgraphics.training.poses import TrainingConfig


@dataclass(frozen=True)
class Recipe:
    """A method as data: field x renderer, and how to fit it.

    Attributes:
        summary: one sentence for ``invgraphics list`` and the report.
        paper: where the method comes from.
        field: parameterisation of the scene.
        renderer: how it becomes a picture.
        losses: their sum is minimised.
        hooks: what happens between steps.
        optimiser: Adam's settings and parameter groups.
        batches: size of a step.
        training: what else the fit finds out, such as the cameras' poses; ``None`` for nothing.
        max_primitives: most explicit primitives, of fields and hooks that make some; ``None`` leaves it to their own settings.
    """

    field: Annotated[Any, Slot("fields")]
    renderer: Annotated[Any, Slot("renderers")]
    losses: tuple[Annotated[Any, Slot("losses")], ...]
    optimiser: OptimiserConfig
    summary: str = ""
    paper: str = ""
    hooks: tuple[Annotated[Any, Slot("hooks")], ...] = ()
    batches: BatchConfig = default(default_factory=BatchConfig)
    training: TrainingConfig | None = None
    max_primitives: int | None = None

    def __post_init__(self) -> None:
        if self.max_primitives is not None and self.max_primitives < 1:
            raise ValueError(f"max_primitives must be at least 1, not {self.max_primitives}.")

    def capped(self) -> Recipe:
        """The recipe with ``max_primitives`` handed to every part that makes primitives, which offers a ``capped`` itself."""
        if self.max_primitives is None:
            return self
        return replace(self, field=self._cap(self.field), hooks=tuple(map(self._cap, self.hooks)))

    def _cap(self, part: Any) -> Any:
        return part.capped(self.max_primitives) if hasattr(part, "capped") else part
