"""Hooks that act once at each of some points of a fit, such as up-sampling and pruning."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor
from typing_extensions import override

from invgraphics.training.hooks import FitState, Hook


def check_milestones(at: Sequence[float]) -> None:
    """Check the progress of each milestone.

    Raises:
        ValueError: none, not increasing, or not between 0 and 1.
    """
    if not at or list(at) != sorted(set(at)) or not 0 < at[0] <= at[-1] < 1:
        raise ValueError(f"'at' needs increasing numbers between 0 and 1, not {list(at)}.")


class MilestoneHook(Hook, ABC):
    """Acts before the step whose progress has come to the next milestone, once where that is past several.

    Args:
        at: progress of each milestone, increasing.

    Attributes:
        done: milestones that are past; part of the checkpoint.
    """

    def __init__(self, at: Sequence[float]) -> None:
        self._at = at
        self.done = 0

    @abstractmethod
    def act(self, state: FitState, due: int) -> None:
        """Act; ``due`` milestones are past, of which `done` had their turn before."""

    @override
    def before_step(self, state: FitState) -> None:
        due = sum(progress <= state.ctx.progress for progress in self._at)
        if due > self.done:
            self.act(state, due)
            self.done = due

    @override
    def state_dict(self) -> dict[str, Tensor]:
        return {"done": torch.tensor(self.done)}

    @override
    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.done = int(state["done"])
