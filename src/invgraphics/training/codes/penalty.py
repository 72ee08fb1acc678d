"""Penalty on the codes of a class of objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Conditional, Context, Field, Renderer
from invgraphics.training.checks import Requirement


class HasCodes(Protocol):
    """Protocol of fields over a class of objects."""

    codes: Tensor


@dataclass(frozen=True)
class CodePenalty:
    """Mean squared component of the codes: their Gaussian prior (DeepSDF, equation 9).

    Attributes:
        weight: factor (DeepSDF: 1e-4; SRN: 1e-3).
    """

    name: ClassVar[str] = "code"
    requires: ClassVar[Requirement] = Requirement("codes of a class of objects", HasCodes)

    weight: float = 1e-3

    def __post_init__(self) -> None:
        if self.weight < 0:
            raise ValueError("'weight' must not be negative.")

    def __call__(self, field: Field, renderer: Renderer, ctx: Context) -> Float[Tensor, ""]:
        """The weighted mean."""
        assert isinstance(field, Conditional)
        return self.weight * field.codes.square().mean()
