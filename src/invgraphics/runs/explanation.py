"""``ray.json``: contributions along one pixel's ray, all lengths in `ExplanationRecord.length_unit`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from invgraphics.runs.schema import Record

Column = tuple[float | None, ...]
"""One number per entry; ``None`` where it is not finite."""

FIGURE, CSV, PICTURE, TRUTH = "ray", "ray.csv", "picture.png", "truth.png"
"""Beside the record: the figure's stem, the contributions as a table, the rendered view and the photograph."""


@dataclass(frozen=True, kw_only=True)
class Pixel:
    """Colours, alpha and depths of a pixel; colours over the scene's background, in its colour space.

    Attributes:
        column: from 0, from the left.
        row: from 0, from the top.
        alpha: opacity of the contributions together.
        depth: of the rendering.
        expected: mean distance of the light.
        median: distance at which half of it is reached.
        true: colour of the photograph.
        true_alpha: of the photograph.
        true_depth: of the truth.
        rendered: colour of the rendering.
        composited: colour of the contributions.
    """

    column: int
    row: int
    alpha: float | None = None
    depth: float | None = None
    expected: float | None = None
    median: float | None = None
    true: Column
    true_alpha: float | None = None
    true_depth: float | None = None
    rendered: Column
    composited: Column = ()


@dataclass(frozen=True, kw_only=True)
class Contributions:
    """Columns of the contributions, in the order in which they are composited.

    Attributes:
        t: distance: the interval's middle, or the largest response of a Gaussian.
        begin: where the interval begins; for Gaussians, one standard deviation nearer.
        end: where it ends; for Gaussians, one standard deviation farther.
        alpha: opacity of each by itself.
        transmittance: share of its light that the others let through.
        weight: share of the pixel's light.
        density: at the samples, per unit of length; ``None`` for Gaussians.
        red: colour in the scene's colour space; likewise ``green`` and ``blue``.
        green: see ``red``.
        blue: see ``red``.
        counted: 1 where the renderer took the colour into account, else 0.
    """

    t: Column
    begin: Column
    end: Column
    alpha: Column
    transmittance: Column
    weight: Column
    density: Column | None = None
    red: Column
    green: Column
    blue: Column
    counted: Column


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Density and transmittance along a ray at increasing distances.

    Attributes:
        t: distance.
        density: per unit of length; ``None`` where the field has none.
        transmittance: share of the light from t that reaches the camera.
    """

    t: Column
    density: Column | None = None
    transmittance: Column


@dataclass(frozen=True, kw_only=True)
class SamplerPass:
    """Weights of an earlier sampler pass in its intervals [t0, t1]."""

    t0: Column
    t1: Column
    weight: Column


@dataclass(frozen=True, kw_only=True)
class DeadPrimitives:
    """Primitives of the whole model that can receive no gradient: their share, and number and causes in a sentence."""

    share: float | None
    sentence: str


@dataclass(frozen=True, kw_only=True)
class ExplanationRecord(Record):
    """Record of a pixel's ray: near and far, contributions, profile and sampler passes.

    Attributes:
        method: ``renderer/recipe``.
        scene: its name.
        split: ``test`` or ``train``.
        view: index in the split.
        name: of the view.
        colour: the scene's colour space, ``srgb`` or ``linear``.
        background: of the scene, in that colour space.
        kind: of the contributions, in the plural: ``samples`` are intervals of a field; ``splats`` in the order of the picture;
            ``Gaussians`` met along the ray; ``surface points``, one at most, where a ray is traced to a surface;
            of a mesh, those of all rays of the pixel.
        length_unit: of all distances and densities: ``world``, the data set's; ``local`` in older files, which lack the key.
        near: where the ray enters the scene's bounds.
        far: where it leaves them.
        space: kind of the bounds, ``box`` or ``contracted``.
        pixel: the pixel.
        contributions: in columns.
        dead: of the whole model; ``None`` for fields without Gaussians.
        profile: density and transmittance between the contributions.
        marched: of splats: the same Gaussians as overlapping densities.
        passes: earlier passes of the sampler, first to last.
    """

    FILE: ClassVar[str] = "ray.json"

    method: str
    scene: str
    split: Literal["test", "train"]
    view: int
    name: str = ""
    colour: Literal["srgb", "linear"]
    background: tuple[float, float, float]
    kind: str
    length_unit: Literal["world", "local"] = "local"
    near: float | None = None
    far: float | None = None
    space: str = "box"
    pixel: Pixel
    contributions: Contributions
    dead: DeadPrimitives | None = None
    profile: Profile | None = None
    marched: Profile | None = None
    passes: tuple[SamplerPass, ...] = ()
