"""Photographs with a ``transforms.json``, as nerfstudio and instant-ngp write it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from invgraphics.core import Points, Scene
from invgraphics.errors import InputError
from invgraphics.scenes.frames import Frames, photo_name
from invgraphics.scenes.layout import SceneOptions, Split, compose, every_eighth, existing_photos, scene_name
from invgraphics.scenes.pictures.images import Photo, file_exists
from invgraphics.scenes.ply_points import read_points
from invgraphics.scenes.region import photo_frame

_LISTS = ("train_filenames", "val_filenames", "test_filenames")


class Nerfstudio:
    """Loader of ``transforms.json``: OpenGL axes, OPENCV lenses; endless space, or an object in a box (see `object_frame`).

    Photographs are split as the file's ``train_filenames``, ``val_filenames`` and ``test_filenames`` say; without these, every
    eighth is scored. Poses are taken as they are: an ``applied_transform`` has already been applied to them, and to the points
    of a ``ply_file_path``. Listed photographs that do not exist are skipped and named in the scene's notes.
    """

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is a folder with a ``transforms.json``, or such a file."""
        return _source(path).is_file()

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load cameras, lenses, photographs and known points.

        Raises:
            InputError: a file is missing or unusable.
        """
        source = _source(path)
        frames = Frames.read(source)
        listed = frames.photos()
        photos, notes = existing_photos(listed, source)
        notes["loader"] = "nerfstudio"
        points, points_note = _known_points(frames)
        split = _own_split(frames, listed, photos) or every_eighth(photos)
        return compose(scene_name(source.parent), split, photo_frame(photos, points), options, notes | points_note)


def _known_points(frames: Frames) -> tuple[Points | None, dict[str, str]]:
    """Points of the file's ``ply_file_path``, in the frame of its poses, and a note on them."""
    given = frames.table.get("ply_file_path")
    if given is None:
        return None, {}
    if not isinstance(given, str) or not given.strip("./\\") or "\0" in given:
        raise InputError(f"'ply_file_path' of {frames.path} is {given!r}, not the path of a file.")
    path = frames.path.parent / given.replace("\\", "/")
    if not file_exists(path):
        return None, {"points": f"{given} is absent"}
    points = read_points(path)
    return points, {"points": f"{0 if points is None else len(points)} from {given}"}


def _own_split(frames: Frames, listed: Sequence[Photo], photos: Sequence[Photo]) -> Split | None:
    """The split that the file states; ``None`` where it names none to score. Without a list of test views, ``val`` is it.

    Args:
        frames: the file.
        listed: photographs of all its frames.
        photos: those of them that exist.

    Raises:
        InputError: a list is none, names what no frame has, or shares a photograph with the training list.
    """
    names = {key: _names(frames, key, {photo.name for photo in listed}) for key in _LISTS if key in frames.table}
    if not names:
        return None
    train, val, test = (names.get(key, set[str]()) for key in _LISTS)
    scored, val = (test, val) if test else (val, set[str]())
    if not scored:
        return None
    if "train_filenames" not in names:
        train = {photo.name for photo in listed} - scored - val
    if both := sorted(train & scored):
        raise InputError(
            f"{frames.path} lists {len(both)} photographs both to fit and to score, for instance '{both[0]}'.",
            f"A photograph may stand in one of {', '.join(_LISTS)}.",
        )
    fitted, tested, watched = ([photo for photo in photos if photo.name in chosen] for chosen in (train, scored, val))
    return Split(fitted, tested, watched, rule="the file's own")


def _names(frames: Frames, key: str, known: set[str]) -> set[str]:
    names = frames.table[key]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"'{key}' of {frames.path} is not a list of file names.")
    found = set(map(photo_name, names))
    if unknown := sorted(found - known):
        raise InputError(f"'{key}' of {frames.path} names '{unknown[0]}', which no frame has as its 'file_path'.")
    return found


def _source(path: Path) -> Path:
    return path if path.suffix == ".json" else path / "transforms.json"
