"""Explanation of one pixel of a run: all contributions along its ray, written to a folder as figure and table."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from PIL import Image
from torch import Tensor

from invgraphics.core import Camera, Contributions, Profile, Rendering, Scene, View
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import display
from invgraphics.experiments.fitted import Fitted, open_fitted
from invgraphics.files import write_picture, writing_text
from invgraphics.runs.explanation import CSV, PICTURE, TRUTH, DeadPrimitives, ExplanationRecord, Pixel, SamplerPass
from invgraphics.runs.explanation import Contributions as Columns
from invgraphics.runs.explanation import Profile as ProfileRecord
from invgraphics.runs.folder import output_folder
from invgraphics.runs.schema import plain
from invgraphics.training.limits import dead_gaussians

Split = Literal["test", "train"]

DIGITS = 7
"""Significant digits of numbers in files, as many as float32 has."""


@dataclass(frozen=True)
class ExplainRequest:
    """What to explain.

    Attributes:
        run: folder of the run.
        view: index of the view in its split.
        pixel: column and row, from 0, from the upper left corner.
        split: whose views are counted.
        out: folder to write; ``None`` for one inside the run.
        scene: another copy of the run's scene.
    """

    run: Path
    view: int
    pixel: tuple[int, int]
    split: Split = "test"
    out: Path | None = None
    scene: str | None = None

    @property
    def folder(self) -> Path:
        """Output folder."""
        column, row = self.pixel
        return self.out or self.run / "explained" / f"{self.split}-{self.view:04d}-{column}-{row}"


@dataclass(frozen=True, eq=False)
class Explanation:
    """A pixel's colour and the contributions along its ray.

    Attributes:
        folder: holds the record, the contributions as a table, the picture and the photograph.
        contributions: in the order in which they are composited, world units.
        rendered: colour of the pixel as `render` shows it, in front of the scene's background.
        composited: the same from the contributions.
        record: everything, as in the file.
    """

    folder: Path
    contributions: Contributions
    rendered: Tensor
    composited: Tensor
    record: ExplanationRecord


def explain(request: ExplainRequest) -> Explanation:
    """List all contributions along the ray of a run's pixel, and write them to a folder.

    Raises:
        InputError: the run cannot be opened, has no such view or pixel, or its renderer has nothing to show along rays.
    """
    fitted = open_fitted(request.run, request.scene).in_its_frame()
    view = _view(fitted.scene, request)
    found = in_world_units(fitted.model.contributions(view.camera, request.pixel), fitted.scene.scale)
    picture = fitted.model.render(view.camera, normals=False)

    column, row = request.pixel
    background = fitted.scene.background
    rendered = picture.over(background)[row, column]
    composited = found.colour + (1 - found.opacity) * background
    record = _record(fitted, request, view, found, picture)
    explanation = Explanation(request.folder, found, rendered, composited, record)
    with output_folder(request.folder):
        _write(explanation, view, picture, fitted.scene)
    return explanation


def in_world_units(found: Contributions, scale: float) -> Contributions:
    """Convert contributions to world units: distances times ``scale``, the world length of a local unit, densities over it."""

    def profile(one: Profile | None) -> Profile | None:
        if one is None:
            return None
        return replace(one, t=one.t * scale, density=None if one.density is None else one.density / scale)

    return replace(
        found,
        t=found.t * scale,
        begin=found.begin * scale,
        end=found.end * scale,
        density=None if found.density is None else found.density / scale,
        profile=profile(found.profile),
        marched=profile(found.marched),
        passes=tuple(replace(one, t0=one.t0 * scale, t1=one.t1 * scale) for one in found.passes),
    )


def _view(scene: Scene, request: ExplainRequest) -> View:
    """Select the requested view, with the pixel checked.

    Raises:
        InputError: there is no such view, or it has no such pixel.
    """
    views = getattr(scene, request.split)
    if not 0 <= request.view < len(views):
        raise InputError(f"--view cannot be {request.view}.", f"Expected a {request.split} view, 0 to {len(views) - 1}.")
    camera: Camera = views[request.view].camera
    column, row = request.pixel
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise InputError(
            f"The pixel {column},{row} lies outside {request.split} view {request.view}, of {camera.width}x{camera.height} "
            "pixels.",
            f"Expected a column from 0 to {camera.width - 1} and a row from 0 to {camera.height - 1}.",
        )
    return views[request.view]


def _record(fitted: Fitted, request: ExplainRequest, view: View, found: Contributions, picture: Rendering) -> ExplanationRecord:
    """Make the record of the explanation, all lengths in world units."""
    scene, (column, row) = fitted.scene, request.pixel
    ray = scene.bounds.clip(view.camera.rays(view.camera.focal.new_tensor([[column + 0.5, row + 0.5]])))
    red, green, blue = scene.background.double().tolist()
    return ExplanationRecord(
        method=fitted.method.name,
        scene=scene.name,
        split=request.split,
        view=request.view,
        name=view.name,
        colour=scene.colour,
        background=(_rounded(red), _rounded(green), _rounded(blue)),
        kind=found.kind,
        length_unit="world",
        near=_number(ray.near[0] * scene.scale),
        far=_number(ray.far[0] * scene.scale),
        space=scene.bounds.space,
        pixel=_pixel(request, view, found, picture, scene),
        contributions=_columns(found),
        dead=_dead(fitted),
        profile=_profile(found.profile),
        marched=_profile(found.marched),
        passes=tuple(SamplerPass(t0=_row(one.t0), t1=_row(one.t1), weight=_row(one.weight)) for one in found.passes),
    )


def _pixel(request: ExplainRequest, view: View, found: Contributions, picture: Rendering, scene: Scene) -> Pixel:
    """Colour, alpha and depth of the pixel: rendered, true, and composited from the contributions."""
    (column, row), background = request.pixel, scene.background
    return Pixel(
        column=column,
        row=row,
        alpha=_number(found.opacity),
        depth=_number(picture.depth[row, column] * scene.scale),
        expected=_number(found.expected_depth),
        median=_number(found.median_depth),
        true=_row(view.over(background)[row, column]),
        true_alpha=None if view.alpha is None else _number(view.opacity()[row, column]),
        true_depth=None if view.depth is None else _number(view.depth[row, column] * scene.scale),
        rendered=_row(picture.over(background)[row, column]),
        composited=_row(found.colour + (1 - found.opacity) * background),
    )


def _dead(fitted: Fitted) -> DeadPrimitives | None:
    """Share, number and causes of primitives that no gradient can change; ``None`` for fields without Gaussians."""
    dead = dead_gaussians(fitted.model.field, [view.camera for view in fitted.scene.train])
    return None if dead is None else DeadPrimitives(share=_number(dead.share), sentence=dead.sentence())


def _columns(found: Contributions) -> Columns:
    red, green, blue = (_row(found.rgb[:, index]) for index in range(3))
    return Columns(
        t=_row(found.t),
        begin=_row(found.begin),
        end=_row(found.end),
        alpha=_row(found.alpha),
        transmittance=_row(found.transmittance),
        weight=_row(found.weight),
        density=None if found.density is None else _row(found.density),
        red=red,
        green=green,
        blue=blue,
        counted=tuple(found.counted.int().tolist()),
    )


def _profile(profile: Profile | None) -> ProfileRecord | None:
    if profile is None:
        return None
    density = None if profile.density is None else _row(profile.density)
    return ProfileRecord(t=_row(profile.t), density=density, transmittance=_row(profile.transmittance))


def _row(values: Tensor) -> tuple[float | None, ...]:
    return tuple(_number(value) for value in values.double().tolist())


def _number(value: Tensor | float) -> float | None:
    """Round a scalar to `DIGITS` significant digits; ``None`` where it is not finite."""
    number = float(value)
    return _rounded(number) if math.isfinite(number) else None


def _rounded(number: float) -> float:
    return float(f"{number:.{DIGITS}g}")


def _write(explanation: Explanation, view: View, picture: Rendering, scene: Scene) -> None:
    """Write the explanation's folder: record, table, picture and photograph."""
    folder = explanation.folder
    for name, colour in ((PICTURE, picture.over(scene.background)), (TRUTH, view.over(scene.background))):
        write_picture(folder / name, Image.fromarray(display(colour, scene).numpy()))
    columns = {name: values for name, values in plain(explanation.record.contributions).items() if values is not None}
    with writing_text(folder / CSV) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
    explanation.record.write(folder / ExplanationRecord.FILE)
