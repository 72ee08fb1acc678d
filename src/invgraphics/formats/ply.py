"""The PLY file of 3DGS's authors (Kerbl et al. 2023): float32, before activation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Gaussians, harmonics
from invgraphics.errors import InputError
from invgraphics.formats.base import ANTIALIASED, SMALLEST_SCALE, Splats
from invgraphics.formats.ply_elements import columns, missing, read_elements, write_element

POSITION, NORMAL, DC, OPACITY = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2"), ("opacity",)
SCALE, ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
NEEDED = (*POSITION, *DC, *OPACITY, *SCALE, *ROTATION)
"""Properties without which there are no Gaussians; normals are written as zeros and ignored."""
FILTER = ("filter_3D",)
"""Standard deviation of a 3D smoothing filter that scales and opacities are stored without (Yu et al. 2024, Mip-Splatting)."""

OPACITY_EPS = 1e-7
"""Opacities are kept this far from 0 and 1, whose logits are infinite."""


FILTERED = "Its 3D smoothing filter (filter_3D) was applied."
"""Note of a file of Mip-Splatting or its successors, whose 2D filter (variance 0.1, with compensation) belongs to it."""


@dataclass(frozen=True)
class Ply:
    """Logits of opacities, logarithms of scales, quaternions (w, x, y, z); colour channels one after the other."""

    suffixes: ClassVar[tuple[str, ...]] = (".ply",)
    axes: ClassVar[str | None] = None
    sh_degree: ClassVar[int] = harmonics.MAX_DEGREE
    """What 3DGS's own loader and many after it insist on."""

    def matches(self, path: Path, head: bytes) -> bool:
        """Any PLY file: those that hold no Gaussians are refused with a sentence."""
        return head.startswith(b"ply")

    def read(self, path: Path) -> Splats:
        """Read a file of any SH degree up to 3; other properties and elements are ignored.

        A `FILTER` is applied: scales are widened by it, and opacities lowered so that the integral stays (Mip-Splatting, §5.1).

        Raises:
            InputError: it is no PLY file, is cut off, or lacks properties.
        """
        tables, comments = read_elements(path)
        table = tables.get("vertex", np.empty(0))
        lacking = missing(table, NEEDED)
        if lacking:
            raise InputError(
                f"'{path}' holds no 3D Gaussians: its vertices lack {', '.join(lacking)}.",
                "Expected x y z f_dc_0..2 opacity scale_0..2 rot_0..3, as 3DGS writes them.",
            )
        rest = rest_names(path, table.dtype.names or ())
        scales, opacities, notes = columns(table, SCALE).exp(), columns(table, OPACITY)[:, 0].sigmoid(), comments
        if not missing(table, FILTER):
            wide = torch.hypot(scales, columns(table, FILTER))
            scales, opacities = wide, opacities * (scales / wide.clamp_min(SMALLEST_SCALE)).prod(dim=1)
            notes = (*notes, FILTERED)
        gaussians = Gaussians(
            means=columns(table, POSITION),
            quaternions=columns(table, ROTATION),
            scales=scales,
            opacities=opacities,
            sh=coefficients(columns(table, DC), columns(table, rest) if rest else None),
        )
        compensated = FILTERED in notes or any(ANTIALIASED in note for note in comments)
        return Splats(gaussians, antialiased=True if compensated else None, notes=notes)

    def write(self, path: Path, splats: Splats) -> None:
        """Write the standard properties in the standard order, 62 floats at degree 3; notes become comments."""
        gaussians = splats.gaussians
        n, rest = len(gaussians), gaussians.sh[:, 1:].permute(0, 2, 1).reshape(len(gaussians), -1)
        names = (*POSITION, *NORMAL, *DC, *(f"f_rest_{i}" for i in range(rest.shape[1])), *OPACITY, *SCALE, *ROTATION)
        values = [gaussians.means, torch.zeros(n, 3), gaussians.sh[:, 0], rest]
        values += [gaussians.opacities.logit(OPACITY_EPS)[:, None], gaussians.scales.clamp_min(SMALLEST_SCALE).log()]
        values += [torch.nn.functional.normalize(gaussians.quaternions, dim=1)]
        table = torch.cat([value.detach().float().cpu() for value in values], dim=1).numpy().astype("<f4")
        record = np.dtype([(name, "<f4") for name in names])
        write_element(path, "vertex", np.ascontiguousarray(table).view(record)[:, 0], splats.notes)


def rest_names(path: Path, names: tuple[str, ...]) -> list[str]:
    """The properties of the bands above the first, in order.

    Raises:
        InputError: their number belongs to no degree from 0 to 3.
    """
    count = sum(name.startswith("f_rest_") for name in names)
    expected = [3 * (harmonics.count(degree) - 1) for degree in range(harmonics.MAX_DEGREE + 1)]
    rest = [f"f_rest_{i}" for i in range(count)]
    if count not in expected or not set(rest) <= set(names):
        known = ", ".join(map(str, expected))
        raise InputError(
            f"'{path}' has {count} properties f_rest_*, which belong to no SH degree.", f"Expected one of: {known}."
        )
    return rest


def coefficients(dc: Float[Tensor, "n 3"], rest: Float[Tensor, "n r"] | None) -> Float[Tensor, "n k 3"]:
    """SH coefficients from the first band and the others, which come channel by channel."""
    if rest is None:
        return dc[:, None]
    return torch.cat([dc[:, None], rest.view(len(rest), 3, rest.shape[1] // 3).permute(0, 2, 1)], dim=1).contiguous()
