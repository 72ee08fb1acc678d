"""``bricks``: a toy house with a garden, a tree and a car, of plastic bricks with studs.

Lengths are in studs (one stud is the pitch of the grid) and heights in plates; a brick is three plates high.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from invgraphics.scenes.mitsuba.build.mesh import Mesh, box, cylinder, merge, rotation, solid
from invgraphics.scenes.mitsuba.build.model import Model, Part
from invgraphics.scenes.mitsuba.build.surfaces import plastic, rgb, studio

BASE = 16
PLATE = 0.4
GAP = 0.02
CHAMFER = 0.045
SCALE = 1.76 / BASE
"""World units per stud: the baseplate is 1.76 wide."""

PALETTE = {
    "red": "#d3301f", "crimson": "#ad2015", "blue": "#1a5fb4", "azure": "#58b7dd", "navy": "#16324f", "yellow": "#f5c430",
    "amber": "#ee9b27", "green": "#4aa64a", "lime": "#a3cf3b", "forest": "#1f7a3d", "white": "#f2f2ef", "grey": "#9ba19d",
    "slate": "#5a6066", "black": "#20262b", "brown": "#6d4024", "tan": "#dcc48e", "pink": "#ee8fb5", "violet": "#8a4fa3",
}  # fmt: skip


@dataclass
class Bricks:
    """A growing model: meshes by colour, and which cells are filled (so that covered studs are left out)."""

    meshes: dict[str, list[Mesh]] = field(default_factory=dict)
    filled: set[tuple[int, int, int]] = field(default_factory=set)
    studs: list[tuple[int, int, int, str]] = field(default_factory=list)

    def add(self, colour: str, mesh: Mesh) -> None:
        """Any mesh, in studs."""
        self.meshes.setdefault(colour, []).append(mesh)

    def brick(
        self, colour: str, at: tuple[int, int, int], size: tuple[int, int, int] = (1, 1, 3), smooth: bool = False
    ) -> None:
        """A brick of ``size`` (studs, studs, plates) with its corner ``at`` (studs, studs, plates); ``smooth`` has no studs."""
        (x, y, z), (w, d, h) = at, size
        self.add(colour, box((x + GAP, y + GAP, z * PLATE), (x + w - GAP, y + d - GAP, (z + h) * PLATE - GAP), CHAMFER))
        cells = [(i, j) for i in range(x, x + w) for j in range(y, y + d)]
        self.filled.update((i, j, k) for i, j in cells for k in range(z, z + h))
        if not smooth:
            self.studs += [(i, j, z + h, colour) for i, j in cells]

    def slope(self, colour: str, at: tuple[int, int, int], width: int, down: int) -> None:
        """A roof brick one stud deep and three plates high, ``width`` along x, falling towards ``down`` (-1 or +1) along y."""
        x, y, z = at
        low, high = (y + GAP, y + 1) if down < 0 else (y + 1 - GAP, y)
        bottom, top = z * PLATE, (z + 3) * PLATE
        lip = 0.12
        profile = [(low, bottom), (high, bottom), (high, top), (low, bottom + lip)]
        points = np.array([(end, a, b) for end in (x + GAP, x + width - GAP) for a, b in profile])
        self.add(colour, solid(points, [(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]))

    def round(self, colour: str, centre: tuple[float, float, float], radius: float, height: float) -> None:
        """An upright round piece that stands on ``centre`` (studs, studs, plates); its height is in plates."""
        x, y, z = centre
        self.add(colour, cylinder(radius, height * PLATE - GAP, 32, bevel=0.04).moved((x, y, z * PLATE)))

    def finish(self) -> list[Part]:
        """All pieces with their uncovered studs, in world units, one part per colour."""
        stud = cylinder(0.3, 0.19, 24, bevel=0.04)
        for x, y, z, colour in self.studs:
            if (x, y, z) not in self.filled:
                self.add(colour, stud.moved((x + 0.5, y + 0.5, z * PLATE - GAP)))
        middle = (-BASE / 2, -BASE / 2, -6.7)
        return [
            Part(merge(meshes).moved(middle).scaled(SCALE), plastic(rgb(PALETTE[colour])))
            for colour, meshes in sorted(self.meshes.items())
        ]


def build(seed: int) -> Model:
    """The model; ``seed`` chooses the lengths of the bricks and the colours of the flowers."""
    rng = np.random.default_rng(seed)
    bricks = Bricks()
    _garden(bricks, rng)
    _walls(bricks, rng)
    _roof(bricks, rng)
    _tree(bricks)
    _conifer(bricks)
    _car(bricks)
    return Model(parts=bricks.finish(), lights={"studio": studio()})


def _garden(bricks: Bricks, rng: np.random.Generator) -> None:
    bricks.brick("green", (0, 0, -1), (BASE, BASE, 1))
    for step, y in enumerate(range(0, 4, 2)):
        bricks.brick("tan" if step % 2 else "grey", (6, y, 0), (2, 2, 1), smooth=True)
    bricks.brick("grey", (6, 4, 0), (2, 1, 1), smooth=True)
    for x in range(8, 14, 2):
        for y in (13, 14):
            bricks.brick("azure", (x, y, 0), (2, 1, 1), smooth=True)
    for x, y, radius in ((9.3, 14.2, 0.42), (11.6, 13.8, 0.34), (12.6, 14.6, 0.28)):
        bricks.round("lime", (x, y, 1), radius, 0.5)
    for x in (7, 14):
        bricks.brick("slate", (x, 13, 0), (1, 2, 2))
    for x, y in ((3, 3), (4, 2), (4, 4), (1, 5), (1, 8), (14, 9), (14, 6), (5, 14), (3, 13), (14, 11), (1, 2), (2, 1)):
        petals = ("pink", "yellow", "white", "violet", "red")[rng.integers(5)]
        bricks.round("forest", (x + 0.5, y + 0.5, 0), 0.14, 2)
        bricks.round(petals, (x + 0.5, y + 0.5, 2), 0.42, 1)
        bricks.round("amber", (x + 0.5, y + 0.5, 3), 0.2, 0.4)


@dataclass(frozen=True)
class Opening:
    """A hole in a wall: columns from ``start`` to ``end`` along it, courses from ``bottom`` up to, not with, ``top``."""

    start: int
    end: int
    bottom: int
    top: int


X0, X1, Y0, Y1, COURSES = 3, 13, 5, 12, 5
WALLS = {
    ("x", Y0): (Opening(4, 6, 1, 3), Opening(6, 8, 0, 3), Opening(9, 12, 1, 3)),
    ("x", Y1 - 1): (Opening(5, 7, 1, 3), Opening(9, 11, 1, 3)),
    ("y", X0): (Opening(7, 10, 1, 3),),
    ("y", X1 - 1): (Opening(7, 10, 1, 3),),
}


def _walls(bricks: Bricks, rng: np.random.Generator) -> None:
    for (axis, fixed), openings in WALLS.items():
        start, end = (X0, X1) if axis == "x" else (Y0, Y1)
        for course in range(COURSES):
            # Corners interlock: the walls along x own them in even courses, those along y in odd ones.
            inset = int((course % 2 == 0) != (axis == "x"))
            for low, high in _runs(start + inset, end - inset, [o for o in openings if o.bottom <= course < o.top]):
                for place, length in _lengths(low, high, course, rng):
                    corner = place in (start, end - length)
                    colour = "white" if corner and length == 1 else ("amber" if (course + place) % 5 else "yellow")
                    _lay(bricks, colour, axis, fixed, (place, length), course)
        for opening in openings:
            _fill(bricks, axis, fixed, opening)


def _runs(start: int, end: int, openings: Sequence[Opening]) -> list[tuple[int, int]]:
    """What is left of [start, end) between the openings."""
    edges = [start] + [edge for o in sorted(openings, key=lambda o: o.start) for edge in (o.start, o.end)] + [end]
    return [(low, high) for low, high in zip(edges[::2], edges[1::2], strict=True) if low < high]


def _lengths(low: int, high: int, course: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """(place, length) of the bricks that fill [low, high) in one course; ends differ from course to course."""
    pieces, place = [], low
    while place < high:
        wanted = (1 if course % 2 else 2) if place == low else int(rng.integers(2, 5))
        length = min(wanted, high - place)
        pieces.append((place, length))
        place += length
    return pieces


def _lay(bricks: Bricks, colour: str, axis: str, fixed: int, span: tuple[int, int], course: int) -> None:
    place, length = span
    if axis == "x":
        bricks.brick(colour, (place, fixed, 3 * course), (length, 1, 3))
    else:
        bricks.brick(colour, (fixed, place, 3 * course), (1, length, 3))


def _fill(bricks: Bricks, axis: str, fixed: int, opening: Opening) -> None:
    """A window with a frame and bars, or a door where the opening reaches the ground."""
    low, high = 3 * opening.bottom * PLATE, 3 * opening.top * PLATE
    door = opening.bottom == 0
    bar = 0.13

    def slab(colour: str, span: tuple[float, float], heights: tuple[float, float], depth: tuple[float, float]) -> None:
        along, across = np.array(span), fixed + np.array(depth)
        x, y = (along, across) if axis == "x" else (across, along)
        bricks.add(colour, box((x[0], y[0], heights[0]), (x[1], y[1], heights[1]), 0.02))

    start, end = opening.start + GAP, opening.end - GAP
    slab("blue" if door else "navy", (start, end), (low, high - GAP), (0.35, 0.65))
    posts = [start, end - bar] if door else [*np.linspace(start, end - bar, opening.end - opening.start + 1)]
    for post in posts:
        slab("white", (post, post + bar), (low, high - GAP), (0.1, 0.9))
    for level in (high - GAP - bar,) if door else (low, (low + high - bar) / 2, high - GAP - bar):
        slab("white", (start, end), (level, level + bar), (0.1, 0.9))
    if door:
        knob = cylinder(0.13, 0.5, 16).rotated(rotation("x", 90))
        bricks.add("yellow", knob.moved((end - 0.45, fixed + 0.4, 1.5)))


def _roof(bricks: Bricks, rng: np.random.Generator) -> None:
    top = 3 * COURSES
    _core(bricks, top * PLATE)
    for step in range(4):
        z = top + 3 * step
        for y, down in ((Y0 - 1 + step, -1), (Y1 - step, 1)):
            for place, length in _lengths(X0 - 1, X1 + 1, step, rng):
                bricks.slope("crimson" if (place + step) % 4 == 0 else "red", (place, y, z), length, down)
        for x in (X0, X1 - 1):
            bricks.brick("amber" if step % 2 else "white", (x, Y0 + step, z), (1, Y1 - Y0 - 2 * step, 3))
    for place, length in _lengths(X0 - 1, X1 + 1, 0, rng):
        bricks.brick("crimson", (place, 8, top + 12), (length, 1, 1))
    for course in range(4):
        bricks.brick("slate" if course % 2 else "grey", (10, 9, top + 6 + 3 * course), (2, 2, 3))
    bricks.brick("black", (10, 9, top + 18), (2, 2, 1))


def _core(bricks: Bricks, eaves: float) -> None:
    """Dark filling behind walls and roof, so that no ray slips through the seams into an empty house."""
    x0, x1, y0, y1, inset = X0 + 0.7, X1 - 0.7, Y0 + 0.7, Y1 - 0.7, 0.3
    bricks.add("black", box((x0, y0, 0.05), (x1, y1, eaves)))
    ridge = eaves + 3 * PLATE * (y1 - y0) / 2
    gable = [(y0, eaves), (y1, eaves), ((y0 + y1) / 2, ridge)]
    points = np.array([(x, y, z) for x in (X0 + inset, X1 - inset) for y, z in gable])
    bricks.add("black", solid(points, [(0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)]))


def _tree(bricks: Bricks) -> None:
    for level in range(4):
        bricks.round("brown", (2, 14, 3 * level), 0.62, 3)
    for z, half in ((11, 1), (12, 2), (14, 2), (16, 2), (18, 1), (20, 1)):
        x, y = 2 - half, 14 - half
        bricks.brick("lime" if z % 4 == 0 else "forest", (x, y, z), (2 * half, 2 * half, 2))


def _conifer(bricks: Bricks) -> None:
    bricks.round("brown", (14.5, 3.5, 0), 0.4, 3)
    for tier, radius in enumerate((1.4, 1.15, 0.9, 0.65, 0.4)):
        bricks.round("forest" if tier % 2 == 0 else "green", (14.5, 3.5, 2 + 2 * tier), radius, 2)
    bricks.round("yellow", (14.5, 3.5, 12), 0.25, 1)


def _car(bricks: Bricks) -> None:
    for x in (9.3, 11.9):
        for y in (0.42, 2.25):
            wheel = cylinder(0.55, 0.34, 32, bevel=0.06).rotated(rotation("x", 90)).moved((x, y + 0.34, 0.58))
            bricks.add("black", wheel)
            bricks.add("grey", cylinder(0.22, 0.4, 20).rotated(rotation("x", 90)).moved((x, y + 0.37, 0.58)))
    bricks.brick("slate", (8, 1, 2), (5, 1, 1), smooth=True)
    bricks.add("blue", box((8.02, 0.75, 1.0), (12.98, 2.25, 1.75), CHAMFER))
    bricks.add("azure", box((9.6, 0.85, 1.75), (11.9, 2.15, 2.5), CHAMFER))
    bricks.add("blue", box((9.5, 0.75, 2.5), (12.0, 2.25, 2.72), CHAMFER))
    bricks.add("white", box((10.65, 0.8, 1.75), (10.85, 2.2, 2.52), 0.02))
    for y in (1.05, 1.95):
        lamp = cylinder(0.16, 0.12, 20, bevel=0.03).rotated(rotation("y", 90))
        bricks.add("yellow", lamp.moved((12.95, y, 1.4)))
        bricks.add("red", lamp.moved((7.95, y, 1.4)))
