"""Random pixels of training views: among those that count, or those with alpha, found by rejection."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from invgraphics.core import View

REJECTION_FACTOR = 16
"""Candidates drawn per pixel before all that are wanted are listed: enough where a tenth of all pixels is wanted."""


class RandomPixels:
    """Draws flat indices of views' pixels; all randomness comes from the generator it is given.

    What has to be looked for in whole pictures, 2 ms in one of 800 x 800 pixels, is kept: shares, and lists of pixels where
    rejection finds too few, which are short for that reason.
    """

    def __init__(self, generator: torch.Generator) -> None:
        self._generator = generator
        self._covered: dict[tuple[int, ...], float] = {}
        self._lists: dict[tuple[int, ...], Int[Tensor, " k"]] = {}

    def draw(self, index: int, view: View, count: int, foreground: int = 0) -> Int[Tensor, " n"]:
        """Draw ``count`` pixels within a view's mask, the first ``foreground`` of them among those with alpha.

        Args:
            index: of the training view; with the picture's size it names what is kept.
            view: the view at this size.
            count: of pixels.
            foreground: how many of them; 0 where no pixel has alpha.
        """
        inside = [self._draw(index, view, foreground, with_alpha=True)] if foreground else []
        return torch.cat([*inside, self._draw(index, view, count - foreground, with_alpha=False)])

    def covered(self, index: int, view: View) -> float:
        """Share of the pixels within a view's mask that have alpha; the arguments are those of `draw`."""
        key = index, view.camera.width, view.camera.height
        if key not in self._covered:
            valid = _wanted(view, with_alpha=False).count_nonzero()
            self._covered[key] = int(_wanted(view, with_alpha=True).count_nonzero()) / int(valid)
        return self._covered[key]

    def _draw(self, index: int, view: View, count: int, with_alpha: bool) -> Int[Tensor, " n"]:
        pixels = view.camera.width * view.camera.height
        if view.mask is None and not with_alpha:
            return torch.randint(pixels, (count,), generator=self._generator)
        drawn = torch.randint(pixels, (REJECTION_FACTOR * count,), generator=self._generator)
        kept = drawn[_wanted(view, with_alpha, drawn)]
        if len(kept) < count:
            key = index, view.camera.width, view.camera.height, with_alpha
            if key not in self._lists:
                self._lists[key] = _wanted(view, with_alpha).nonzero()[:, 0].int()
            every = self._lists[key]
            more = every[torch.randint(len(every), (count - len(kept),), generator=self._generator)]
            kept = torch.cat([kept, more.long()])
        return kept[:count]


def _wanted(view: View, with_alpha: bool, flat: Int[Tensor, " n"] | None = None) -> Bool[Tensor, " n"]:
    """Whether pixels are within a view's mask and, if asked for, have alpha; all pixels, or those with indices ``flat``."""
    layers = [view.mask, view.alpha if with_alpha else None]
    found = [(layer.reshape(-1) if flat is None else layer.reshape(-1)[flat]) > 0 for layer in layers if layer is not None]
    if not found:
        return torch.ones(view.camera.width * view.camera.height if flat is None else len(flat), dtype=torch.bool)
    return found[0] if len(found) == 1 else found[0] & found[1]
