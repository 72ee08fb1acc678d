"""Coarse-to-fine windows over encoding levels, which mask fine levels while poses are inaccurate (BARF)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from invgraphics.core.field import Encoding


class Windowed(Encoding):
    """An encoding whose features belong to levels, coarse to fine.

    A fit that optimises poses opens a window and moves it (Lin et al. 2021, equation 14); without one nothing is multiplied
    and nothing is saved.

    Attributes:
        levels: number of levels.
        always: levels that are never masked.
        window_alpha: opening of the window, from 0 (only those never masked) to 1 (all levels); ``None`` without a window.
    """

    levels: int
    always: int
    window_alpha: Float[Tensor, ""] | None

    def __init__(self, levels: int, always: int) -> None:
        super().__init__()
        self.levels, self.always = levels, min(always, levels)
        self.register_buffer("window_alpha", None)

    def add_window(self) -> None:
        """Register the window as a buffer of the encoding, initially fully open."""
        reference = next(self.parameters(), torch.zeros(()))
        self.window_alpha = torch.ones((), device=reference.device)

    @override
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Accept the buffer under its first name, ``detail``."""
        if prefix + "detail" in state_dict:
            state_dict[prefix + "window_alpha"] = state_dict.pop(prefix + "detail")
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def level_weights(self) -> Float[Tensor, " levels"] | None:
        """Weight of each level, ``(1 - cos(π clamp(alpha - k, 0, 1))) / 2``; ``None`` without a window."""
        if self.window_alpha is None:
            return None
        reached = self.always + self.window_alpha * (self.levels - self.always)
        level = torch.arange(self.levels, device=self.window_alpha.device)
        return (1 - torch.cos(torch.pi * (reached - level).clamp(0, 1))) / 2
