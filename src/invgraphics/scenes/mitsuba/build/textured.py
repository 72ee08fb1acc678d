"""``textured``: boxes, columns and balls in which no patch occurs twice, for structure from motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from invgraphics.scenes.mitsuba.build.mesh import Mesh, box, cylinder, merge, rotation, sphere
from invgraphics.scenes.mitsuba.build.model import Model, Part
from invgraphics.scenes.mitsuba.build.noise import Image, confetti
from invgraphics.scenes.mitsuba.build.surfaces import matte, rgb, studio

CELLS = 8
"""The texture is an atlas of CELLS x CELLS pictures; every face has a picture of its own."""
CELL = 192
GROUND = 2
"""The ground takes a block of GROUND x GROUND pictures."""

PALETTES = (
    ("#22304f", "#3f6fb0", "#e8e3d0", "#f2b134", "#d9452b"),
    ("#3d1f2b", "#a23b51", "#f0d9c4", "#5fb0a5", "#f4f1e8"),
    ("#1f3a2d", "#4f8f4c", "#d9e2b4", "#e9783a", "#2b2b2b"),
    ("#2e2350", "#7a5bb5", "#e6d7f2", "#f2d14a", "#36a3c9"),
    ("#4a2c17", "#b06f35", "#f1dfbd", "#2a6f97", "#c1272d"),
)
GROUND_PALETTE = ("#55606b", "#a8a598", "#e6e1d3", "#3a6ea5", "#c8553d", "#f0c14b", "#2f4b3a")

BOXES = (
    ((-0.38, -0.3), (0.44, 0.5, 0.62), 18.0),
    ((0.36, 0.28), (0.5, 0.36, 0.86), -27.0),
    ((0.42, -0.42), (0.36, 0.36, 0.36), 40.0),
    ((-0.4, 0.46), (0.5, 0.3, 0.26), 8.0),
)
"""(x, y) of the middle, edges, turn about z in degrees."""


def build(seed: int) -> Model:
    """The model; ``seed`` makes the pictures."""
    rng = np.random.default_rng(seed)
    atlas = Atlas(rng)
    meshes = list(atlas.faces(box((-0.86, -0.86, -0.08), (0.86, 0.86, 0)), ground=True))
    for (x, y), (w, d, h), turn in BOXES:
        block = box((-w / 2, -d / 2, 0), (w / 2, d / 2, h))
        meshes += [face.rotated(rotation("z", turn)).moved((x, y, 0)) for face in atlas.faces(block)]
    small = box((-0.14, -0.14, 0), (0.14, 0.14, 0.28)).rotated(rotation("z", 52)).moved((-0.38, -0.3, 0.62))
    meshes += atlas.faces(small)
    meshes.append(atlas.whole(sphere((-0.1, 0.12, 0.16), 0.16)))
    meshes.append(atlas.whole(sphere((-0.42, 0.46, 0.41), 0.15)))
    meshes.append(atlas.whole(cylinder(0.13, 0.5, 64).moved((0.02, -0.62, 0))))
    meshes.append(atlas.whole(cylinder(0.1, 0.72, 64).moved((0.02, 0.66, 0))))
    mesh = merge(meshes).moved((0, 0, -0.36))
    return Model(parts=[Part(mesh, matte(atlas.image))], lights={"studio": studio()})


class Atlas:
    """A large picture, handed out in cells; the first block belongs to the ground."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        size = CELLS * CELL
        self.image: Image = np.zeros((size, size, 3))
        self._free = [(i, j) for i in range(CELLS) for j in range(CELLS) if i >= GROUND or j >= GROUND]
        block = confetti(GROUND * CELL, [rgb(code) for code in GROUND_PALETTE], rng, shapes=200)
        self.image[: GROUND * CELL, : GROUND * CELL] = block

    def faces(self, solid: Mesh, ground: bool = False) -> Iterator[Mesh]:
        """The quadrilaterals of a box, each with its own cell; of the ground, the upper one has the large block."""
        for start in range(0, len(solid.vertices), 4):
            corners = slice(start, start + 4)
            face = Mesh(solid.vertices[corners], np.array([(0, 1, 2), (0, 2, 3)]), solid.normals[corners], solid.uv[corners])
            yield self._mapped(face, 0, 0, GROUND) if ground and face.normals[0, 2] > 0.5 else self.whole(face)

    def whole(self, mesh: Mesh) -> Mesh:
        """A mesh whose texture coordinates fill a new cell."""
        row, column = self._free.pop(0)
        palette = [rgb(code) for code in PALETTES[int(self._rng.integers(len(PALETTES)))]]
        place = (slice(row * CELL, (row + 1) * CELL), slice(column * CELL, (column + 1) * CELL))
        self.image[place] = confetti(CELL, palette, self._rng)
        return self._mapped(mesh, row, column, 1)

    def _mapped(self, mesh: Mesh, row: int, column: int, cells: int) -> Mesh:
        """Inset by a texel, so that interpolation does not reach the neighbour. Mitsuba's v runs downwards, as rows do."""
        inset = 1.5 / (CELL * cells)
        u, v = (inset + mesh.uv * (1 - 2 * inset)).T
        return replace(mesh, uv=np.stack([(column + u * cells) / CELLS, (row + v * cells) / CELLS], axis=1))
