"""Photographs with a ``transforms.json``, as nerfstudio and instant-ngp write it."""

from __future__ import annotations

from pathlib import Path

from invgraphics.core import Scene
from invgraphics.scenes.frames import Frames
from invgraphics.scenes.layout import SceneOptions, compose, every_eighth, existing_photos, scene_name
from invgraphics.scenes.region import photo_frame


class Nerfstudio:
    """Loader of ``transforms.json``: OpenGL axes, OPENCV lenses, every eighth photograph scored; an unbounded scene, or
    an object in a box (see `object_frame`).

    Poses are taken as they are: an ``applied_transform`` has already been applied to them. Listed photographs that do not
    exist are skipped and named in the scene's notes.
    """

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is a folder with a ``transforms.json``, or such a file."""
        return _source(path).is_file()

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load cameras, lenses and photographs.

        Raises:
            InputError: a file is missing or unusable.
        """
        source = _source(path)
        frames = Frames.read(source)
        photos, notes = existing_photos(frames.photos(), source)
        notes["loader"] = "nerfstudio"
        if "ply_file_path" in frames.table:
            notes["points"] = f"{frames.table['ply_file_path']} is not read"
        if any("mask_path" in frame for frame in frames.frames):
            notes["masks"] = "the frames' mask_path is not read"
        return compose(scene_name(source.parent), every_eighth(photos), photo_frame(photos), options, notes)


def _source(path: Path) -> Path:
    return path if path.suffix == ".json" else path / "transforms.json"
