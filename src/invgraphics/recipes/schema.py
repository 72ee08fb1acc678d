"""The schema of a recipe file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from dataclasses import field as default
from typing import Annotated, Any, Self, get_type_hints

from typing_extensions import Protocol, runtime_checkable

from invgraphics.config import OMIT_EMPTY, Slot
from invgraphics.training.batches import BatchConfig
from invgraphics.training.hooks import Hook
from invgraphics.training.optimiser import OptimiserConfig
from invgraphics.training.penalties import check_penalty
from invgraphics.training.poses import TrainingConfig


@runtime_checkable
class CapsPrimitives(Protocol):
    """Protocol of recipe parts whose number of explicit primitives can be capped."""

    def capped(self, most: int) -> Self:
        """Limit this part to at most ``most`` primitives."""
        ...


@dataclass(frozen=True)
class Recipe:
    """A method as data: field, renderer, losses, hooks, optimiser and batches.

    Attributes:
        summary: one sentence for ``invgraphics list`` and the report.
        paper: where the method comes from.
        field: parameterisation of the scene.
        renderer: how it is rendered.
        losses: their sum, and that of the penalties, is minimised.
        penalties: terms that depend on the model alone, such as total variation.
        hooks: callbacks between steps, such as density control.
        optimiser: Adam's settings and parameter groups.
        batches: size of a step.
        training: what the fit optimises besides the model, such as the cameras' poses; ``None`` for nothing.
        max_primitives: most explicit primitives, of fields and hooks that make some; ``None`` leaves it to their own settings.
    """

    field: Annotated[Any, Slot("fields")]
    renderer: Annotated[Any, Slot("renderers")]
    losses: tuple[Annotated[Any, Slot("losses")], ...]
    optimiser: OptimiserConfig
    summary: str = ""
    paper: str = ""
    penalties: tuple[Annotated[Any, Slot("penalties")], ...] = default(default=(), metadata=OMIT_EMPTY)
    hooks: tuple[Annotated[Any, Slot("hooks")], ...] = ()
    batches: BatchConfig = default(default_factory=BatchConfig)
    training: TrainingConfig | None = None
    max_primitives: int | None = None

    def __post_init__(self) -> None:
        if self.max_primitives is not None and self.max_primitives < 1:
            raise ValueError(f"max_primitives must be at least 1, not {self.max_primitives}.")
        for name, terms in (("losses", self.losses), ("penalties", self.penalties)):
            for index, term in enumerate(terms):
                if getattr(term, "weight", 0.0) < 0:
                    raise ValueError(f"{name}.{index}.weight must be at least 0, not {term.weight}: a fit minimises.")

    @property
    def has_primitives(self) -> bool:
        """Whether ``max_primitives`` does anything: the field or a hook makes explicit primitives."""
        return any(isinstance(part, CapsPrimitives) for part in (self.field, *self.hooks))

    def capped(self) -> Recipe:
        """Apply ``max_primitives`` to the field and the hooks that create primitives (`CapsPrimitives`)."""
        most = self.max_primitives
        if most is None:
            return self
        field, *hooks = (part.capped(most) if isinstance(part, CapsPrimitives) else part for part in (self.field, *self.hooks))
        return replace(self, field=field, hooks=tuple(hooks))

    def check_hooks(self) -> None:
        """Check before building that the field provides what each hook and penalty needs.

        Classes are those with which ``build`` of the configs is annotated; where there is no annotation, the fit checks.

        Raises:
            InputError: names the part, what it needs, and the field.
        """
        field = _build_type(self.field)
        for hook in map(_build_type, self.hooks):
            if field is not None and hook is not None and issubclass(hook, Hook):
                hook.check(field)
        for penalty in self.penalties:
            if field is not None:
                check_penalty(penalty, field)


def _build_type(config: Any) -> type | None:
    """Return annotation of a config's ``build``; ``None`` without one."""
    try:
        result = get_type_hints(type(config).build).get("return")
    except (AttributeError, NameError, TypeError):  # a name that is imported for type checkers only
        return None
    return result if isinstance(result, type) else None
