"""COLMAP's binary files compared with their own counts before COLMAP reads them: it trusts counts and never ends on a cut one.

The layout is that of ``scene/reconstruction_io_binary.cc`` in COLMAP 3.12 and later (``rigs.bin`` and ``frames.bin``) and of
the older three files, which have not changed. All numbers are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path

from invgraphics.errors import InputError

_COUNT, _SHORT = struct.Struct("<Q"), struct.Struct("<I")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
_IMAGE = struct.Struct("<I7dI")  # id, rotation, translation, camera; then name, NUL, count of points (24 bytes each)
_POINT = struct.Struct("<Q3d3Bd")  # id, position, colour, error; then count of track elements (8 bytes each)
_RIG, _SENSOR, _POSE = struct.Struct("<II"), struct.Struct("<iI"), struct.Struct("<7d")
_FLAG = struct.Struct("<B")
_FRAME = struct.Struct("<II7dI")  # id, rig, pose, count of data (sensor and 64-bit id)
_DATUM = _SENSOR.size + 8
_BEFORE_NAME = 9  # words of an image's line in text: number, rotation, translation, camera
_DIGITS = 10  # of an image's number


class _TooShortError(Exception):
    """A record extends beyond the end of the file."""


class _Bytes:
    """Cursor over the bytes of a file."""

    def __init__(self, data: bytes) -> None:
        self.data, self.place = data, 0

    def take(self, record: struct.Struct) -> tuple[float, ...]:
        """Read one record and advance."""
        start = self.place
        self.skip(record.size)
        return record.unpack_from(self.data, start)

    def skip(self, size: int) -> None:
        """Advance by ``size`` bytes, which must exist."""
        if size > len(self.data) - self.place:
            raise _TooShortError
        self.place += size


def check_sizes(folder: Path) -> None:
    """Check that every binary file of a COLMAP model is as long as its own counts say.

    Raises:
        InputError: a file is longer or shorter than its counts say, or names an unknown camera model.
    """
    for name, walk in _WALKS.items():
        path = folder / name
        if not path.is_file():
            continue
        try:
            content = _Bytes(path.read_bytes())
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}.") from error
        count = done = 0
        try:
            count = int(content.take(_COUNT)[0])
            # Records have at least 8 bytes, so that an absurd count ends at the end of the file.
            while done < count:
                walk(content, path)
                done += 1
        except _TooShortError:
            what = f"entry {done + 1:,} of {count:,} is not whole" if content.place else "its count is not whole"
            raise InputError(f"{path} is cut off: it has {len(content.data):,} bytes, and {what}.", "Copy it again.") from None
        if content.place != len(content.data):
            rest = len(content.data) - content.place
            raise InputError(f"{path} has {rest:,} bytes more than its {count:,} entries take.", "Copy it again.")


def _camera(content: _Bytes, path: Path) -> None:
    model = int(content.take(_CAMERA)[1])
    lengths = _parameter_counts()
    if model not in lengths:
        raise InputError(f"{path} has a camera of model {model}, which COLMAP does not know.")
    content.skip(8 * lengths[model])


def _image(content: _Bytes, _: Path) -> None:
    content.take(_IMAGE)
    end = content.data.find(b"\0", content.place)
    if end < 0:
        raise _TooShortError
    content.place = end + 1
    content.skip(24 * int(content.take(_COUNT)[0]))


def _point(content: _Bytes, _: Path) -> None:
    content.skip(_POINT.size)
    content.skip(8 * int(content.take(_COUNT)[0]))


def _rig(content: _Bytes, _: Path) -> None:
    sensors = int(content.take(_RIG)[1])
    if not sensors:
        return
    content.skip(_SENSOR.size)  # the reference, which has no pose
    for _sensor in range(sensors - 1):
        content.skip(_SENSOR.size)
        if content.take(_FLAG)[0]:
            content.skip(_POSE.size)


def _frame(content: _Bytes, _: Path) -> None:
    content.skip(_DATUM * int(content.take(_FRAME)[-1]))


_WALKS: dict[str, Callable[[_Bytes, Path], None]] = {
    "cameras.bin": _camera,
    "images.bin": _image,
    "points3D.bin": _point,
    "rigs.bin": _rig,
    "frames.bin": _frame,
}


@cache
def _parameter_counts() -> dict[int, int]:
    """Map COLMAP's id of a camera model to its number of parameters."""
    from invgraphics.scenes.colmap_library import pycolmap

    models = [model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"]
    return {int(model): len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params) for model in models}


def names_in_text(path: Path) -> dict[int, str]:
    """Names with spaces, at which COLMAP cuts them, of an ``images.txt``'s images by their numbers; none beside a binary.

    Each image has a second line, of points: COLMAP takes every second line for one.

    Raises:
        InputError: a line of points is that of another image.
    """
    if not path.is_file() or path.with_suffix(".bin").is_file():
        return {}
    names: dict[int, str] = {}
    lines = iter(path.read_text(encoding="utf-8", errors="replace").splitlines())
    for line in lines:
        if not line.strip() or line.strip().startswith("#"):
            continue
        last = next(lines, "").split()[-1:] or ["0"]
        if not _is_number(last[0]):
            sentence = f"{path} has no line of points after each image: '{last[0]}' follows another image at once."
            raise InputError(sentence, "Add an empty line after each image, as COLMAP writes it.")
        match line.split(maxsplit=_BEFORE_NAME):
            case [number, *rest] if number.isdecimal() and len(number) <= _DIGITS and len(rest[_BEFORE_NAME - 1 :]) == 1:
                if len(rest[-1].split()) > 1:
                    names[int(number)] = rest[-1].rstrip()
    return names


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
