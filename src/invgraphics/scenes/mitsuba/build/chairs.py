"""Chairs: a class of objects whose instances differ in proportions, legs, back, arms and colours; one seed per instance.

All face -y and stand on the same floor, so that their parts correspond. From one side, legs and back are hidden.
"""

from __future__ import annotations

import numpy as np

from invgraphics.scenes.mitsuba.build.mesh import Mesh, Point, box, cylinder, merge, rotation, tube
from invgraphics.scenes.mitsuba.build.model import Model, Part
from invgraphics.scenes.mitsuba.build.paints import paint
from invgraphics.scenes.mitsuba.build.surfaces import matte, studio

FLOOR = -0.52
BACKS = ("solid", "slats", "frame")
PEDESTAL, ARMS = 0.25, 0.4
"""Shares of the chairs that stand on one foot, and that have arms."""


def build(seed: int) -> Model:
    """Build the chair of a seed."""
    rng = np.random.default_rng([seed, 0xC4A1])
    width, depth, thickness = rng.uniform(0.44, 0.68), rng.uniform(0.44, 0.62), rng.uniform(0.04, 0.1)
    top = FLOOR + rng.uniform(0.38, 0.52)
    seat = box((-width / 2, -depth / 2, top - thickness), (width / 2, depth / 2, top), 0.012)
    frame = [_legs(rng, width, depth, top - thickness)]
    solid, back = _back(rng, width, depth, top)
    cloth = [seat, *([back] if solid else [])]
    frame += [] if solid else [back]
    if rng.random() < ARMS:
        frame.append(_arms(rng, width, depth, top))
    wood, fabric = paint(rng), paint(rng)
    return Model(parts=[Part(merge(frame), matte(wood)), Part(merge(cloth), matte(fabric))], lights={"studio": studio()})


def _rod(start: Point, end: Point, radius: float) -> Mesh:
    """A round rod between two points."""
    return tube(np.linspace(start, end, 3), radius, 12)


def _legs(rng: np.random.Generator, width: float, depth: float, top: float) -> Mesh:
    """Four splayed legs, or a pedestal on a disc."""
    radius, splay = rng.uniform(0.018, 0.042), rng.uniform(0.0, 0.07)
    if rng.random() < PEDESTAL:
        foot = cylinder(0.42 * min(width, depth), 0.04, 32, 0.01).moved((0, 0, FLOOR))
        return merge([foot, cylinder(1.5 * radius, top - FLOOR, 20).moved((0, 0, FLOOR))])
    legs = []
    for x in (-1, 1):
        for y in (-1, 1):
            upper = np.array([x * (width / 2 - radius - 0.01), y * (depth / 2 - radius - 0.01), top + 0.01])
            lower = np.array([upper[0] + x * splay, upper[1] + y * splay, FLOOR])
            legs.append(_rod(lower, upper, radius))
    return merge(legs)


def _back(rng: np.random.Generator, width: float, depth: float, top: float) -> tuple[bool, Mesh]:
    """A back at +y, tilted backwards: whether it is upholstered, and its mesh."""
    height, tilt, style = rng.uniform(0.32, 0.56), rng.uniform(0.0, 14.0), BACKS[int(rng.integers(len(BACKS)))]
    thickness, count = rng.uniform(0.03, 0.06), int(rng.integers(3, 6))
    half, post = width / 2, 0.028
    if style == "solid":
        panel = box((-half, -thickness, -0.02), (half, 0, height), 0.012)
    else:
        posts = [_rod((x, -post, -0.03), (x, -post, height), post) for x in (-half + post, half - post)]
        rail = box((-half, -2 * post, height - 0.08), (half, 0, height), 0.01)
        if style == "slats":
            places = np.linspace(-half, half, count + 2)[1:-1]
            filling = [box((x - 0.022, -1.5 * post, 0.0), (x + 0.022, -0.5 * post, height - 0.06)) for x in places]
        else:
            filling = [box((-half, -1.5 * post, z - 0.025), (half, -0.5 * post, z + 0.025)) for z in (0.4 * height,)]
        panel = merge([*posts, rail, *filling])
    return style == "solid", panel.rotated(rotation("x", -tilt)).moved((0, depth / 2, top))


def _arms(rng: np.random.Generator, width: float, depth: float, top: float) -> Mesh:
    """An arm on each side: a post in front and a rest that reaches the back."""
    height, radius = rng.uniform(0.16, 0.24), 0.02
    parts = []
    for side in (-1, 1):
        x = side * (width / 2 - radius)
        front = -depth / 2 + 0.07
        parts.append(_rod((x, front, top - 0.02), (x, front, top + height), radius))
        parts.append(box((x - 0.03, front - 0.05, top + height - 0.015), (x + 0.03, depth / 2, top + height + 0.015), 0.006))
    return merge(parts)
