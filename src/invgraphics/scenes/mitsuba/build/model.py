"""What a builder makes: geometry, materials, lights and fog, described without Mitsuba.

Materials and lights are Mitsuba's own dictionaries, in which a numpy array stands for what Mitsuba has objects for: (h, w, 3)
a texture of linear values, or (4, 4) a transform.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from invgraphics.scenes.mitsuba.build.mesh import Mesh

Material = dict[str, Any]


@dataclass(frozen=True)
class Part:
    """A mesh, what it is made of, and the linear radiance that it emits (if it is a lamp)."""

    mesh: Mesh
    material: Material
    radiance: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Ball:
    """An exact sphere and what it is made of."""

    centre: tuple[float, float, float]
    radius: float
    material: Material


@dataclass(frozen=True)
class Fog:
    """A heterogeneous medium in an axis-aligned box.

    Attributes:
        extinction: per world unit, at the centres of the cells of a regular grid, indexed [x, y, z].
        albedo: scattering over extinction.
        anisotropy: mean cosine of the Henyey-Greenstein phase function.
        lo: lowest corner of the box.
        hi: highest corner of the box.
    """

    extinction: Float[np.ndarray, "x y z"]
    albedo: tuple[float, float, float]
    anisotropy: float
    lo: tuple[float, float, float]
    hi: tuple[float, float, float]


@dataclass(frozen=True)
class Model:
    """A whole scene without its cameras.

    Attributes:
        parts: meshes.
        balls: spheres.
        lights: Mitsuba emitters at infinity.
        fog: the medium, where there is one.
    """

    parts: list[Part] = field(default_factory=list)
    balls: list[Ball] = field(default_factory=list)
    lights: dict[str, dict[str, Any]] = field(default_factory=dict)
    fog: Fog | None = None
