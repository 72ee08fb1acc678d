"""Multi-plane images as files: a zip archive of PNG layers and one JSON description, which any program can read."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from invgraphics.core import Camera, Planes
from invgraphics.core.colour import quantise
from invgraphics.errors import InputError
from invgraphics.files import writing
from invgraphics.tables import parse_json

DESCRIPTION = "mpi.json"
FORMAT, VERSION = "multi-plane image", 1
MOST_LAYERS, LARGEST_FILE = 1024, 1 << 28


@dataclass(frozen=True, eq=False)
class PlaneFile:
    """Content of a file of planes.

    Attributes:
        planes: in the data set's world, without view dependence.
        colour: space of the colours, ``srgb`` or ``linear``.
        note: free text.
    """

    planes: Planes
    colour: str = "srgb"
    note: str = ""


def write_mpi(path: Path, content: PlaneFile) -> None:
    """Write planes whole or not at all: ``mpi.json`` and ``layers/000.png`` …, nearest first, straight RGBA of 8 bits.

    The description names the format and its version, the reference camera (``camera_to_world`` with axes right, down, forward;
    ``fx, fy, cx, cy`` in pixels, the first pixel's centre at 0.5), and each layer's file and ``depth`` along the optical axis,
    in units of the world. A ray that meets a layer at image point (x, y) of the reference camera sees that texel's RGBA.
    """
    planes = content.planes
    camera = planes.camera
    names = [f"layers/{index:03}.png" for index in range(len(planes))]
    (fx, fy), (cx, cy) = camera.focal.tolist(), camera.principal_point.tolist()
    description = {
        "format": FORMAT,
        "version": VERSION,
        "camera": {
            "width": camera.width, "height": camera.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy,
            "axes": "+x right, +y down, +z forward", "camera_to_world": camera.cam_to_world.tolist(),
        },
        "layers": [{"file": name, "depth": depth} for name, depth in zip(names, planes.depths.tolist(), strict=True)],
        "order": "nearest first",
        "alpha": "straight",
        "colour": content.colour,
        "note": content.note,
    }  # fmt: skip
    rgba = quantise(torch.cat([planes.rgb, planes.alpha[:, None]], dim=1)).permute(0, 2, 3, 1).cpu().numpy()
    with writing(path) as file, zipfile.ZipFile(file, "w") as archive:
        _add(archive, DESCRIPTION, json.dumps(description, indent=2).encode())
        for name, layer in zip(names, rgba, strict=True):
            picture = io.BytesIO()
            Image.fromarray(np.ascontiguousarray(layer)).save(picture, "PNG")
            _add(archive, name, picture.getvalue())


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add a member with a fixed date, so that equal planes make equal files."""
    archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)


def read_mpi(path: Path) -> PlaneFile:
    """Read a file of `write_mpi`.

    Raises:
        InputError: it is no such file, or damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            description = parse_json(_member(archive, DESCRIPTION).decode("utf-8"), f"{path}: {DESCRIPTION}")
            return _read(archive, description)
    except (OSError, zipfile.BadZipFile, KeyError, TypeError, ValueError, RuntimeError, NotImplementedError) as error:
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{path} is no readable multi-plane image: {detail}.", "Expected a file of `export --to mpi`."
        ) from error


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    size = archive.getinfo(name).file_size
    if size > LARGEST_FILE:
        raise ValueError(f"{name} has {size:,} bytes")
    return archive.read(name)


def _read(archive: zipfile.ZipFile, description: dict[str, Any]) -> PlaneFile:
    if (description["format"], description["version"]) != (FORMAT, VERSION):
        raise ValueError(f"its format is '{description['format']}', version {description['version']}")
    table, layers = description["camera"], description["layers"]
    if not 1 <= len(layers) <= MOST_LAYERS:
        raise ValueError(f"it has {len(layers)} layers")
    size = int(table["width"]), int(table["height"])
    pictures = []
    for layer in layers:
        with Image.open(io.BytesIO(_member(archive, layer["file"]))) as picture:
            if picture.size != size or picture.mode != "RGBA":
                raise ValueError(f"{layer['file']} is {picture.mode} of {picture.size}, not RGBA of {size}")
            pictures.append(np.asarray(picture))
    rgba = torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2).float() / 255
    focal, centre = (torch.tensor([float(table[name]) for name in pair]) for pair in (("fx", "fy"), ("cx", "cy")))
    pose, depths = torch.tensor(table["camera_to_world"]), torch.tensor([float(layer["depth"]) for layer in layers])
    if pose.shape != (4, 4) or not bool(torch.cat([pose.flatten(), depths, focal, centre]).isfinite().all()):
        raise ValueError("its camera is not finite")
    if float(depths[0]) <= 0 or not bool((depths.diff() > 0).all()):
        raise ValueError("its depths do not ascend from above 0")
    planes = Planes(Camera(pose, focal, centre, *size), depths, rgba[:, :3].contiguous(), rgba[:, 3].contiguous())
    return PlaneFile(planes, str(description["colour"]), str(description["note"]))
