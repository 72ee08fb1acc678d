"""Mugs: a class of objects whose handle, always towards +x, is hidden from many viewpoints; one seed per instance."""

from __future__ import annotations

import numpy as np

from invgraphics.scenes.mitsuba.build.mesh import Mesh, lathe, merge, tube
from invgraphics.scenes.mitsuba.build.model import Model, Part
from invgraphics.scenes.mitsuba.build.paints import paint
from invgraphics.scenes.mitsuba.build.surfaces import matte, studio

BOTTOM = -0.45
SIDES = 48


def build(seed: int) -> Model:
    """Build the mug of a seed."""
    rng = np.random.default_rng([seed, 0x3069])
    height, radius, flare = rng.uniform(0.5, 0.9), rng.uniform(0.24, 0.36), rng.uniform(-0.05, 0.06)
    wall = rng.uniform(0.025, 0.05)
    low = rng.uniform(0.1, 0.5) * height
    high = low + rng.uniform(0.15, 0.4) * height

    def ring(z: float) -> tuple[float, float]:
        """The outer wall at a height."""
        return radius + flare * z / height, z

    rim = ring(height)[0]
    inside = [ring(height), (rim - wall, height), (radius - wall, wall), (0.0, wall)]
    body = merge(
        [
            lathe([(0.0, 0.0), ring(0.0), ring(low)], SIDES),
            lathe([ring(high), *inside], SIDES),
            _handle(rng, radius + flare / 2, height),
        ]
    )
    stripe = lathe([ring(low), ring(high)], SIDES)
    parts = [Part(mesh.moved((0, 0, BOTTOM)), matte(paint(rng))) for mesh in (body, stripe)]
    return Model(parts=parts, lights={"studio": studio()})


def _handle(rng: np.random.Generator, radius: float, height: float) -> Mesh:
    """A half-ring from near the rim to near the bottom, from round to square, both ends within the wall."""
    reach, half = rng.uniform(0.14, 0.24), height * rng.uniform(0.22, 0.36)
    squareness, thickness = rng.uniform(0.5, 1.0), rng.uniform(0.02, 0.04)
    middle = height * rng.uniform(0.45, 0.55)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 25)
    x = radius - 0.015 + reach * np.cos(angle) ** squareness
    z = middle + half * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** squareness
    return tube(np.stack([x, np.zeros_like(x), z], axis=1), thickness, 12)
