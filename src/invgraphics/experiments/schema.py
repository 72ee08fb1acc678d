"""The schema of a recipe file."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as default
from typing import Annotated, Any

from invgraphics.config import Slot
from invgraphics.training.batches import BatchConfig
from invgraphics.training.optimiser import OptimiserConfig


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
    """

    field: Annotated[Any, Slot("fields")]
    renderer: Annotated[Any, Slot("renderers")]
    losses: tuple[Annotated[Any, Slot("losses")], ...]
    optimiser: OptimiserConfig
    summary: str = ""
    paper: str = ""
    hooks: tuple[Annotated[Any, Slot("hooks")], ...] = ()
    batches: BatchConfig = default(default_factory=BatchConfig)
