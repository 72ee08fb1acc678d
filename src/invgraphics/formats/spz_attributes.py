"""The attributes of an SPZ file as bytes: fixed-point positions, logarithms of scales, and so on.

The format is described at https://github.com/nianticlabs/spz; rotations have three components in versions 1 and 2, and the
smallest three of four from version 3 on.
"""

from __future__ import annotations

from math import floor, log2, sqrt

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from invgraphics.core import Gaussians, harmonics
from invgraphics.errors import InputError
from invgraphics.formats.base import SMALLEST_SCALE, complete_quaternions

Bytes = UInt8[np.ndarray, "n b"]

NAMES = ("positions", "alphas", "colours", "scales", "rotations", "sh")
"""Attributes in the order of their streams."""

POSITION_LIMIT = (1 << 23) - 1
"""Largest fixed-point number of 24 bits with a sign."""
MOST_FRACTION_BITS = 20
"""Finer steps than 2^-20 are beyond what float32 resolves at a distance of 16."""
COLOUR_RANGE = 0.15
"""Slope between the first band's coefficients and colour bytes; leaves room for colours beyond [0, 1]."""
SCALE_STEPS, SCALE_SHIFT = 16, 10.0
"""Steps of a scale's natural logarithm per unit, and its smallest value (negated)."""
SH_STEPS = 128
SH_BITS = (5, 4)
"""Bits kept of the second band's coefficients, and of those above: what the format's authors keep."""
MAGNITUDE = 511
"""Largest magnitude of a component of 9 bits, which stands for 1/√2."""


def widths(version: int, degree: int) -> dict[str, int]:
    """Bytes of each attribute of one Gaussian."""
    position, rotation = 6 if version == 1 else 9, 4 if version >= 3 else 3
    return dict(zip(NAMES, (position, 1, 3, 3, rotation, 3 * (harmonics.count(degree) - 1)), strict=True))


def fraction_bits(means: Float[Tensor, "n 3"]) -> int:
    """Largest number of fractional bits with which all positions fit into 24-bit fixed point.

    Raises:
        InputError: a position is too far away for any.
    """
    farthest = float(means.abs().max())
    bits = MOST_FRACTION_BITS if farthest == 0 else min(MOST_FRACTION_BITS, floor(log2(POSITION_LIMIT / farthest)))
    if bits < 0:
        raise InputError(f"A Gaussian lies {farthest:.3g} units from the origin; SPZ holds up to {POSITION_LIMIT}.", "Use PLY.")
    return bits


def pack(gaussians: Gaussians, fraction: int) -> dict[str, Bytes]:
    """Attributes of version 4, rounded to the nearest; what lies out of a byte's range goes to its end."""
    fixed = (gaussians.means.double() * 2.0**fraction).round().int().numpy().astype("<i4")
    colours = (gaussians.sh[:, 0] * COLOUR_RANGE + 0.5) * 255
    log_scales = gaussians.scales.clamp_min(SMALLEST_SCALE).log()
    return {
        "positions": fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3].reshape(-1, 9),
        "alphas": _to_bytes(gaussians.opacities * 255)[:, None],
        "colours": _to_bytes(colours),
        "scales": _to_bytes((log_scales + SCALE_SHIFT) * SCALE_STEPS),
        "rotations": _pack_rotations(gaussians.quaternions),
        "sh": _pack_sh(gaussians.sh[:, 1:]),
    }


def unpack(attributes: dict[str, Bytes], version: int, fraction: int) -> Gaussians:
    """Inverse of `pack`, of any version; bands above the third are left out."""
    floats = {name: torch.from_numpy(values.astype(np.float32)) for name, values in attributes.items() if name != "positions"}
    dc = (floats["colours"] / 255 - 0.5) / COLOUR_RANGE
    sh = (floats["sh"] - SH_STEPS) / SH_STEPS
    rest = sh.view(len(sh), sh.shape[1] // 3, 3)[:, : harmonics.count(harmonics.MAX_DEGREE) - 1]
    rotations = attributes["rotations"]
    return Gaussians(
        means=_unpack_positions(attributes["positions"], version, fraction),
        quaternions=_unpack_rotations(rotations) if version >= 3 else _unpack_short_rotations(rotations),
        scales=(floats["scales"] / SCALE_STEPS - SCALE_SHIFT).exp(),
        opacities=floats["alphas"][:, 0] / 255,
        sh=torch.cat([dc[:, None], rest], dim=1),
    )


def _to_bytes(values: Tensor) -> Bytes:
    return values.round().clamp(0, 255).to(torch.uint8).numpy()


def _pack_sh(rest: Float[Tensor, "n r 3"]) -> Bytes:
    """Rounded to the middles of buckets, of which 0 is one, so that the bytes compress well."""
    bits = torch.tensor([SH_BITS[0] if k < 3 else SH_BITS[1] for k in range(rest.shape[1])], dtype=torch.float32)
    bucket = (2 ** (8 - bits))[:, None]
    steps = (rest * SH_STEPS).round() + SH_STEPS
    return _to_bytes(((steps + bucket / 2) / bucket).floor() * bucket).reshape(len(rest), -1)


def _unpack_positions(stored: Bytes, version: int, fraction: int) -> Float[Tensor, "n 3"]:
    if version == 1:
        return torch.from_numpy(np.ascontiguousarray(stored).view("<f2").astype(np.float32))
    low, middle, high = (stored.reshape(-1, 3, 3)[..., i].astype(np.int32) for i in range(3))
    fixed = ((high << 16 | middle << 8 | low) ^ (1 << 23)) - (1 << 23)  # sign extension
    return torch.from_numpy((fixed / 2.0**fraction).astype(np.float32))


def _pack_rotations(quaternions: Float[Tensor, "n 4"]) -> Bytes:
    """The index of the largest of (x, y, z, w) in two bits, then sign and magnitude of the others in ten bits each."""
    xyzw = torch.nn.functional.normalize(quaternions, dim=1).roll(-1, dims=1)
    largest = xyzw.abs().argmax(dim=1)
    xyzw = torch.where(xyzw.gather(1, largest[:, None]) < 0, -xyzw, xyzw)
    place = torch.arange(3).expand(len(xyzw), 3)
    others = xyzw.gather(1, place + (place >= largest[:, None]).long())
    parts = (others.abs() * sqrt(2) * MAGNITUDE).round().long() | (others < 0).long() << 9
    words = largest << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    return words.numpy().astype("<u4").view(np.uint8).reshape(-1, 4)


def _unpack_rotations(stored: Bytes) -> Float[Tensor, "n 4"]:
    words = torch.from_numpy(np.ascontiguousarray(stored).view("<u4")[:, 0].astype(np.int64))
    parts = torch.stack([words >> shift & 0x3FF for shift in (20, 10, 0)], dim=1)
    magnitude = (parts & MAGNITUDE).float() / (MAGNITUDE * sqrt(2))
    return complete_quaternions(words >> 30, torch.where(parts >> 9 == 1, -magnitude, magnitude)).roll(1, dims=1)


def _unpack_short_rotations(stored: Bytes) -> Float[Tensor, "n 4"]:
    """Bytes of (x, y, z); w follows, and is not negative."""
    xyz = torch.from_numpy(stored.astype(np.float32)) / 127.5 - 1
    return torch.cat([(1 - xyz.square().sum(dim=1, keepdim=True)).clamp_min(0).sqrt(), xyz], dim=1)
