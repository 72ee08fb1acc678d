"""Reader of ``transforms.json`` and its variants: frames with OpenGL poses, intrinsics per frame or per file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from invgraphics.core import Camera
from invgraphics.core.believable import LONGEST_SIDE
from invgraphics.core.transforms import focal_from_fov, opengl_to_opencv
from invgraphics.errors import InputError
from invgraphics.scenes.layout import IMAGE_FOLDERS
from invgraphics.scenes.pictures.images import SUFFIXES, Photo, file_exists, stored_size
from invgraphics.scenes.pictures.lens import Lens
from invgraphics.scenes.poses import pose
from invgraphics.tables import read_json

_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_LONGEST_PATH = 1000
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")


@dataclass(frozen=True, eq=False)
class Frames:
    """Content of a ``transforms*.json``, with validated top-level structure.

    Attributes:
        path: the file.
        table: its top level.
        frames: its list of frames.
    """

    path: Path
    table: Mapping[str, Any]
    frames: Sequence[Mapping[str, Any]]

    @staticmethod
    def read(path: Path) -> Frames:
        """Read and validate a ``transforms*.json``.

        Raises:
            InputError: it is missing, no JSON (line and column are given), or has no frames.
        """
        table = read_json(path)
        frames = table.get("frames") if isinstance(table, dict) else None
        if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
            raise InputError(
                f"{path} has no list of 'frames'.", "Expected a transforms.json of NeRF, instant-ngp or nerfstudio."
            )
        return Frames(path, table, frames)

    def photos(self) -> list[Photo]:
        """Convert the frames to photographs with cameras, in the file's order, whether their files exist or not.

        Raises:
            InputError: a key is missing or a value unusable; the sentence names the file, the frame and the key.
        """
        return [self._photo(index) for index in range(len(self.frames))]

    @cached_property
    def _files(self) -> list[Path]:
        """The frames' photographs, whether they exist or not."""
        return [_find(self.path.parent, self._text(index)) for index in range(len(self.frames))]

    @cached_property
    def _first(self) -> tuple[Path, tuple[int, int]] | None:
        """The first photograph that exists, and its stored width and height."""
        file = next((file for file in self._files if file_exists(file)), None)
        return None if file is None else (file, stored_size(file))

    def _where(self, index: int) -> str:
        return f"{self.path}, frame {index} ('{self.frames[index].get('file_path', '?')}')"

    def _text(self, index: int) -> str:
        return self._path(index, "file_path")

    def _path(self, index: int, key: str) -> str:
        value = self.frames[index].get(key)
        if not isinstance(value, str) or not value.strip("./\\") or "\0" in value or len(value) > _LONGEST_PATH:
            raise InputError(f"{self.path}, frame {index}, has no '{key}' that could be one.")
        return value

    def _number(self, index: int, key: str) -> float | None:
        """Number under ``key`` of the frame, else of the file."""
        value = self._given(index, key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"'{key}' of {self._where(index)} is {value!r}, not a finite number.")
        return float(value)

    def _photo(self, index: int) -> Photo:
        if "transform_matrix" not in self.frames[index]:
            raise InputError(f"{self._where(index)} has no 'transform_matrix'.")
        cam_to_world = opengl_to_opencv(pose(self.frames[index]["transform_matrix"], self._where(index)))
        width, height = self._size(index)
        fx, fy = self._focal(index, width, height)
        cx, cy = self._number(index, "cx"), self._number(index, "cy")
        focal, centre = [fx, fy], [width / 2 if cx is None else cx, height / 2 if cy is None else cy]
        number = torch.float64
        camera = Camera(cam_to_world, torch.tensor(focal, dtype=number), torch.tensor(centre, dtype=number), width, height)
        lens = self._lens(index, (*focal, *centre), (width, height))
        return Photo(self._files[index], camera, photo_name(self._text(index)), lens, mask=self._mask(index))

    def _mask(self, index: int) -> Path | None:
        """The frame's ``mask_path`` (nerfstudio)."""
        if self.frames[index].get("mask_path") is None:
            return None
        return self.path.parent / self._path(index, "mask_path").replace("\\", "/")

    def _size(self, index: int) -> tuple[int, int]:
        """Width and height stated by the file, else of the frame's photograph, or where that is missing of the first one."""
        w, h = self._number(index, "w"), self._number(index, "h")
        if w is None or h is None:
            return self._stored_size(index)
        if not (1 <= w <= LONGEST_SIDE and 1 <= h <= LONGEST_SIDE):
            raise InputError(f"'w' and 'h' of {self._where(index)} are {w:g} and {h:g}, not a size in pixels.")
        return round(w), round(h)

    def _stored_size(self, index: int) -> tuple[int, int]:
        if self._first is None:
            return 1, 1
        file, (first, like) = self._files[index], self._first
        width, height = stored_size(file) if file_exists(file) else like
        if self._number(index, "fl_x") is None and abs(width * like[1] - height * like[0]) > max(width, height, *like):
            sizes = f"{width}x{height} pixels and {first.name} {like[0]}x{like[1]}"
            remedy = "Give each frame its 'w', 'h' and 'fl_x'."
            raise InputError(f"{file} has {sizes}: one angle of view cannot be that of both shapes.", remedy)
        return width, height

    def _focal(self, index: int, width: int, height: int) -> tuple[float, float]:
        fx, fy = self._number(index, "fl_x"), self._number(index, "fl_y")
        angle_x, angle_y = self._number(index, "camera_angle_x"), self._number(index, "camera_angle_y")
        if fx is None and angle_x is not None and 0 < angle_x < math.pi:
            fx = focal_from_fov(angle_x, width)
        if fy is None and angle_y is not None and 0 < angle_y < math.pi:
            fy = focal_from_fov(angle_y, height)
        fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
        if fx is None or fy is None:
            raise InputError(f"{self._where(index)} has no focal length.", "Expected 'fl_x' in pixels or 'camera_angle_x'.")
        if fx <= 0 or fy <= 0:
            raise InputError(f"The focal length of {self._where(index)} is {fx:g}, {fy:g}, not positive.")
        return fx, fy

    def _given(self, index: int, key: str) -> object:
        """A frame's own value, or the file's; ``None`` where neither has one."""
        own = self.frames[index].get(key)
        return self.table.get(key) if own is None else own

    def _lens(self, index: int, pinhole: tuple[float, ...], size: tuple[int, int]) -> Lens | None:
        """Lens of OPENCV (k1 k2 p1 p2 k3), FULL_OPENCV (k4 k5 k6 too) or OPENCV_FISHEYE (k1 to k4); ``None`` for a pinhole.

        What nerfstudio and Metashape call k4 of an OPENCV lens is a fourth term of its polynomial, which no model here has;
        FULL_OPENCV's k4 is the first of its denominator.
        """
        k1, k2, p1, p2, *more = (self._number(index, key) or 0.0 for key in _COEFFICIENTS)
        model = str(self._given(index, "camera_model") or "OPENCV")
        fisheye = model == "OPENCV_FISHEYE" or self._given(index, "is_fisheye") is True
        if fisheye:
            lens = Lens("OPENCV_FISHEYE", (*pinhole, k1, k2, *more[:2]), *size)
        elif model in _PINHOLES:
            return None
        elif model in ("OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV"):
            if not any((k1, k2, p1, p2, *more)):  # known without pycolmap, whose import takes as long as many a scene
                return None
            if model != "FULL_OPENCV" and any(more[1:]):
                named = next(key for key, value in zip(("k4", "k5", "k6"), more[1:], strict=True) if value)
                raise InputError(
                    f"{self._where(index)} has a '{named}' that is not 0, which the camera model {model} does not have here.",
                    "Calibrate with k1 to k3; or name FULL_OPENCV, if k4 to k6 are the denominator of OpenCV's rational model.",
                )
            kind, rational = ("FULL_OPENCV", more) if any(more) else ("OPENCV", [])
            lens = Lens(kind, (*pinhole, k1, k2, p1, p2, *rational), *size)
        else:
            remedy = "Known: OPENCV, OPENCV_FISHEYE, SIMPLE_RADIAL, RADIAL, FULL_OPENCV, PINHOLE, SIMPLE_PINHOLE."
            raise InputError(f"{self.path} has the camera model '{model}', which is not supported.", remedy)
        return None if lens.is_pinhole() else lens


def photo_name(file_path: str) -> str:
    """Name of the photograph at a ``file_path``, whichever way its folders are separated."""
    return file_path.replace("\\", "/").removeprefix("./")


def _find(folder: Path, file_path: str) -> Path:
    """Find the file of a frame's photograph, whose suffix may be left out."""
    path = folder / file_path.replace("\\", "/")
    if file_exists(path):
        return path
    first, *rest = photo_name(file_path).split("/")
    if first == IMAGE_FOLDERS[0] and rest and not (folder / first).is_dir():  # scaled copies alone were kept
        copies = [folder.joinpath(name, *rest) for name in IMAGE_FOLDERS if name.startswith(f"{first}_")]
        if found := next((copy for copy in copies if file_exists(copy)), None):
            return found
    for suffix in SUFFIXES:
        for candidate in (path.with_name(path.name + suffix), path.with_name(path.name + suffix.upper())):
            if file_exists(candidate):
                return candidate
    return path
