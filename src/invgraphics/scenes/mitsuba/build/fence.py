"""``fence``: a corner of a garden, where everything is thin: slats, wire mesh, spokes, stems and leaves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from invgraphics.scenes.mitsuba.build.mesh import Mesh, box, cylinder, lathe, merge, rotation, sheet, solid, tube
from invgraphics.scenes.mitsuba.build.model import Ball, Model, Part
from invgraphics.scenes.mitsuba.build.noise import fractal, ramp
from invgraphics.scenes.mitsuba.build.surfaces import matte, metal, plastic, rgb, studio, two_sided

GROUND = -0.55
LAWN = ("#2f5d27", "#4d8a35", "#6fa544", "#8a9a4a")
GREENS = ("#2e7d32", "#4c9a2a", "#76b041", "#a4c639")
PAINTS = ("#3aa6b9", "#f2c14e", "#e4572e", "#f4f1de")
TOP = 0.72
"""Height of the fence above the ground."""


def build(seed: int) -> Model:
    """The model; ``seed`` grows the plants."""
    rng = np.random.default_rng(seed)
    parts = [*_ground(rng), *_slats(), *_mesh_panel(), *_wheel(), *_bush(rng), *_sunflowers(rng)]
    lifted = [Part(part.mesh.moved((0, 0, GROUND)), part.material) for part in parts]
    balls = [
        Ball((x, y, GROUND + radius), radius, plastic(rgb(colour), 0.1))
        for x, y, radius, colour in ((-0.5, 0.36, 0.17, "#d7263d"), (-0.18, 0.5, 0.11, "#1b6ca8"), (0.52, 0.5, 0.14, "#f46036"))
    ]
    return Model(parts=lifted, balls=balls, lights={"studio": studio()})


def _ground(rng: np.random.Generator) -> list[Part]:
    lawn = ramp(fractal((512, 512), 10, 6, rng), [rgb(code) for code in LAWN])
    top = box((-0.9, -0.9, -0.02), (0.9, 0.9, 0), 0.008)
    flat = Mesh(top.vertices, top.faces, top.normals, top.vertices[:, :2] / 1.8 + 0.5)
    return [Part(flat, matte(lawn)), Part(box((-0.9, -0.9, -0.1), (0.9, 0.9, -0.021), 0.015), matte(rgb("#5a3d28")))]


def _slats() -> list[Part]:
    """Posts, rails and a picket fence on the left half."""
    wood = [box((x - 0.025, -0.025, 0), (x + 0.025, 0.025, TOP + 0.06), 0.006) for x in (-0.8, 0.02, 0.8)]
    wood += [box((-0.8, 0.012, z), (0.02, 0.028, z + 0.035)) for z in (0.14, 0.52)]
    pickets: dict[str, list[Mesh]] = {}
    for index, x in enumerate(np.linspace(-0.74, -0.05, 11)):
        width, tip, height = 0.02, 0.04, TOP - 0.05 * np.cos(np.pi * (x + 0.4) / 0.4)
        outline = [(x - width, 0), (x + width, 0), (x + width, height), (x, height + tip), (x - width, height)]
        points = np.array([(a, y, z) for y in (-0.006, 0.01) for a, z in outline])
        sides = [[i, (i + 1) % 5, 5 + (i + 1) % 5, 5 + i] for i in range(5)]
        pickets.setdefault(PAINTS[index % len(PAINTS)], []).append(solid(points, [range(5), range(5, 10), *sides]))
    painted = [Part(merge(meshes), plastic(rgb(colour), 0.25)) for colour, meshes in pickets.items()]
    return [Part(merge(wood), matte(rgb("#8a6242"))), *painted]


def _mesh_panel() -> list[Part]:
    """Woven wire on the right half: zigzags that hook into each other."""
    radius, pitch = 0.0055, 0.075
    wires = []
    for row in range(11):
        t = np.linspace(0, 1, 161)
        x = 0.045 + t * 0.73
        phase = 2 * np.pi * (x - 0.045) / (2 * pitch) + np.pi * (row % 2)
        swing = 2 / np.pi * np.arcsin(np.clip(np.cos(phase), -0.985, 0.985))
        z = 0.07 + 0.062 * row + 0.036 * swing
        wires.append(tube(np.stack([x, 0.006 * np.sin(phase), z], axis=1), radius, 8))
    for z in (0.03, TOP):
        wires.append(tube(np.stack([np.linspace(0.04, 0.78, 9), np.zeros(9), np.full(9, z)], axis=1), 0.011, 12))
    return [Part(merge(wires), metal("Al", 0.3))]


def _wheel() -> list[Part]:
    """A bicycle wheel that leans on the fence."""
    angle = np.linspace(0, 2 * np.pi * 1.01, 130)
    circle = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    tyre, rim = tube(0.29 * circle, 0.021, 16), tube(0.266 * circle, 0.012, 12)
    spokes = []
    for index, turn in enumerate(np.linspace(0, 2 * np.pi, 24, endpoint=False)):
        side = 0.035 if index % 2 else -0.035
        skew = turn + (0.5 if index % 4 < 2 else -0.5)
        hub = np.array([0.022 * np.cos(skew), side, 0.022 * np.sin(skew)])
        end = np.array([0.262 * np.cos(turn), 0, 0.262 * np.sin(turn)])
        spokes.append(tube(np.linspace(hub, end, 4), 0.0042, 6))
    axle = cylinder(0.026, 0.09, 24).moved((0, 0, -0.045)).rotated(rotation("x", 90))
    lean = rotation("z", 12) @ rotation("x", -16)
    placed = [mesh.rotated(lean).moved((0.42, -0.15, 0.3)) for mesh in (tyre, merge([rim, *spokes, axle]))]
    return [Part(placed[0], plastic(rgb("#22252a"), 0.4)), Part(placed[1], metal("Al", 0.2))]


def leaf(length: float, width: float, bend: float) -> Mesh:
    """A pointed leaf from the origin along +x, folded a little at its rib and bent downwards; look at it from both sides."""
    t = np.linspace(0, 1, 9)[:, None]
    s = np.linspace(-1, 1, 5)[None]
    half = width * np.sin(np.pi * t**0.8) ** 0.9 * (1 - 0.35 * t) + 1e-4
    points = np.stack(np.broadcast_arrays(length * t, half * s, 0.35 * half * np.abs(s) - bend * length * t * t), axis=-1)
    return sheet(points)


def _frame(direction: Float[np.ndarray, 3], twist: float) -> Float[np.ndarray, "3 3"]:
    """A rotation that takes +x to ``direction``, turned about it by ``twist`` radians."""
    x = direction / np.linalg.norm(direction)
    y = np.cross((0.0, 0.0, 1.0), x)
    y = y / max(float(np.linalg.norm(y)), 1e-6)
    z = np.cross(x, y)
    return np.stack([x, np.cos(twist) * y + np.sin(twist) * z, np.cos(twist) * z - np.sin(twist) * y], axis=1)


def _curve(start: np.ndarray, end: np.ndarray, sag: np.ndarray, count: int = 14) -> Float[np.ndarray, "n 3"]:
    """A parabola from ``start`` to ``end`` that passes ``sag`` off their middle."""
    t = np.linspace(0, 1, count)[:, None]
    return start + (end - start) * t + 4 * t * (1 - t) * sag


def _bush(rng: np.random.Generator) -> list[Part]:
    """A pot with arching stems and a few hundred leaves."""
    foot = np.array([-0.5, -0.5, 0.0])
    profile = [(0, 0), (0.12, 0), (0.165, 0.2), (0.18, 0.2), (0.18, 0.24), (0.15, 0.24), (0.15, 0.2), (0, 0.2)]
    stems: list[Mesh] = []
    leaves: dict[str, list[Mesh]] = {code: [] for code in GREENS}
    for _ in range(26):
        turn, reach = 2 * np.pi * rng.random(), 0.08 + 0.24 * rng.random()
        end = foot + np.array([reach * np.cos(turn), reach * np.sin(turn), 0.5 + 0.42 * rng.random() - 0.7 * reach])
        path = _curve(foot + np.array([0.03 * np.cos(turn), 0.03 * np.sin(turn), 0.2]), end, np.array([0, 0, 0.25 * reach]))
        stems.append(tube(path, np.linspace(0.007, 0.003, len(path)), 7))
        for place in range(3, len(path)):
            direction = path[place] - path[place - 1] + 0.05 * rng.normal(size=3)
            blade = leaf(0.075 + 0.05 * rng.random(), 0.019, 0.25).rotated(_frame(direction, 2 * np.pi * rng.random()))
            leaves[GREENS[int(rng.integers(len(GREENS)))]].append(blade.moved(path[place]))
    pot = lathe(profile, 64).moved(foot)
    foliage = [Part(merge(meshes), two_sided(matte(rgb(code)))) for code, meshes in leaves.items()]
    return [Part(pot, plastic(rgb("#b5532f"), 0.4)), Part(merge(stems), matte(rgb("#3c6e2e"))), *foliage]


def _sunflowers(rng: np.random.Generator) -> Iterator[Part]:
    """Tall flowers behind the fence."""
    stems, petals, hearts, blades = [], [], [], []
    for x, y, height in ((-0.68, 0.62, 0.98), (0.16, 0.34, 1.06), (0.74, 0.3, 0.9), (0.3, 0.7, 0.84), (-0.3, 0.74, 0.78)):
        foot = np.array([x, y, 0.0])
        head = foot + np.array([0.06 * rng.normal(), -0.05, height])
        path = _curve(foot, head, np.array([0.02 * rng.normal(), 0.03, 0]))
        stems.append(tube(path, 0.009, 9))
        look = np.array([0.5 * rng.normal(), -1.0, 0.45])
        facing = _frame(look, 0.0)
        for index, turn in enumerate(np.linspace(0, 2 * np.pi, 18, endpoint=False)):
            outward = np.array([0.12 if index % 2 else -0.05, np.cos(turn), np.sin(turn)])
            petal = leaf(0.105, 0.021, 0.1).rotated(_frame(facing @ outward, 0.4))
            petals.append(petal.moved(head + facing @ (outward * 0.045)))
        hearts.append(cylinder(0.056, 0.02, 32, 0.008).rotated(facing @ rotation("y", 90)).moved(head))
        for place in (4, 7, 10):
            side = np.array([np.cos(2.4 * place), np.sin(2.4 * place), 0.5])
            blades.append(leaf(0.16, 0.045, 0.35).rotated(_frame(side, 0.2)).moved(path[place]))
    yield Part(merge(stems + blades), two_sided(matte(rgb("#4f8a34"))))
    yield Part(merge(petals), two_sided(matte(rgb("#f7b81f"))))
    yield Part(merge(hearts), matte(rgb("#4a2a17")))
