"""The ``.splat`` file of antimatter15's viewer: 32 bytes for each Gaussian, colour without view dependence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from invgraphics.core import Gaussians, harmonics
from invgraphics.core.colour import quantise
from invgraphics.errors import InputError
from invgraphics.formats.base import Splats

RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


@dataclass(frozen=True)
class Splat:
    """Positions and scales are float32; the colour at SH degree 0, opacity and quaternion are bytes. There is no header."""

    suffixes: ClassVar[tuple[str, ...]] = (".splat",)
    axes: ClassVar[str | None] = None

    def matches(self, path: Path, head: bytes) -> bool:
        """Known by its name only."""
        return path.suffix.lower() in self.suffixes

    def read(self, path: Path) -> Splats:
        """Read a file.

        Raises:
            InputError: its length is no multiple of 32 bytes, or a scale is negative.
        """
        data = path.read_bytes()
        if len(data) % RECORD.itemsize:
            raise InputError(
                f"'{path}' is cut off, or no .splat file: {len(data)} bytes are no multiple of {RECORD.itemsize}.",
                "Copy the file again.",
            )
        table = np.frombuffer(data, RECORD)
        scales = torch.from_numpy(table["scale"].copy())
        if bool((scales < 0).any()):
            raise InputError(f"'{path}' is no .splat file: {int((scales < 0).any(dim=1).sum())} of its scales are negative.")
        rgba = torch.from_numpy(table["rgba"].astype(np.float32)) / 255
        gaussians = Gaussians(
            means=torch.from_numpy(table["position"].copy()),
            quaternions=(torch.from_numpy(table["rotation"].astype(np.float32)) - 128) / 128,
            scales=scales,
            opacities=rgba[:, 3],
            sh=((rgba[:, :3] - 0.5) / harmonics.BAND_0)[:, None],
        )
        return Splats(gaussians)

    def write(self, path: Path, splats: Splats) -> None:
        """Write a file, large and opaque Gaussians first, as viewers show them while they load."""
        gaussians = splats.gaussians
        order = (gaussians.scales.prod(dim=1) * gaussians.opacities).argsort(descending=True, stable=True)
        rgba = torch.cat([0.5 + harmonics.BAND_0 * gaussians.sh[:, 0], gaussians.opacities[:, None]], dim=1)
        turn = torch.nn.functional.normalize(gaussians.quaternions, dim=1)
        table = np.empty(len(gaussians), RECORD)
        table["position"], table["scale"] = gaussians.means[order].numpy(), gaussians.scales[order].numpy()
        table["rgba"] = quantise(rgba[order]).numpy()
        table["rotation"] = (turn[order] * 128 + 128).round().clamp(0, 255).to(torch.uint8).numpy()
        path.write_bytes(table.tobytes())
