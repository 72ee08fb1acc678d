"""Coarse-to-fine windows over encoding levels, which mask fine levels while poses are inaccurate (BARF)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.field import Encoding


class Windowed(Encoding):
    """An encoding whose features belong to levels, coarse to fine.

    A fit that optimises poses opens a window and moves it (Lin et al. 2021, equation 14); without one nothing is multiplied
    and nothing is saved.

    Attributes:
        levels: number of levels.
        always: levels that are never masked.
        detail: how far the window is open, from 0 (only those never masked) to 1 (all levels); ``None`` without a window.
    """

    levels: int
    always: int
    detail: Float[Tensor, ""] | None

    def __init__(self, levels: int, always: int) -> None:
        super().__init__()
        self.levels, self.always = levels, min(always, levels)
        self.register_buffer("detail", None)

    def add_window(self) -> None:
        """Register the window as a buffer of the encoding, initially fully open."""
        reference = next(self.parameters(), torch.zeros(()))
        self.detail = torch.ones((), device=reference.device)

    def level_weights(self) -> Float[Tensor, " levels"] | None:
        """Weight of each level, ``(1 - cos(π clamp(alpha - k, 0, 1))) / 2``; ``None`` without a window."""
        if self.detail is None:
            return None
        reached = self.always + self.detail * (self.levels - self.always)
        level = torch.arange(self.levels, device=self.detail.device)
        return (1 - torch.cos(torch.pi * (reached - level).clamp(0, 1))) / 2
