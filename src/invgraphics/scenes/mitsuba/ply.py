"""Polygon File Format for triangle meshes: binary, little-endian."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from invgraphics.errors import InputError
from invgraphics.files import write_bytes

_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


def write(
    path: Path,
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"] | None = None,
    uv: Float[np.ndarray, "v 2"] | None = None,
) -> None:
    """Write a mesh, optionally with a normal and a texture coordinate per vertex."""
    columns, names = [vertices], ["x", "y", "z"]
    for values, extra in ((normals, ["nx", "ny", "nz"]), (uv, ["u", "v"])):
        if values is not None:
            columns.append(values)
            names += extra
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    records = np.empty(len(faces), _FACE)
    records["count"], records["corners"] = 3, faces
    body = np.concatenate(columns, axis=1).astype("<f4").tobytes() + records.tobytes()
    write_bytes(path, "\n".join(header).encode() + body)


def read(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Read vertices and faces of a mesh written by `write`.

    Raises:
        InputError: it is not such a file.
    """
    header, found, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii", errors="replace").split("\n")
    counts = {words[1]: int(words[2]) for words in map(str.split, lines) if words[:1] == ["element"] and len(words) == 3}
    columns = sum(line.startswith("property float ") for line in lines)
    split = counts.get("vertex", 0) * columns * 4
    expected = split + counts.get("face", 0) * _FACE.itemsize
    if not found or "format binary_little_endian 1.0" not in lines or columns < 3 or len(body) != expected:
        raise InputError(f"{path} is not a binary triangle mesh as this program writes it.", "Make the scene again.")
    vertices = np.frombuffer(body[:split], "<f4").reshape(-1, columns)[:, :3].copy()
    return vertices, np.frombuffer(body[split:], _FACE)["corners"].astype(np.int64)


def weld(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Merge vertices at the same place (float32) and drop triangles that this collapses."""
    unique, index = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True)
    welded = index.reshape(-1)[faces]
    a, b, c = welded.T
    return unique, welded[(a != b) & (b != c) & (c != a)]
