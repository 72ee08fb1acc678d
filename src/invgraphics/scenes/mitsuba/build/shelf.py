"""``shelf``: a bookcase against a wall with things at six depths, seen from the front past a trellis."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from invgraphics.scenes.mitsuba.build.fence import leaf
from invgraphics.scenes.mitsuba.build.mesh import Mesh, box, cylinder, lathe, merge, polygon, rotation, tube
from invgraphics.scenes.mitsuba.build.model import Ball, Model, Part
from invgraphics.scenes.mitsuba.build.noise import Image, checkers, confetti, fractal, wood
from invgraphics.scenes.mitsuba.build.surfaces import Softbox, matte, metal, plastic, rgb, studio, two_sided

WALL = 0.6
SIDE, DEPTH, THICK = 1.0, 0.52, 0.04
BOARDS = (-1.0, -0.36, 0.28, 0.92)
"""Heights of the boards' upper faces, from the floor of the lowest compartment up."""
TABLE = (-0.7, -0.98)
"""Middle of the table before the bookcase along y, and height of its top."""
TRELLIS = -1.35
BOOKS = ("#b23a48", "#2f6690", "#e0a458", "#3f7d58", "#6b4e71", "#d8d2c4", "#1f2d3d", "#d1603d", "#8fb8c9")
GREENS = ("#2e7d32", "#4c9a2a", "#76b041")
LAMPS = (
    Softbox(-125, 42, 26, (6.0, 5.6, 5.0)),
    Softbox(-55, 28, 24, (2.6, 2.8, 3.2)),
    Softbox(-95, 75, 30, (2.0, 2.0, 2.0)),
)
"""All on the viewer's side of the wall."""


def build(seed: int) -> Model:
    """The model; ``seed`` prints the wallpaper and the pictures, and arranges books and leaves."""
    rng = np.random.default_rng(seed)
    parts = [*_wall(rng), *_case(rng), *_books(rng), *_things(rng), *_table(rng), *_trellis(rng)]
    y, top = TABLE
    balls = [
        Ball((0.34, 0.22, BOARDS[1] + 0.13), 0.13, plastic(rgb("#c8102e"), 0.06)),
        Ball((-0.66, 0.26, BOARDS[2] + 0.15), 0.15, metal("Ag", 0.12)),
        Ball((0.62, y - 0.05, top + 0.11), 0.11, plastic(rgb("#16324f"), 0.05)),
    ]
    return Model(parts=parts, balls=balls, lights={"studio": studio(LAMPS, sky=(0.75, 0.77, 0.8), floor=(0.3, 0.29, 0.28))})


def _wall(rng: np.random.Generator) -> Iterator[Part]:
    """Papered wall that fills every view, and a floor of boards."""
    corners = np.array([(-2.0, WALL, -1.7), (2.0, WALL, -1.7), (2.0, WALL, 1.7), (-2.0, WALL, 1.7)])
    yield Part(polygon(corners, away_from=(0, 5, 0)), matte(_paper(rng)))
    floor = np.array([(-2.0, -1.6, -1.69), (2.0, -1.6, -1.69), (2.0, WALL, -1.69), (-2.0, WALL, -1.69)])
    yield Part(polygon(floor, away_from=(0, 0, -5)), matte(wood((384, 512), 14, rng)))


def _paper(rng: np.random.Generator) -> Image:
    """Wallpaper: rows of rings and dots on a mottled ground."""
    height, width = 816, 960
    y, x = (np.mgrid[:height, :width] + 0.5) / 60
    row = np.floor(y)
    u, v = (x + 0.5 * (row % 2)) % 1 - 0.5, y % 1 - 0.5
    radius = np.hypot(u, v)
    ground = 0.85 + 0.15 * fractal((height, width), 20, 4, rng)
    image = np.where((row % 2 == 0)[..., None], np.array(rgb("#2d5a66")), np.array(rgb("#336471")))
    image = np.where(((radius < 0.36) & (radius > 0.27))[..., None], np.array(rgb("#d9b36c")), image)
    return np.where((radius < 0.1)[..., None], np.array(rgb("#f0e6d2")), image) * ground[..., None]


def _case(rng: np.random.Generator) -> Iterator[Part]:
    """Boards, sides and a divider of the bookcase, open towards the wall."""
    front = WALL - DEPTH
    planks = [box((-SIDE, front, z - THICK), (SIDE, WALL - 0.002, z), 0.006) for z in BOARDS]
    planks += [box((x - THICK / 2, front, BOARDS[0]), (x + THICK / 2, WALL - 0.002, BOARDS[3]), 0.006) for x in (-SIDE, SIDE)]
    planks.append(box((0.08, front + 0.02, BOARDS[1]), (0.08 + THICK, WALL - 0.002, BOARDS[2]), 0.004))
    case = merge(planks)
    grain = np.column_stack([case.vertices[:, 0] + 0.37 * case.vertices[:, 2], case.vertices[:, 1] + case.vertices[:, 2]])
    yield Part(replace(case, uv=(grain - grain.min(axis=0)) / np.ptp(grain, axis=0)), plastic(wood((512, 512), 9, rng), 0.35))


def _books(rng: np.random.Generator) -> Iterator[Part]:
    """Rows of books, some leaning, in three compartments."""
    books: dict[str, list[Mesh]] = {}
    for board, start, end in ((1, -0.94, -0.1), (2, -0.38, 0.42), (0, 0.3, 0.93)):
        x = start
        while x < end:
            thick, tall = 0.035 + 0.05 * rng.random(), 0.34 + 0.16 * rng.random()
            deep = 0.26 + 0.1 * rng.random()
            front = WALL - DEPTH + 0.03 + 0.1 * rng.random()
            book = box((0, 0, 0), (thick - 0.004, deep, tall), 0.005)
            if rng.random() < 0.12:
                book = book.rotated(rotation("y", 9))
                thick += 0.09
            colour = BOOKS[int(rng.integers(len(BOOKS)))]
            books.setdefault(colour, []).append(book.moved((x, front, BOARDS[board] + 0.002)))
            band = box((0, -0.002, 0.72 * tall), (thick - 0.004 if thick < 0.09 else 0.03, 0.0, 0.78 * tall))
            if thick < 0.09:
                books.setdefault("#e9dcb5", []).append(band.moved((x, front, BOARDS[board] + 0.002)))
            x += thick
    yield from (Part(merge(meshes), plastic(rgb(colour), 0.3)) for colour, meshes in books.items())


def _things(rng: np.random.Generator) -> Iterator[Part]:
    """Vases, a framed picture, a plant and a globe's stand on the boards."""
    vase = [(0, 0), (0.07, 0), (0.12, 0.1), (0.115, 0.2), (0.05, 0.32), (0.045, 0.37), (0.065, 0.4), (0.05, 0.4), (0, 0.34)]
    yield Part(lathe(vase, 64).moved((0.78, 0.26, BOARDS[1])), plastic(rgb("#1f5fa8"), 0.08))
    stripes = lathe([(0, 0), (0.09, 0), (0.13, 0.12), (0.1, 0.27), (0.06, 0.3), (0, 0.29)], 64)
    yield Part(stripes.moved((0.74, 0.24, BOARDS[2])), plastic(checkers(512, 12, rgb("#f3ead7"), rgb("#c2572b")), 0.2))
    yield Part(lathe([(0, 0), (0.1, 0), (0.03, 0.02), (0.03, 0.05), (0, 0.05)], 48).moved((-0.66, 0.26, BOARDS[2] - 0.03)),
               metal("Cu", 0.2))  # fmt: skip
    frame = [(-0.86, 0.36, -0.46), (-0.3, 0.36, -0.94)]
    (x0, y, z1), (x1, _, z0) = frame
    edge = box((x0, y, z0), (x1, y + 0.03, z1), 0.006)
    yield Part(edge, metal("Au", 0.35))
    art = [(x0 + 0.04, y - 0.001, z0 + 0.04), (x1 - 0.04, y - 0.001, z0 + 0.04)]
    art += [(x1 - 0.04, y - 0.001, z1 - 0.04), (x0 + 0.04, y - 0.001, z1 - 0.04)]
    palette = [rgb(code) for code in ("#264653", "#2a9d8f", "#e9c46a", "#e76f51", "#f4f1de")]
    yield Part(polygon(np.array(art), away_from=(0, 5, 0)), matte(confetti(384, palette, rng, 50)))
    foot = np.array([0.02, 0.22, BOARDS[0]])
    yield Part(lathe([(0, 0), (0.09, 0), (0.12, 0.16), (0.1, 0.16), (0, 0.14)], 48).moved(foot), plastic(rgb("#f0ece2"), 0.3))
    yield from _foliage(rng, foot + np.array([0, 0, 0.14]), 34, 0.26)
    hanging = np.array([-0.2, 0.2, BOARDS[3]])
    yield Part(
        lathe([(0, 0), (0.08, 0), (0.1, 0.14), (0.085, 0.14), (0, 0.12)], 48).moved(hanging), plastic(rgb("#b5532f"), 0.3)
    )
    yield from _foliage(rng, hanging + np.array([0, 0, 0.12]), 42, 0.34)
    boxes = [box((0.28, 0.16, BOARDS[3]), (0.74, 0.46, BOARDS[3] + 0.17), 0.012)]
    yield Part(merge(boxes), matte(rgb("#8c6f9e")))
    yield Part(box((0.34, 0.2, BOARDS[3] + 0.171), (0.66, 0.42, BOARDS[3] + 0.28), 0.012), matte(rgb("#e2b33c")))


def _foliage(rng: np.random.Generator, foot: np.ndarray, count: int, length: float) -> Iterator[Part]:
    """Blades that fan out from a pot."""
    blades: dict[str, list[Mesh]] = {}
    for _ in range(count):
        turn, lift = 360 * rng.random(), 25 + 60 * rng.random()
        blade = leaf(length * (0.7 + 0.5 * rng.random()), 0.022, 0.5).rotated(rotation("y", -lift))
        blades.setdefault(GREENS[int(rng.integers(3))], []).append(blade.rotated(rotation("z", turn)).moved(foot))
    yield from (Part(merge(meshes), two_sided(matte(rgb(colour)))) for colour, meshes in blades.items())


def _table(rng: np.random.Generator) -> Iterator[Part]:
    """A low table before the bookcase with a brass pot, a cup and a stack of plates."""
    y, top = TABLE
    slab = box((-1.1, y - 0.3, top - 0.05), (1.1, y + 0.26, top), 0.012)
    uv = (slab.vertices[:, :2] - slab.vertices[:, :2].min(axis=0)) / np.ptp(slab.vertices[:, :2], axis=0)
    yield Part(replace(slab, uv=uv), plastic(wood((256, 512), 5, rng, "#4a2f1d", "#8a5a36"), 0.2))
    legs = [
        box((x - 0.04, y + d - 0.04, -1.68), (x + 0.04, y + d + 0.04, top - 0.051)) for x in (-1.0, 1.0) for d in (-0.2, 0.2)
    ]
    yield Part(merge(legs), matte(rgb("#4a2f1d")))
    belly = [(0, 0), (0.11, 0), (0.19, 0.08), (0.21, 0.17), (0.17, 0.27), (0.1, 0.32), (0.1, 0.34), (0.06, 0.36), (0.02, 0.385),
             (0.03, 0.41), (0, 0.43)]  # fmt: skip
    place = np.array([0.16, y, top])
    yield Part(lathe(belly, 96).moved(place), metal("Au", 0.18))
    t = np.linspace(-1, 1, 40)[:, None]
    handle = np.column_stack([0.2 + 0.13 * np.cos(0.5 * np.pi * t[:, 0]), 0 * t[:, 0], 0.19 + 0.11 * t[:, 0]])
    spout = np.column_stack([-0.19 - 0.16 * (0.5 + 0.5 * t[:, 0]), 0 * t[:, 0], 0.13 + 0.19 * (0.5 + 0.5 * t[:, 0]) ** 2])
    yield Part(tube(handle, 0.016, 16).moved(place), metal("Au", 0.2))
    yield Part(tube(spout, np.linspace(0.035, 0.018, 40), 20).moved(place), metal("Au", 0.15))
    cup = lathe([(0, 0), (0.05, 0), (0.085, 0.12), (0.075, 0.12), (0.045, 0.02), (0, 0.02)], 48)
    yield Part(cup.moved((-0.26, y - 0.1, top)), plastic(rgb("#e8e2d4"), 0.1))
    plates = [cylinder(0.17 - 0.015 * k, 0.018, 64, 0.006).moved((-0.68, y, top + 0.02 * k)) for k in range(5)]
    yield Part(merge(plates), plastic(rgb("#3f8f8a"), 0.12))
    apple = lathe([(0, 0.01), (0.06, 0), (0.085, 0.07), (0.06, 0.13), (0.02, 0.125), (0, 0.115)], 48)
    yield Part(apple.moved((-0.68, y, top + 0.1)), plastic(rgb("#7fb32d"), 0.1))


def _trellis(rng: np.random.Generator) -> Iterator[Part]:
    """A diagonal lattice of thin slats on the left, with a climbing vine; the nearest thing in the scene."""
    lo, hi = np.array([-1.15, -0.62]), np.array([-0.3, 0.78])
    slats = []
    for slope, y in ((1.0, TRELLIS), (-1.0, TRELLIS + 0.012)):
        for offset in np.arange(-3.0, 3.0, 0.25):
            x = np.array([lo[0], hi[0]])
            z = slope * (x - x.mean()) + offset
            if slope < 0:
                x, z = x[::-1], z[::-1]
            keep = np.clip(z, lo[1], hi[1])  # cut the line at the frame
            x = x + (keep - z) / slope
            if keep[1] - keep[0] > 0.05:
                slats.append(_slat((x[0], keep[0]), (x[1], keep[1]), y))
    yield Part(merge(slats), matte(rgb("#f2efe6")))
    (x0, z0), (x1, z1), w, y = lo, hi, 0.022, TRELLIS - 0.008
    rails = [box((x0 - w, y, z), (x1 + w, y + 0.03, z + 2 * w), 0.004) for z in (z0 - 2 * w, z1)]
    rails += [box((x - w, y, z0 - 0.6), (x + w, y + 0.03, z1 + 2 * w), 0.004) for x in (x0, x1)]
    yield Part(merge(rails), matte(rgb("#dcd6c8")))
    stems, leaves = [], []
    for phase in (0.0, 2.4):
        t = np.linspace(0, 1, 60)
        path = np.column_stack([-0.72 + 0.3 * np.sin(7 * t + phase), TRELLIS - 0.025 + 0.012 * np.cos(9 * t), -1.0 + 1.72 * t])
        stems.append(tube(path, 0.007, 8))
        for k in range(4, 60, 2):
            blade = leaf(0.1 + 0.05 * rng.random(), 0.034, 0.3).rotated(rotation("y", -30 + 60 * rng.random()))
            leaves.append(blade.rotated(rotation("z", 180 + 180 * rng.random())).moved(path[k]))
    yield Part(merge(stems), matte(rgb("#4e6b2f")))
    yield Part(merge(leaves), two_sided(matte(rgb("#5c9a3a"))))


def _slat(start: tuple[float, float], end: tuple[float, float], y: float) -> Mesh:
    """A flat bar between two points (x, z) at depth ``y``."""
    along = np.subtract(end, start)
    length, angle = float(np.hypot(*along)), float(np.degrees(np.arctan2(along[1], along[0])))
    bar = box((0, 0, -0.011), (length, 0.01, 0.011))
    return bar.rotated(rotation("y", -angle)).moved((start[0], y, start[1]))
