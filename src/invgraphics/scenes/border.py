"""Background of a scene's pictures, which fields need not fill space for: under alpha, or the one colour around an object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from invgraphics.core import View

T = TypeVar("T")

LOOKED_AT = 8
"""Number of pictures that are examined, about."""
CLEAR_SHARE = 0.05
"""Share of transparent pixels from which an object stands by itself; fewer are a window, or what undistortion left blank."""
PLAIN_SHARE = 0.9
"""Share of their border pixels that have the colour; an object may be cut off by some."""
SAME_COLOUR = 10
"""Largest difference to it in any channel, of 255: compression is not exact."""


def looked_at(items: Sequence[T]) -> Sequence[T]:
    """About `LOOKED_AT` of a scene's pictures, evenly spaced."""
    return items[:: max(1, len(items) // LOOKED_AT)]


def plain_border(pictures: Sequence[UInt8[np.ndarray, "h w c"]]) -> Float[Tensor, 3] | None:
    """Colour that the borders of pictures share, in [0, 1]; ``None`` where they do not."""
    edges = [edge[:, :3] for pixels in pictures for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1])]
    border = np.concatenate(edges).astype(np.float32)
    colour = np.median(border, axis=0)
    plain = (np.abs(border - colour) <= SAME_COLOUR).all(axis=1).mean() >= PLAIN_SHARE
    return torch.from_numpy(colour) / 255 if plain else None


def is_object(pictures: Sequence[UInt8[np.ndarray, "h w c"]], black: bool) -> bool:
    """Whether pictures show an object by itself: they are transparent around it, or their borders share a colour.

    Args:
        pictures: straight colour, or colour and alpha.
        black: whether that colour may be black.
    """
    if np.mean([(pixels[..., 3] < 128).mean() if pixels.shape[2] == 4 else 0.0 for pixels in pictures]) >= CLEAR_SHARE:
        return True
    colour = plain_border(pictures)
    return colour is not None and (black or float(colour.max()) > SAME_COLOUR / 255)


def masking_blank(views: Sequence[View]) -> tuple[list[View], dict[str, str]]:
    """Views of an endless space, with their few transparent pixels masked: something is there, but not in the picture.

    Returns:
        The views, and a note where any has changed; as they are where they are transparent around an object.
    """
    clear = [0.0 if view.alpha is None else float((view.opacity() < 0.5).float().mean()) for view in views]
    share = sum(clear) / len(clear)
    if share >= CLEAR_SHARE or all(view.alpha is None for view in views):
        return list(views), {}
    return [_masked(view) for view in views], {"alpha": f"transparent pixels ({100 * share:.2g} %) are masked"}


def _masked(view: View) -> View:
    if view.alpha is None:
        return view
    seen = view.opacity() >= 0.5
    if bool(seen.all()):
        return replace(view, alpha=None)
    return replace(view, alpha=None, mask=seen & view.valid())


def background_of(views: Sequence[View]) -> Float[Tensor, 3]:
    """Background of views: white under alpha, the colour of a plain border, else black, which nothing shows through to."""
    if any(view.alpha is not None for view in views):
        return torch.ones(3)
    colour = None
    if all(view.mask is None for view in views):
        colour = plain_border([view.image.cpu().numpy() for view in looked_at(views)])
    return torch.zeros(3) if colour is None else colour
