"""``room``: a furnished living room, seen from within and lit by one panel in its ceiling."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from invgraphics.scenes.mitsuba.build.fence import leaf
from invgraphics.scenes.mitsuba.build.mesh import Mesh, box, cylinder, lathe, merge, polygon, rotation, tube
from invgraphics.scenes.mitsuba.build.model import Ball, Model, Part
from invgraphics.scenes.mitsuba.build.noise import Image, checkers, confetti, fractal, ramp, wood
from invgraphics.scenes.mitsuba.build.surfaces import glass, matte, metal, plastic, rgb, two_sided

X, Y, FLOOR, CEILING = 1.6, 1.3, -0.9, 0.9
BOOKS = ("#b23a48", "#2f6690", "#e0a458", "#3f7d58", "#6b4e71", "#d8d2c4", "#1f2d3d", "#d1603d")
ARTS = (
    ("#1d3557", "#e63946", "#f1faee", "#a8dadc"),
    ("#264653", "#2a9d8f", "#e9c46a", "#e76f51"),
    ("#3d2c2e", "#d17b88", "#f4d6cc", "#5b8e7d"),
)


def build(seed: int) -> Model:
    """The model; ``seed`` makes wallpaper, pictures and books."""
    rng = np.random.default_rng(seed)
    parts = [*_shell(rng), *_shelf(rng), *_sofa(), *_table(), *_pictures(rng), *_corner(rng)]
    balls = [
        Ball((0.78, -0.12, FLOOR + 0.5), 0.085, glass()),
        Ball((0.98, 0.12, FLOOR + 0.47), 0.055, metal("Cu", 0.15)),
        Ball((-1.25, -0.95, FLOOR + 0.94), 0.2, matte(rgb("#f4e3c1"))),
    ]
    return Model(parts=parts, balls=balls)


def _wall(corners: Sequence[tuple[float, float, float]], image: Image) -> Part:
    """A textured quadrilateral that faces the room's middle; the picture's first row is along its last edge."""
    flat = polygon(np.array(corners, dtype=float))
    if flat.normals[0] @ (flat.vertices.mean(axis=0)) > 0:
        flat = replace(flat, faces=flat.faces[:, ::-1], normals=-flat.normals)
    return Part(replace(flat, uv=np.column_stack([flat.uv[:, 0], 1 - flat.uv[:, 1]])), matte(image))


def _shell(rng: np.random.Generator) -> Iterator[Part]:
    """Floor, ceiling, four walls that all differ, skirting and the lamp."""
    yield _wall([(-X, -Y, FLOOR), (X, -Y, FLOOR), (X, Y, FLOOR), (-X, Y, FLOOR)], wood((512, 640), 12, rng))
    plain = ramp(fractal((64, 64), 4, 3, rng), [rgb("#efece4"), rgb("#f6f4ee")])
    yield _wall([(-X, -Y, CEILING), (X, -Y, CEILING), (X, Y, CEILING), (-X, Y, CEILING)], plain)
    yield _wall([(-X, Y, FLOOR), (X, Y, FLOOR), (X, Y, CEILING), (-X, Y, CEILING)], _wallpaper(rng))
    yield _wall([(X, -Y, FLOOR), (-X, -Y, FLOOR), (-X, -Y, CEILING), (X, -Y, CEILING)], _plaster(rng, "#c9d8d4", "#dbe6e1"))
    yield _wall([(X, Y, FLOOR), (X, -Y, FLOOR), (X, -Y, CEILING), (X, Y, CEILING)], _bricks(rng))
    yield _wall([(-X, -Y, FLOOR), (-X, Y, FLOOR), (-X, Y, CEILING), (-X, -Y, CEILING)], _plaster(rng, "#d9a066", "#e8b884"))
    edges = [((-X, Y - 0.02), (X, Y)), ((-X, -Y), (X, -Y + 0.02)), ((X - 0.02, -Y), (X, Y)), ((-X, -Y), (-X + 0.02, Y))]
    yield Part(merge(box((*lo, FLOOR), (*hi, FLOOR + 0.1)) for lo, hi in edges), matte(rgb("#f2efe6")))
    lamp = polygon(
        np.array(
            [
                (-0.5, -0.38, CEILING - 0.02),
                (-0.5, 0.38, CEILING - 0.02),
                (0.5, 0.38, CEILING - 0.02),
                (0.5, -0.38, CEILING - 0.02),
            ]
        )
    )
    yield Part(lamp, matte((0.0, 0.0, 0.0)), radiance=(12.0, 11.4, 10.2))
    yield Part(box((-0.53, -0.41, CEILING - 0.018), (0.53, 0.41, CEILING)), matte(rgb("#d0cdc4")))


def _wallpaper(rng: np.random.Generator) -> Image:
    """Broad stripes with a row of diamonds."""
    y, x = np.mgrid[:384, :640] / 384
    stripe = np.floor(x * 12) % 2 == 0
    diamonds = np.abs((x * 12) % 1 - 0.5) + np.abs((y * 8) % 1 - 0.5) < 0.16
    image = np.where(stripe[..., None], np.array(rgb("#31556e")), np.array(rgb("#3b6683")))
    image = np.where((diamonds & stripe)[..., None], np.array(rgb("#e6c277")), image)
    return image * (0.85 + 0.15 * fractal((384, 640), 16, 3, rng))[..., None]


def _plaster(rng: np.random.Generator, dark: str, light: str) -> Image:
    return ramp(fractal((256, 384), 7, 5, rng), [rgb(dark), rgb(light)])


def _bricks(rng: np.random.Generator) -> Image:
    """A running bond with mortar, each brick of its own tone."""
    height, width, rows, columns = 360, 520, 18, 11
    y, x = np.mgrid[:height, :width]
    row = y * rows // height
    across = x * columns / width + 0.5 * (row % 2)
    tone = rng.random((rows, columns + 2))[row, across.astype(int)]
    mortar = (np.abs(across - np.round(across)) < 0.035) | (np.abs(y * rows / height - np.round(y * rows / height)) < 0.06)
    image = ramp(0.75 * tone + 0.25 * fractal((height, width), 40, 3, rng), [rgb("#8a4534"), rgb("#a85a41"), rgb("#c27a58")])
    return np.where(mortar[..., None], np.array(rgb("#cfc6b8")), image)


def _shelf(rng: np.random.Generator) -> Iterator[Part]:
    """A bookcase on the wall at -y."""
    x0, x1, depth, levels, pitch = -0.75, 0.35, 0.24, 4, 0.33
    back = -Y + 0.005
    frame = [box((x, back, FLOOR), (x + 0.03, back + depth, FLOOR + levels * pitch), 0.004) for x in (x0, x1 - 0.03)]
    frame += [
        box((x0, back, FLOOR + k * pitch), (x1, back + depth, FLOOR + k * pitch + 0.025), 0.004) for k in range(levels + 1)
    ]
    books: dict[str, list[Mesh]] = {}
    for level in range(levels):
        x = x0 + 0.04
        while x < x1 - 0.12:
            thick, tall = 0.025 + 0.035 * rng.random(), 0.18 + 0.09 * rng.random()
            bottom = FLOOR + level * pitch + 0.025
            book = box((x, back + 0.02, bottom), (x + thick - 0.003, back + 0.15 + 0.06 * rng.random(), bottom + tall), 0.004)
            books.setdefault(BOOKS[int(rng.integers(len(BOOKS)))], []).append(book)
            x += thick if rng.random() > 0.1 else thick + 0.09
    yield Part(merge(frame), matte(rgb("#7d5636")))
    yield from (Part(merge(meshes), matte(rgb(colour))) for colour, meshes in books.items())


def _sofa() -> Iterator[Part]:
    """Along the wall at +y, with two cushions, and a rug before it."""
    y = Y - 0.04
    body = [
        box((-0.85, y - 0.5, FLOOR + 0.08), (0.55, y, FLOOR + 0.3), 0.03),
        box((-0.85, y - 0.16, FLOOR + 0.3), (0.55, y, FLOOR + 0.66), 0.05),
        *(box((x, y - 0.52, FLOOR + 0.08), (x + 0.14, y, FLOOR + 0.46), 0.04) for x in (-0.98, 0.54)),
        *(box((x, y - 0.5, FLOOR + 0.3), (x + 0.68, y - 0.15, FLOOR + 0.39), 0.035) for x in (-0.84, -0.15)),
    ]
    yield Part(merge(body), matte(rgb("#3f7f7a")))
    pillow = box((-0.17, -0.05, -0.16), (0.17, 0.05, 0.16), 0.045)
    for x, turn, colour in ((-0.66, 14, "#e3a72f"), (0.34, -16, "#cf5c41")):
        cushion = pillow.rotated(rotation("z", turn) @ rotation("x", 14)).moved((x, y - 0.27, FLOOR + 0.56))
        yield Part(cushion, matte(rgb(colour)))
    rug = box((-0.75, -0.62, FLOOR), (0.75, 0.5, FLOOR + 0.012), 0.004)
    uv = (rug.vertices[:, :2] - rug.vertices[:, :2].min(axis=0)) / np.ptp(rug.vertices[:, :2], axis=0)
    yield Part(replace(rug, uv=uv), matte(checkers(480, 12, rgb("#b5413b"), rgb("#efe2c4"))))


def _table() -> Iterator[Part]:
    """A low table with a vase, and a stool."""
    top = cylinder(0.34, 0.035, 64, 0.01).moved((0.85, 0.02, FLOOR + 0.38))
    legs = [
        tube(
            np.array(
                [
                    (0.85 + 0.12 * np.cos(a), 0.02 + 0.12 * np.sin(a), FLOOR + 0.38),
                    (0.85 + 0.2 * np.cos(a), 0.02 + 0.2 * np.sin(a), FLOOR + 0.19),
                    (0.85 + 0.28 * np.cos(a), 0.02 + 0.28 * np.sin(a), FLOOR),
                ]
            ),
            0.014,
            10,
        )
        for a in np.radians((30, 150, 270))
    ]
    yield Part(merge([top, *legs]), plastic(rgb("#a9713f"), 0.25))
    vase = lathe([(0, 0), (0.05, 0), (0.075, 0.07), (0.05, 0.15), (0.028, 0.19), (0.04, 0.22), (0.03, 0.22), (0, 0.1)], 48)
    yield Part(vase.moved((0.95, -0.14, FLOOR + 0.415)), plastic(rgb("#2b59a3"), 0.08))
    yield Part(box((0.62, 0.0, FLOOR + 0.415), (0.78, 0.22, FLOOR + 0.44), 0.004), matte(rgb("#e0a458")))
    yield Part(box((0.64, 0.02, FLOOR + 0.44), (0.77, 0.2, FLOOR + 0.46), 0.004), matte(rgb("#6b4e71")))


def _pictures(rng: np.random.Generator) -> Iterator[Part]:
    """Framed paintings on three walls."""
    places = (
        ("y", Y, -0.55, 0.25, 0.5, 0.36),
        ("y", Y, 0.25, 0.3, 0.34, 0.46),
        ("x", X, 0.1, 0.18, 0.7, 0.5),
        ("x", -X, 0.35, 0.2, 0.46, 0.58),
    )
    for index, (axis, wall, along, up, width, height) in enumerate(places):
        inward = -np.sign(wall)
        a, b, low, high = along - width / 2, along + width / 2, up - height / 2, up + height / 2
        near, front = sorted((wall, wall + inward * 0.03)), wall + inward * 0.0305
        edges = ((a - 0.025, near[0], low - 0.025), (b + 0.025, near[1], high + 0.025))
        frame = box(*edges) if axis == "y" else box(*((y, x, z) for x, y, z in edges), chamfer=0.0)
        yield Part(frame, matte(rgb(("#2a2320", "#c9a86a", "#f0ece2", "#2a2320")[index])))
        rect = [(a, front, low), (b, front, low), (b, front, high), (a, front, high)]
        art = confetti(256, [rgb(code) for code in ARTS[index % len(ARTS)]], rng, shapes=36)
        yield _wall(rect if axis == "y" else [(y, x, z) for x, y, z in rect], art)


def _corner(rng: np.random.Generator) -> Iterator[Part]:
    """A floor lamp, a plant in a pot and a chest in the corners."""
    stand = merge([cylinder(0.16, 0.025, 48, 0.008), cylinder(0.014, 0.8, 16)]).moved((-1.25, -0.95, FLOOR))
    yield Part(stand, metal("Al", 0.25))
    foot = np.array([1.2, 0.9, FLOOR])
    yield Part(lathe([(0, 0), (0.1, 0), (0.15, 0.26), (0.13, 0.26), (0, 0.23)], 48).moved(foot), plastic(rgb("#efe9dc"), 0.3))
    blades = []
    for _ in range(46):
        turn, lift = 2 * np.pi * rng.random(), 0.5 + 0.8 * rng.random()
        blade = leaf(0.42 + 0.2 * rng.random(), 0.035, 0.55).rotated(rotation("y", -np.degrees(lift)))
        blades.append(blade.rotated(rotation("z", np.degrees(turn))).scaled(0.5).moved(foot + np.array([0, 0, 0.24])))
    yield Part(merge(blades), two_sided(matte(rgb("#3f8f4a"))))
    chest = box((1.15, -1.2, FLOOR), (1.57, -0.5, FLOOR + 0.5), 0.01)
    drawers = [box((1.142, -1.17, FLOOR + z), (1.152, -0.53, FLOOR + z + 0.2), 0.003) for z in (0.03, 0.26)]
    yield Part(chest, matte(rgb("#e8e2d4")))
    yield Part(merge(drawers), matte(rgb("#8fb8c9")))
