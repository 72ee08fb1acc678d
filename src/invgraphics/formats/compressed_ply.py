"""PlayCanvas's compressed PLY, as SuperSplat writes it: integers of few bits, relative to the range of a chunk."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Gaussians, harmonics
from invgraphics.errors import InputError
from invgraphics.formats.base import Splats, complete_quaternions
from invgraphics.formats.ply import coefficients, rest_names
from invgraphics.formats.ply_elements import columns, missing, read_elements

CHUNK = 256
"""Gaussians that share a range."""
SH_RANGE = 8.0
"""Width of the interval around zero that SH coefficients of the upper bands are stored in."""

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
RANGES = tuple(f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in "xyz")
"""Ends of a chunk's positions, then of its logarithms of scales."""
COLOUR_RANGES = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb")
THIRDS = ((21, 11), (11, 10), (0, 11))
"""Shift and number of bits of the three values in one integer: positions and logarithms of scales."""
BYTES = ((24, 8), (16, 8), (8, 8), (0, 8))
SMALLEST = ((20, 10), (10, 10), (0, 10))


@dataclass(frozen=True)
class CompressedPly:
    """16 bytes for each Gaussian, and a byte for each SH coefficient above the first band. Read only."""

    suffixes: ClassVar[tuple[str, ...]] = (".compressed.ply",)
    axes: ClassVar[str | None] = None

    def matches(self, path: Path, head: bytes) -> bool:
        """A PLY file with packed properties."""
        return head.startswith(b"ply") and any(name.encode() in head for name in PACKED)

    def read(self, path: Path) -> Splats:
        """Read a file.

        Raises:
            InputError: it is cut off, or properties are missing.
        """
        tables, comments = read_elements(path)
        empty = np.empty(0)
        chunks, table = tables.get("chunk", empty), tables.get("vertex", empty)
        lacking = missing(table, PACKED) + missing(chunks, RANGES)
        if lacking:
            raise InputError(f"'{path}' is no compressed PLY of 3D Gaussians: it lacks {', '.join(lacking)}.")
        if len(chunks) * CHUNK < len(table):
            raise InputError(f"'{path}' has {len(table)} Gaussians and only {len(chunks)} chunks of {CHUNK}.")
        chunk = np.arange(len(table)) // CHUNK
        rgba = unpack(table["packed_color"], BYTES)
        rgb = rgba[:, :3]
        if not missing(chunks, COLOUR_RANGES):
            rgb = lerp(columns(chunks, COLOUR_RANGES)[chunk], rgb)
        gaussians = Gaussians(
            means=lerp(columns(chunks, RANGES[:6])[chunk], unpack(table["packed_position"], THIRDS)),
            quaternions=rotations(table["packed_rotation"]),
            scales=lerp(columns(chunks, RANGES[6:])[chunk], unpack(table["packed_scale"], THIRDS)).exp(),
            opacities=rgba[:, 3],
            sh=coefficients((rgb - 0.5) / harmonics.BAND_0, self._rest(path, tables, len(table))),
        )
        return Splats(gaussians, notes=comments)

    def _rest(self, path: Path, tables: dict[str, np.ndarray], count: int) -> Float[Tensor, "n r"] | None:
        """SH coefficients of the upper bands: middles of 256 equal steps, but for both ends, which are exact."""
        if "sh" not in tables:
            return None
        names = rest_names(path, tables["sh"].dtype.names or ())
        if len(tables["sh"]) != count:
            raise InputError(f"'{path}' has {count} Gaussians, but the SH coefficients of {len(tables['sh'])}.")
        if not names:
            return None
        stored = columns(tables["sh"], names)
        unit = ((stored + 0.5) / 256).where(stored > 0, torch.zeros(())).where(stored < 255, torch.ones(()))
        return (unit - 0.5) * SH_RANGE


def unpack(packed: np.ndarray, parts: tuple[tuple[int, int], ...]) -> Float[Tensor, "n p"]:
    """Values in [0, 1] that share one integer, each given by its shift and its number of bits."""
    words = torch.from_numpy(packed.astype(np.int64))
    return torch.stack([((words >> shift) & ((1 << bits) - 1)).float() / ((1 << bits) - 1) for shift, bits in parts], dim=1)


def lerp(ends: Float[Tensor, "n 6"], share: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Values at ``share`` of the way between the lower ends (first three columns) and the upper ones."""
    return ends[:, :3] * (1 - share) + ends[:, 3:] * share


def rotations(packed: np.ndarray) -> Float[Tensor, "n 4"]:
    """Unit quaternions (w, x, y, z) from the index of their largest component and the three others, in order."""
    largest = torch.from_numpy((packed >> 30).astype(np.int64))
    others = (unpack(packed, SMALLEST) - 0.5) * sqrt(2)
    return complete_quaternions(largest, others)
