"""Coloured triangle meshes as PLY files, which mesh viewers and Blender read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from invgraphics.files import writing

_VERTEX = np.dtype([(axis, "<f4") for axis in "xyz"] + [(channel, "u1") for channel in ("red", "green", "blue")])
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


def write_mesh(
    path: Path,
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    rgb: UInt8[np.ndarray, "v 3"],
    comments: Sequence[str] = (),
) -> None:
    """Write a mesh whole or not at all, binary and little-endian.

    Args:
        path: the file.
        vertices: places.
        faces: corners, anticlockwise seen from outside.
        rgb: colours of the vertices, display sRGB.
        comments: free text, one line each.
    """
    places = np.empty(len(vertices), _VERTEX)
    for index, (axis, channel) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        places[axis], places[channel] = vertices[:, index], rgb[:, index]
    triangles = np.empty(len(faces), _FACE)
    triangles["count"], triangles["corners"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(vertices)}", *(f"property float {axis}" for axis in "xyz")]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    with writing(path) as file:
        file.write("\n".join(header).encode("ascii", errors="replace"))
        file.write(places.tobytes() + triangles.tobytes())
