"""Rows of a primitive field replaced together with what the optimiser keeps of them."""

from __future__ import annotations

from typing import Protocol, cast

from jaxtyping import Int
from torch import Tensor

from invgraphics.training.hooks import FitState


class ReplaceableRows(Protocol):
    """The part of a field of primitives that `replace_rows` needs."""

    def replace(self, tensors: dict[str, Tensor]) -> None:
        """Replace all primitives by new ones, of any number."""
        ...


def replace_rows(state: FitState, tensors: dict[str, Tensor], kept: Int[Tensor, " k"], added: int) -> None:
    """Replace the primitives of a fit's field; moments follow the ``kept`` rows, and are zero for ``added`` rows behind them.

    Args:
        state: of the fit.
        tensors: new values by name, parameters and buffers, each with k + ``added`` rows.
        kept: old indices of the first k rows.
        added: number of the other rows.
    """
    cast(ReplaceableRows, state.field).replace(tensors)
    parameters = dict(state.field.named_parameters())
    for name in tensors:
        if name in parameters:
            state.optimiser.reindex_rows(f"field.{name}", parameters[name], kept, added)
