"""Explanation of one pixel's ray: contributions, profiles and depths as arrays, and plotting ranges."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from invgraphics.core.colour import linear_to_srgb
from invgraphics.runs.explanation import Contributions, ExplanationRecord, Profile
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.schema import plain

DEPTHS = ("true_depth", "expected", "median")
"""Depths of a pixel, as the record calls them."""
TAIL, FAINT, SMALL = 0.02, 0.02, 0.6
"""A close-up leaves out this share of the light at either end; it is for rays that meet more than `FAINT`, and shows less than
`SMALL` of the ray."""


@dataclass(frozen=True, eq=False)
class Ray:
    """Contributions to one pixel in compositing order, as written by `invgraphics.tools.explain`.

    Attributes:
        record: the file's content.
        columns: name -> values of the contributions.
        rgb: their colours, for display.
        background: for display.
    """

    record: ExplanationRecord
    columns: dict[str, Float[ndarray, " k"]]
    rgb: Float[ndarray, "k 3"]
    background: Float[ndarray, " 3"]

    @property
    def depths(self) -> dict[str, float]:
        """Known depths of the pixel, by key of `DEPTHS`."""
        known = {key: getattr(self.record.pixel, key) for key in DEPTHS}
        return {key: value for key, value in known.items() if value is not None}

    def shown(self, colour: Float[ndarray, "*p 3"]) -> Float[ndarray, "*p 3"]:
        """Convert colours from the scene's colour space to display sRGB in [0, 1]."""
        values = torch.from_numpy(np.asarray(colour, float))
        return (linear_to_srgb(values) if self.record.colour == "linear" else values.clamp(0, 1)).numpy()


def read_ray(folder: Path) -> Ray:
    """Read the explanation of a ray into arrays.

    Raises:
        InputError: a file is missing or broken.
    """
    record = RunFolder(folder).read(ExplanationRecord)
    columns = curve_of(record.contributions)
    rgb = np.stack([columns[key] for key in ("red", "green", "blue")], axis=1)
    return Ray(record, columns, rgb, np.array(record.background, float))


def curve_of(table: Contributions | Profile | None) -> dict[str, Float[ndarray, " p"]]:
    """Columns of a table as float arrays, absent columns left out; empty without a table."""
    return {} if table is None else {key: np.array(values, float) for key, values in plain(table).items()}


def whole_ray(ray: Ray) -> tuple[float, float]:
    """(near, far) distances of the whole ray: the sampled or traced interval, or the extent of its Gaussians."""
    near, far = ray.record.near, ray.record.far
    ends = np.concatenate([ray.columns["begin"], ray.columns["end"], list(ray.depths.values())])
    if ray.record.kind in ("samples", "surface points") and near is not None and far is not None and far > near:
        unbounded = ray.record.space == "contracted"
        return near, min(far, 1.5 * float(ends.max())) if unbounded and len(ends) else far
    if not len(ends):
        return 0.0, 1.0
    low, high = float(ends.min()), float(ends.max())
    pad = 0.06 * max(high - low, 1e-3 * high)
    return max(low - pad, 0.5 * low), high + pad


def close_up(ray: Ray, whole: tuple[float, float]) -> tuple[float, float] | None:
    """(near, far) of the interval that contributes most of the weight; ``None`` unless it is a small part of the ray."""
    order = ray.columns["t"].argsort(kind="stable")
    reached = np.cumsum(ray.columns["weight"][order])
    if not len(order) or reached[-1] < FAINT:
        return None
    inner = order[np.searchsorted(reached / reached[-1], (TAIL, 1 - TAIL)).clip(max=len(order) - 1)]
    low, high = float(ray.columns["begin"][inner[0]]), float(ray.columns["end"][inner[1]])
    if high <= low:  # one surface point
        return None
    for value in ray.depths.values():
        if low - 2 * (high - low) <= value <= high + 2 * (high - low):
            low, high = min(low, value), max(high, value)
    pad = 0.3 * (high - low)
    low, high = max(low - pad, whole[0]), min(high + pad, whole[1])
    return (low, high) if high - low < SMALL * (whole[1] - whole[0]) else None
