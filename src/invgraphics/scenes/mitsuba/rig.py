"""Where cameras stand. Every split follows the same low-discrepancy sequence, shifted, so that no two share a camera.

Shifts by which a whole split would run along beside the training cameras are drawn again (`_shifts`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.config import fill
from invgraphics.core import Camera
from invgraphics.core.transforms import look_at
from invgraphics.errors import InputError
from invgraphics.scenes.mitsuba.spec import Vector

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")
UP = (0.0, 0.0, 1.0)
LEAST_GAP, NEIGHBOURS = 0.35, 64
"""Least distance in the unit cube of any camera of a split to one of the training cameras, as a share of the smallest distance
of two cameras of one split at most so many numbers apart."""
DRAWS = 100
"""Shifts that are drawn at most; two of three have such a distance."""


@dataclass(frozen=True)
class Sphere:
    """All around the target, also from below.

    Attributes:
        radius: distance from the target.
        fov: field of view across the image's shorter side, degrees.
        target: the point looked at.
        elevation: lowest and highest angle above the horizon, degrees.
        azimuth: first and last angle around the target from +x, degrees.
    """

    radius: float
    fov: float = 40.0
    target: Vector = (0.0, 0.0, 0.0)
    elevation: tuple[float, float] = (-80.0, 80.0)
    azimuth: tuple[float, float] = (0.0, 360.0)

    dimensions: ClassVar[int] = 2

    def __post_init__(self) -> None:
        if self.radius <= 0:
            raise ValueError("'radius' must be positive")
        if not -90 < self.elevation[0] <= self.elevation[1] < 90:
            raise ValueError("'elevation' must ascend within -90 to 90 degrees, poles excluded")

    def pose(self, unit: Float[Tensor, " d"]) -> Float[Tensor, "4 4"]:
        """The camera at a point of the unit square, uniform over the solid angle."""
        low, high = (math.sin(math.radians(angle)) for angle in self.elevation)
        sine = low + (high - low) * float(unit[1])
        eye = _tensor(self.target) + self.radius * _direction(_between(self.azimuth, unit[0]), math.asin(sine))
        return look_at(eye, _tensor(self.target), _tensor(UP))


@dataclass(frozen=True)
class Hemisphere(Sphere):
    """Around and above the target: what is seen of a thing that stands on a table."""

    elevation: tuple[float, float] = (5.0, 75.0)


@dataclass(frozen=True)
class Forward:
    """On a window in front of the scene, all looking at the target: the capture of LLFF.

    Attributes:
        eye: centre of the window.
        extent: half width and half height of the window.
        fov: field of view across the image's shorter side, degrees.
        target: the point looked at.
    """

    eye: Vector
    extent: tuple[float, float] = (0.5, 0.4)
    fov: float = 40.0
    target: Vector = (0.0, 0.0, 0.0)

    dimensions: ClassVar[int] = 2

    def __post_init__(self) -> None:
        if self.eye == self.target:
            raise ValueError("'eye' and 'target' cannot be the same point")

    def pose(self, unit: Float[Tensor, " d"]) -> Float[Tensor, "4 4"]:
        """The camera at a point of the window."""
        frame = look_at(_tensor(self.eye), _tensor(self.target), _tensor(UP))
        x, y = (extent * float(2 * u - 1) for extent, u in zip(self.extent, unit, strict=True))
        return look_at(frame[:3, 3] + x * frame[:3, 0] + y * frame[:3, 1], _tensor(self.target), _tensor(UP))


@dataclass(frozen=True)
class InsideOut:
    """From within a closed space, looking outwards in all directions.

    Attributes:
        target: centre of the box in which the cameras stand.
        extent: half edges of that box.
        fov: field of view across the image's shorter side, degrees.
        elevation: lowest and highest viewing angle above the horizon, degrees.
        azimuth: first and last viewing direction from +x, degrees.
        setback: how far each camera steps back, horizontally, from what it looks at.
    """

    extent: Vector
    fov: float = 70.0
    target: Vector = (0.0, 0.0, 0.0)
    elevation: tuple[float, float] = (-25.0, 10.0)
    azimuth: tuple[float, float] = (0.0, 360.0)
    setback: float = 0.0

    dimensions: ClassVar[int] = 5

    def pose(self, unit: Float[Tensor, " d"]) -> Float[Tensor, "4 4"]:
        """The camera of a point of the unit cube: viewing angles, then position."""
        azimuth = _between(self.azimuth, unit[0])
        forward = _direction(azimuth, _between(self.elevation, unit[1]))
        eye = _tensor(self.target) + _tensor(self.extent) * (2 * unit[2:] - 1) - self.setback * _direction(azimuth, 0.0)
        return look_at(eye, eye + forward, _tensor(UP))


Rig = Sphere | Hemisphere | Forward | InsideOut
RIGS: dict[str, type[Rig]] = {"sphere": Sphere, "hemisphere": Hemisphere, "forward": Forward, "inside_out": InsideOut}


def make_rig(table: Mapping[str, Any]) -> Rig:
    """The rig that a scene's ``rig`` table describes.

    Raises:
        InputError: unknown ``kind`` or parameter.
    """
    kind = table.get("kind")
    if kind not in RIGS:
        raise InputError(f"The rig kind '{kind}' is unknown.", f"Known kinds: {', '.join(RIGS)}.")
    rig = fill(RIGS[kind], {key: value for key, value in table.items() if key != "kind"}, "rig")
    if not 0 < rig.fov < 180:
        raise InputError(f"'rig.fov' cannot be {rig.fov}.", "Expected: degrees between 0 and 180.")
    return rig


def cameras(rig: Rig, split: Split, count: int, size: tuple[int, int], seed: int) -> tuple[Camera, ...]:
    """The first ``count`` cameras of a split (float64): a longer split begins with the shorter one's.

    Args:
        rig: where they stand.
        split: shifts the sequence.
        count: how many.
        size: width and height in pixels.
        seed: another seed gives other cameras of every split.
    """
    width, height = size
    focal = 0.5 * min(size) / math.tan(math.radians(rig.fov) / 2)
    units = _low_discrepancy(count, _shifts(rig.dimensions, seed)[SPLITS.index(split)])
    return tuple(
        Camera(rig.pose(unit), _tensor((focal, focal)), _tensor((width / 2, height / 2)), width, height) for unit in units
    )


def _low_discrepancy(count: int, shift: Float[Tensor, " d"]) -> Float[Tensor, "n d"]:
    """Points of the unit cube by the additive recurrence R_d (Roberts 2018), whose prefixes are even too."""
    return (shift + torch.arange(1, count + 1, dtype=torch.float64)[:, None] * _steps(len(shift))) % 1.0


def _steps(dimensions: int) -> Float[Tensor, " d"]:
    """Difference of two successive points of the recurrence."""
    root = 2.0
    for _ in range(64):  # fixed point of x = (1 + x)^(1 / (d + 1)), the generalised golden ratio
        root = (1 + root) ** (1 / (dimensions + 1))
    return torch.tensor([root ** -(axis + 1) for axis in range(dimensions)], dtype=torch.float64)


def _shifts(dimensions: int, seed: int) -> Float[Tensor, "splits d"]:
    """Random shift of each split's sequence, with a gap between the cameras of the first split and those of each other.

    Two sequences differ by their shift alone, so that one that lies near a multiple of the step puts every camera of a split
    beside a training camera, and scores it on views that are known.
    """
    generator = torch.Generator().manual_seed(seed)
    shifts = torch.rand(len(SPLITS), dimensions, generator=generator, dtype=torch.float64)
    multiples = torch.arange(-NEIGHBOURS, NEIGHBOURS + 1, dtype=torch.float64)[:, None] * _steps(dimensions)
    least = LEAST_GAP * _torus_norm(multiples[NEIGHBOURS + 1 :]).min()
    for split in range(1, len(SPLITS)):
        for _ in range(DRAWS):
            if _torus_norm(shifts[split] - shifts[0] - multiples).min() >= least:
                break
            shifts[split] = torch.rand(dimensions, generator=generator, dtype=torch.float64)
    return shifts


def _torus_norm(difference: Float[Tensor, "n d"]) -> Float[Tensor, " n"]:
    """Distance in the unit cube, whose opposite faces are one."""
    return (difference - difference.round()).norm(dim=1)


def _tensor(values: tuple[float, ...]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _between(degrees: tuple[float, float], unit: Tensor) -> float:
    """The angle in radians at ``unit`` of the way."""
    return math.radians(degrees[0] + (degrees[1] - degrees[0]) * float(unit))


def _direction(azimuth: float, elevation: float) -> Float[Tensor, 3]:
    flat = math.cos(elevation)
    return _tensor((flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)))
