"""NeRF's synthetic scenes: ``transforms_{train,val,test}.json`` beside folders of RGBA pictures (NeRF, §6.1)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Scene
from invgraphics.scenes.border import BORDERS_OF, plain_border
from invgraphics.scenes.frames import Frames
from invgraphics.scenes.images import Photo, read_pixels
from invgraphics.scenes.layout import (
    BOX_HALF,
    Frame,
    SceneOptions,
    Split,
    box_frame,
    compose,
    contracted_frame,
    evenly,
    existing_photos,
)
from invgraphics.scenes.region import pictured_ball

MARGIN = 1.05
"""Half-edge of a box over the radius that pictures show, where the convention's does not fit; NeRF-synthetic has 1.03."""
CONVENTIONAL = (0.67, 2.0)
"""Ratios of the convention's half-edge to that radius within which its box is taken."""
OFF_CENTRE = 0.5
"""Distance of the pictures' centre from the origin up to which it is, in half-edges."""

_VAL_VIEWS = 4  # looked at during a fit, never scored


class Blender:
    """Loader of NeRF-synthetic folders: OpenGL axes, straight alpha, white background, a box of ±1.5.

    Exports of other sizes and places get a box from what the pictures show, scaled to the same size in the local frame. Opaque
    pictures with a plain border show an object before that colour; other opaque pictures show endless space.
    """

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is a folder with a ``transforms_train.json``."""
        return (path / "transforms_train.json").is_file()

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load the three splits as a scene, photographs read and resized by ``options``.

        Raises:
            InputError: a file is missing or unusable.
        """
        notes: dict[str, str] = {"loader": "blender"}
        train, test = self._photos(path, "train", notes), self._photos(path, "test", notes)
        val = self._photos(path, "val", notes) if (path / "transforms_val.json").is_file() else []
        split = Split(train, test, evenly(val, _VAL_VIEWS), "the data set's own")
        frame = _box_frame(train) if _is_object(train) else contracted_frame(_poses(train))
        return compose(path.resolve().name, split, frame, options, notes)

    def _photos(self, path: Path, split: str, notes: dict[str, str]) -> list[Photo]:
        source = path / f"transforms_{split}.json"
        photos, missing = existing_photos(Frames.read(source).photos(), source)
        notes |= {f"{key}_{split}": value for key, value in missing.items()}
        return photos


def _is_object(photos: Sequence[Photo]) -> bool:
    """Whether pictures show an object: they are transparent around it, or their borders share a colour."""
    pictures = [read_pixels(photo.path) for photo in evenly(photos, BORDERS_OF)]
    clear = any(pixels.shape[2] == 4 and pixels[..., 3].min() < 255 for pixels in pictures)
    return clear or plain_border(pictures) is not None


def _box_frame(photos: Sequence[Photo]) -> Frame:
    """Frame of an object in a box: the convention's, where the pictures show about that much of the world around the origin."""
    seen = pictured_ball([photo.camera for photo in photos])
    if seen is None:
        return contracted_frame(_poses(photos))
    centre, radius = seen
    least, most = CONVENTIONAL
    if float(centre.norm()) <= OFF_CENTRE * BOX_HALF and least * radius <= BOX_HALF <= most * radius:
        centre, half = torch.zeros_like(centre), BOX_HALF
    else:
        half = MARGIN * radius
    return box_frame(centre - half, centre + half)


def _poses(photos: Sequence[Photo]) -> Float[Tensor, "n 4 4"]:
    return torch.stack([photo.camera.cam_to_world for photo in photos])
