"""``cloud``: a cumulus, of which every ray sees a little and no ray finds a surface."""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Float

from invgraphics.scenes.mitsuba.build.model import Fog, Model
from invgraphics.scenes.mitsuba.build.noise import fractal
from invgraphics.scenes.mitsuba.build.surfaces import Softbox, studio

CELLS = (96, 96, 64)
LO, HI = (-0.9, -0.9, -0.6), (0.9, 0.9, 0.6)
EXTINCTION = 9.0
"""Largest extinction, per world unit: the densest rays keep a few hundredths of their light."""
PUFFS = 34

SUNSET = (
    Softbox(-50, 42, 20, (13.0, 10.6, 7.6)),
    Softbox(120, 20, 35, (0.9, 1.0, 1.9)),
)


def build(seed: int, extinction: float = EXTINCTION) -> Model:
    """The model; ``seed`` shapes the cloud, ``extinction`` is its largest, per world unit."""
    rng = np.random.default_rng(seed)
    fog = Fog(extinction * density(rng), albedo=(0.985, 0.98, 0.97), anisotropy=0.35, lo=LO, hi=HI)
    return Model(lights={"sunset": studio(SUNSET, sky=(0.55, 0.65, 0.95), floor=(0.42, 0.35, 0.36), exposure=0.86)}, fog=fog)


# The same cloud at other optical depths, by factors of three.
build_1, build_3, build_27, build_81 = (partial(build, extinction=extinction) for extinction in (1.0, 3.0, 27.0, 81.0))


def density(rng: np.random.Generator) -> Float[np.ndarray, "x y z"]:
    """A heap of round puffs with a flat base, eaten away by fractal noise; in [0, 1], zero at the border."""
    axes = [lo + (np.arange(n) + 0.5) / n * (hi - lo) for lo, hi, n in zip(LO, HI, CELLS, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    inside = np.full(CELLS, -np.inf)
    for _ in range(PUFFS):
        away, turn = 0.54 * rng.random() ** 0.6, 2 * np.pi * rng.random()
        radius = (0.30 - 0.22 * away) * (0.75 + 0.5 * rng.random())
        centre = (
            1.05 * away * np.cos(turn),
            0.8 * away * np.sin(turn),
            -0.3 + radius * 0.55 + 0.55 * rng.random() * (0.6 - away),
        )
        distance = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2)
        inside = np.maximum(inside, 1 - distance / radius)
    base = np.clip((z + 0.42) / 0.1, 0, 1)
    border = np.clip(
        np.minimum.reduce([np.minimum(a - lo, hi - a) for a, lo, hi in zip((x, y, z), LO, HI, strict=True)]) / 0.1, 0, 1
    )
    eaten = inside + 0.9 * (fractal(CELLS, 6, 4, rng) - 0.5)
    return np.clip(eaten / 0.45, 0, 1) ** 1.2 * base * border
