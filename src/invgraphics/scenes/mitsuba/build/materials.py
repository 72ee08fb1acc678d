"""``materials``: balls of glass, metal, plastic and clay around a copper knot, on a round table."""

from __future__ import annotations

from typing import Any

import numpy as np

from invgraphics.scenes.mitsuba.build.mesh import Mesh, lathe, tube
from invgraphics.scenes.mitsuba.build.model import Ball, Model, Part
from invgraphics.scenes.mitsuba.build.noise import checkers, wood
from invgraphics.scenes.mitsuba.build.surfaces import glass, matte, metal, plastic, rgb, studio

FLOOR = -0.5
"""Height of the table's top."""
BALL = 0.235
RING = 0.66


def build(seed: int) -> Model:
    """The model; ``seed`` chooses the grain of the wood."""
    rng = np.random.default_rng(seed)
    table = lathe([(0, -0.2), (0.86, -0.2), (0.98, -0.14), (0.98, -0.03), (0.95, 0), (0.84, 0)], 128).moved((0, 0, FLOOR))
    pedestal = lathe([(0.2, 0), (0.2, 0.05), (0.16, 0.08), (0.12, 0.2), (0.12, 0.26), (0.17, 0.3), (0, 0.3)], 64)
    parts = [
        Part(table, plastic(wood((256, 512), 6, rng), roughness=0.2)),
        Part(disc(0.84).moved((0, 0, FLOOR)), plastic(checkers(512, 14, rgb("#e9e0cb"), rgb("#27545c")), roughness=0.12)),
        Part(pedestal.moved((0, 0, FLOOR)), plastic(rgb("#f0ece2"), roughness=0.3)),
        Part(knot().scaled(0.105).moved((0, 0, FLOOR + 0.66)), metal("Cu", 0.2)),
    ]
    around: list[dict[str, Any]] = [
        plastic(rgb("#d8262c"), roughness=0.05),
        glass(),
        metal("Au", 0.2),
        matte(rgb("#d9783f")),
        plastic(rgb("#2467c9"), roughness=0.3),
        glass(1.33),
        metal("Ag", 0.06),
        matte(rgb("#7fb94a")),
    ]
    angles = np.radians(np.arange(len(around)) * 360 / len(around) + 10)
    balls = [
        Ball((float(RING * np.cos(a)), float(RING * np.sin(a)), FLOOR + BALL + 1e-3), BALL, material)
        for a, material in zip(angles, around, strict=True)
    ]
    return Model(parts=parts, balls=balls, lights={"studio": studio(exposure=0.72)})


def disc(radius: float, sides: int = 128) -> Mesh:
    """A horizontal disc that looks up, with flat texture coordinates."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    flat = np.concatenate([np.zeros((1, 2)), ring])
    first = np.arange(sides) + 1
    faces = np.stack([np.zeros(sides, int), first, first % sides + 1], axis=1)
    vertices = np.column_stack([radius * flat, np.zeros(sides + 1)])
    return Mesh(vertices, faces, np.tile([0.0, 0.0, 1.0], (sides + 1, 1)), flat / 2 + 0.5)


def knot(points: int = 480) -> Mesh:
    """The (2, 3) torus knot, standing; its ends overlap a little so that no seam is open."""
    t = np.linspace(0, 2 * np.pi * 1.005, points)
    radius = 2 + np.cos(3 * t)
    path = np.stack([radius * np.cos(2 * t), 1.25 * np.sin(3 * t), radius * np.sin(2 * t)], axis=1)
    return tube(path, 0.5, sides=40)
