"""``provenance.json``: a run's request, and hashes of everything that determines its result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from invgraphics.runs.schema import Record

Region = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lowest and highest corner of a box, local units."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options with which the scene was opened.

    Attributes:
        size: longest side in pixels, or (width, height); ``None`` for the scene's own.
        test_views: number of test views; ``None`` for all.
        spp: samples per pixel of a rendered scene; ``None`` for its own.
    """

    size: int | tuple[int, int] | None = None
    test_views: int | None = None
    spp: int | None = None


@dataclass(frozen=True, kw_only=True)
class LoadAverage:
    """System load: mean number of running or runnable processes over the minute before the fit's start and its end."""

    start: float | None = None
    end: float | None = None


@dataclass(frozen=True, kw_only=True)
class ImportedFile:
    """Origin of an imported model: its file, hash, format and axes.

    Attributes:
        file: its path, as given.
        sha256: of its bytes.
        bytes: its size.
        format: its name, see ``invgraphics list model-formats``.
        axes: of the coordinates in it, in words.
        world: how the axes of the data set's world point.
        gaussians: how many it holds.
        sh_degree: of their spherical harmonics, upper bands that are zero left out.
        antialiased: whether it was fitted with anti-aliasing; ``None`` where the file does not say.
        notes: what was assumed, in sentences.
    """

    file: str
    sha256: str
    bytes: int
    format: str
    axes: str
    world: str
    gaussians: int
    sh_degree: int
    antialiased: bool | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ConvertedRun:
    """Origin of a converted model: the run that it was made of, and what the conversion cost.

    Attributes:
        run: folder of that run, as given.
        cell_sha256: its identity; empty where it has none.
        method: that fitted it.
        to: what it was converted to.
        hub: what the conversion went through, in words.
        native_psnr: of that run on the test views, dB; ``None`` where unknown.
        converted_psnr: of the converted model before its refit, dB.
        data_seed: seed of what was done to the training photographs, where it is not the run's own.
    """

    run: str
    cell_sha256: str
    method: str
    to: str
    hub: str
    native_psnr: float | None = None
    converted_psnr: float | None = None
    data_seed: int | None = None


@dataclass(frozen=True, kw_only=True)
class Provenance(Record):
    """Provenance of a run: request, identity, and hashes of recipe, code and data.

    Attributes:
        cell_sha256: identity of the run: equal for equal bits, on one machine.
        method: ``renderer/recipe``.
        preset: of the recipe; empty for none.
        preset_choice: what chose the preset, in words; empty where it was requested.
        preset_chosen_on: scenes on which the preset's values were chosen.
        recipe_sha256: of the resolved recipe.
        scene: built-in scene, or path of the data set, as given.
        seed: of initial values and of the fit.
        budget: of the fit, as given.
        truth_sha256: of the test views' pixels.
        train_sha256: of the training views' pixels, as the fit saw them.
        cameras_sha256: of all cameras.
        truth: folder of the true test pictures, relative to the run.
        background: of the scene, in [0, 1], in its colour space.
        colour: the scene's colour space, ``srgb`` or ``linear``.
        data: what was changed of the training data: key -> value.
        notes: on the scene, by topic.
        code_version: version and hash of the package's sources.
        plugins: name of a component -> package that provides it.
        command: makes the run again.
        options: how the scene was opened.
        region: lowest and highest corner of the box in which the fit sought the scene, local units; ``None`` in endless space.
        device: that computed.
        test_poses: how test poses are found; empty where they are taken as given.
        test_exposure: under which exposure test views are shown; empty where exposures are not fitted.
        sparse_depth: points of structure from motion at which the fit's depth was supervised; empty where it was not.
        memory_forecast_bytes: memory that the fit was expected to hold at most; written after its first step.
        threads: of the process; written after the fit.
        load_average: of the machine; written after the fit.
        imported: the file, of a model that was fitted elsewhere.
        converted: the run, of a model that was converted from another parameterisation; the fit then is the refit.
        fitted_run: of a rendering: folder of the fit, relative.
        fitted_by: of a rendering: the method that fitted.
        rendered_by: of a rendering: the renderer, as it was named.
    """

    FILE: ClassVar[str] = "provenance.json"
    RENAMED: ClassVar[Mapping[str, str]] = {"notes.suspicion": "inconsistent_poses"}

    cell_sha256: str
    method: str
    preset: str = ""
    preset_choice: str = ""
    preset_chosen_on: tuple[str, ...] = ()
    recipe_sha256: str
    scene: str
    seed: int
    budget: str
    truth_sha256: str
    train_sha256: str
    cameras_sha256: str
    truth: str
    background: tuple[float, float, float]
    colour: Literal["srgb", "linear"]
    data: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, Any] = field(default_factory=dict)
    code_version: str
    plugins: dict[str, str] = field(default_factory=dict)
    command: str
    options: Options
    region: Region | None = None
    device: str
    test_poses: str = ""
    test_exposure: str = ""
    sparse_depth: str = ""
    memory_forecast_bytes: int | None = None
    threads: int | None = None
    load_average: LoadAverage | None = None
    imported: ImportedFile | None = None
    converted: ConvertedRun | None = None
    fitted_run: str | None = None
    fitted_by: str | None = None
    rendered_by: str | None = None

    @property
    def data_seed(self) -> int:
        """Seed with which the training photographs were degraded: a converted run's are those of the fit that it began as."""
        origin = self.converted
        return self.seed if origin is None or origin.data_seed is None else origin.data_seed
