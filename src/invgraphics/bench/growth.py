"""Empirical complexity: the exponent p of time ~ size^p, fitted wherever one size varies and all others are fixed."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from invgraphics.bench.results import Measurement

PIXEL_KEYS = {"width": ("pixels", 2)}
"""Sizes and the quantity that cost grows with: image width, and pixels as its square."""
TABLE_KEYS = {"log2_size": "entries per level"}
"""Sizes given as log2, and the quantity itself."""


@dataclass(frozen=True)
class Growth:
    """A power law fitted to timings.

    Attributes:
        operation: what was timed.
        implementation: by which kernels.
        direction: forward, or both.
        along: the varied size.
        fixed: the fixed sizes.
        values: values of the varied size.
        milliseconds: median times.
        exponent: slope in a log-log plot, by least squares.
    """

    operation: str
    implementation: str
    direction: str
    along: str
    fixed: dict[str, int]
    values: tuple[float, ...]
    milliseconds: tuple[float, ...]
    exponent: float


def growths(measurements: list[Measurement]) -> list[Growth]:
    """Fit a power law to every series of at least three measurements."""
    found = []
    for along in dict.fromkeys(key for m in measurements for key in m.sizes):
        groups: dict[tuple, list[Measurement]] = defaultdict(list)
        for m in measurements:
            if along in m.sizes and m.direction:
                fixed = tuple((key, value) for key, value in m.sizes.items() if key != along)
                groups[m.operation, m.implementation, m.direction, m.threads, fixed].append(m)
        for (operation, implementation, direction, _, fixed), members in groups.items():
            times = {size_of(along, m.sizes[along]): m.timing.median for m in members}
            if len(times) >= 3:
                sizes, seconds = zip(*sorted(times.items()), strict=True)
                slope = float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
                milliseconds = tuple(1e3 * x for x in seconds)
                found.append(
                    Growth(operation, implementation, direction, name_of(along), dict(fixed), sizes, milliseconds, slope)
                )
    return found


def name_of(key: str) -> str:
    """Display name of a size."""
    return PIXEL_KEYS[key][0] if key in PIXEL_KEYS else TABLE_KEYS.get(key, key)


def size_of(key: str, value: int) -> float:
    """Convert a size to the quantity that cost scales with: width to pixels, log2 to entries."""
    if key in PIXEL_KEYS:
        return float(value) ** PIXEL_KEYS[key][1]
    return 2.0**value if key in TABLE_KEYS else float(value)
