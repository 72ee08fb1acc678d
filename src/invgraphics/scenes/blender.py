"""NeRF's synthetic scenes: ``transforms_{train,val,test}.json`` beside folders of RGBA pictures (NeRF, §6.1)."""

from __future__ import annotations

from pathlib import Path

from invgraphics.core import Scene
from invgraphics.scenes.frames import Frames
from invgraphics.scenes.layout import SceneOptions, Split, compose, evenly, existing_photos
from invgraphics.scenes.pictures.images import Photo, file_exists
from invgraphics.scenes.region import BOX_HALF, photo_frame

_VAL_VIEWS = 4  # monitored during a fit, never scored


class Blender:
    """Loader of NeRF-synthetic folders: OpenGL axes, straight alpha, white background, a box of ±1.5.

    Exports of other sizes and places get a box from what their pictures show. Opaque pictures with a plain border show an
    object before that colour, others endless space.
    """

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is a folder with a ``transforms_train.json``."""
        return (path / "transforms_train.json").is_file()

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load the three splits as a scene, photographs read and resized by ``options``; of ``val`` what there is.

        Raises:
            InputError: a file is missing or unusable.
        """
        notes: dict[str, str] = {"loader": "blender"}
        train, test = self._photos(path, "train", notes), self._photos(path, "test", notes)
        val = self._photos(path, "val", notes) if (path / "transforms_val.json").is_file() else []
        split = Split(train, test, evenly(val, _VAL_VIEWS), "the data set's own")
        return compose(path.resolve().name, split, photo_frame(train, conventional=BOX_HALF), options, notes)

    def _photos(self, path: Path, split: str, notes: dict[str, str]) -> list[Photo]:
        source = path / f"transforms_{split}.json"
        listed = Frames.read(source).photos()
        if split == "val" and not any(file_exists(photo.path) for photo in listed):  # nothing is fitted to them, nor scored
            notes["missing_val"] = f"none of the {len(listed)} listed files exists"
            return []
        photos, missing = existing_photos(listed, source)
        notes |= {f"{key}_{split}": value for key, value in missing.items()}
        return photos
