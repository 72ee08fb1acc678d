"""Checks of a fit's parts, some of which third parties write: what they need of the field, and what they return."""

from __future__ import annotations

from dataclasses import dataclass
from inspect import get_annotations

from torch import Tensor
from typing_extensions import get_protocol_members

from invgraphics.core import Batch, Model, Quantity, Renderer, Rendering, Trace
from invgraphics.errors import InputError

ROUNDING = 1e-3
"""Distance from [0, 1] up to which an opacity is one that was rounded."""


@dataclass(frozen=True)
class Requirement:
    """Members that a field must have, quantities that it must provide, or both.

    Attributes:
        words: what they are, for a sentence.
        protocol: a `typing.Protocol` that lists the members; ``None`` for none.
        quantities: that it provides.
    """

    words: str
    protocol: type | None = None
    quantities: Quantity = Quantity.NONE

    def met_by(self, field: object) -> bool:
        """Whether a field, or a class of fields, has all of them. Annotations of a class count as its members.

        A class whose fields differ in what they provide passes.
        """
        cls = field if isinstance(field, type) else type(field)
        declared = {name for base in cls.__mro__ for name in get_annotations(base)}
        members = () if self.protocol is None else get_protocol_members(self.protocol)
        provided = getattr(field, "provides", None)
        enough = self.quantities in provided if isinstance(provided, Quantity) else isinstance(field, type)
        return enough and all(hasattr(field, name) or name in declared for name in members)

    def check(self, part: str, field: object) -> None:
        """Refuse a field, or a class of fields, that lacks a member or a quantity.

        Raises:
            InputError: names the part of the recipe, what it needs, and the field.
        """
        if not self.met_by(field):
            name = (field if isinstance(field, type) else type(field)).__name__
            raise InputError(f"The {part} needs {self.words}, which {name} does not have.")


def check_results(found: object, renderer: Renderer) -> tuple[Rendering, Trace]:
    """Check that a renderer returned a rendering and its trace.

    Raises:
        InputError: it returned something else.
    """
    if isinstance(found, tuple) and len(found) == 2:
        rendering, trace = found
        if isinstance(rendering, Rendering) and isinstance(trace, Trace):
            return rendering, trace
        what = f"({type(rendering).__name__}, {type(trace).__name__})"
    else:
        what = type(found).__name__
    raise InputError(f"{type(renderer).__name__} returned {what}.", "Expected: a Rendering and its Trace, as a tuple.")


def check_values(rendering: Rendering, trace: Trace, batch: Batch, model: Model) -> None:
    """Check shapes and ranges of a first step's picture, and that no density is negative. NaN passes: the fit names it.

    Raises:
        InputError: a shape is not that of the batch, an opacity is outside [0, 1], or a density below 0.
    """
    who, pixels = type(model.renderer).__name__, tuple(batch.target.shape[:-1])
    for name, shape in (("rgb", (*pixels, 3)), ("alpha", pixels), ("depth", pixels)):
        value: Tensor = getattr(rendering, name)
        if tuple(value.shape) != shape:
            raise InputError(
                f"{who} returned '{name}' of shape {tuple(value.shape)} for pixels {pixels}.", f"Expected: {shape}."
            )
        if not value.is_floating_point():
            raise InputError(f"{who} returned '{name}' of type {value.dtype}, no floating-point numbers.")
    for level in (*trace.levels, trace):
        density = None if level.values is None or level.values.density is None else level.values.density.detach()
        if density is not None and bool((density < 0).any()):
            what = f"{int((density < 0).sum()):,} of {len(density):,} densities of {type(model.field).__name__} are negative"
            raise InputError(f"{what}, down to {float(density.min()):.3g}.", "Expected: 0 or more, as by softplus or exp.")
    alpha = rendering.alpha.detach()
    if bool(((alpha < -ROUNDING) | (alpha > 1 + ROUNDING)).any()):
        low, high = float(alpha.min()), float(alpha.max())
        raise InputError(f"{who} returned opacities from {low:.3g} to {high:.3g}.", "Expected: 'alpha' in [0, 1].")


def check_term(value: Tensor, term: object, kind: str) -> Tensor:
    """Check that a term of the objective is one number, as a tensor.

    Args:
        value: what was returned.
        term: the loss or penalty that returned it.
        kind: which of them it is, in a word.

    Raises:
        InputError: it is something else.
    """
    if not isinstance(value, Tensor) or value.ndim:
        what = f"a tensor of shape {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)
        who = f"{type(term).__module__}.{type(term).__name__}"
        raise InputError(f"The {kind} {who} returned {what}.", "Expected: a tensor without dimensions, as of mean().")
    return value
