"""A run that is looked at: its model as of its newest checkpoint, and what is known about it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import torch

from invgraphics.core import Camera, Quantity, RayRenderer, Rendering, Scene, View
from invgraphics.core.transforms import apply_similarity
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import render_view
from invgraphics.experiments.fitted import Fitted, open_fitted
from invgraphics.runs import checkpoint
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import RunFolder, check_run
from invgraphics.runs.provenance import Provenance

Stamp = tuple[int, int, int]
Stamps = tuple[Stamp | None, Stamp | None]
"""Of a run's checkpoint and scores."""
POLL = 0.5
"""Seconds between two looks at a checkpoint file."""


class Subject:
    """A run, its model and how far its fit is. Only the thread that renders may use the model.

    Args:
        fitted: the opened run.
        stamps: of its files, taken before they were read; ``None`` for those of now.
    """

    def __init__(self, fitted: Fitted, stamps: Stamps | None = None) -> None:
        self.fitted = fitted
        self._stamps = stamps or stamps_of(fitted.folder, fitted.source)
        self.steps, self.seconds = self._progress()

    @property
    def scene(self) -> Scene:
        """The run's scene."""
        return self.fitted.scene

    @property
    def name(self) -> str:
        """What the run is called on the page."""
        return self.fitted.method.name

    @property
    def by_rays(self) -> bool:
        """Whether the pixels are independent, so that a picture can be rendered in parts."""
        return isinstance(self.fitted.renderer, RayRenderer)

    @property
    def has_gaussians(self) -> bool:
        """Whether the browser can draw the model."""
        return Quantity.GAUSSIANS in self.fitted.field.provides

    def render(self, camera: Camera, geometry: bool) -> Rendering:
        """One picture on the CPU, as an evaluation makes it; with normals if ``geometry``."""
        fitted = self.fitted
        return render_view(fitted.field, fitted.renderer, camera, fitted.scene, fitted.device, geometry)

    def placed(self, camera: Camera, scene: Scene) -> Camera:
        """A camera of ``scene``'s local frame in this run's own: both stand for the same one in the data set's world."""
        if scene is self.scene:
            return camera
        similarity = torch.linalg.inv(self.scene.world_from_local.double()) @ scene.world_from_local.double()
        return camera.moved(apply_similarity(similarity, camera.cam_to_world.double()).to(camera.cam_to_world))

    def views(self) -> list[tuple[str, View]]:
        """All views with names that are unlike each other, test views first."""
        splits = (("test", self.scene.test), ("train", self.scene.train))
        return [
            (f"{split} {index}: {view.name.removeprefix(f'{split}/')}", view)
            for split, views in splits
            for index, view in enumerate(views)
        ]

    def changed(self) -> bool:
        """Whether the fit has written a checkpoint or scores that are not shown; any thread may ask."""
        stamps = stamps_of(self.fitted.folder, self.fitted.source)
        return stamps[0] is not None and stamps != self._stamps

    def refresh(self) -> None:
        """Load the newest checkpoint.

        Raises:
            InputError: it is not readable, or does not fit the recipe that this run had when it was opened.
        """
        fitted = self.fitted
        self._stamps = stamps_of(fitted.folder, fitted.source)  # first: a file that comes meanwhile is news again
        state = checkpoint.load(fitted.source.checkpoint, fitted.device)
        try:
            fitted.field.load_state_dict(state.get("field", {}))
            fitted.renderer.load_state_dict(state.get("renderer", {}) if fitted.source is fitted.folder else {})
        except RuntimeError as error:
            raise InputError(f"{fitted.source.root} has become another run.", "Start the viewer again.") from error
        self.steps, self.seconds = self._progress()

    def facts(self) -> dict[str, str]:
        """What there is to say about the run, name -> value in words."""
        primitives = self.fitted.field.primitive_count()
        facts = {"scene": self.scene.name, "fit": f"step {self.steps:,}, {self.seconds:.1f} s"}
        if primitives is not None:
            facts["primitives"] = f"{primitives:,}"
        facts["test views"] = _scores(self.fitted.folder) or "not scored yet"
        return facts

    def _progress(self) -> tuple[int, float]:
        """Steps and seconds of the fit, as its folder says."""
        try:
            fit = self.fitted.source.read(FitRecord)
        except InputError:
            return 0, 0.0
        return fit.steps or 0, fit.seconds or 0.0


def _scores(folder: RunFolder) -> str:
    try:
        quality = folder.read_scores().quality
    except InputError:
        return ""
    said = {"psnr": "PSNR {:.2f} dB", "ssim": "SSIM {:.3f}"}
    return ", ".join(words.format(quality[name].mean) for name, words in said.items() if name in quality)


def stamps_of(folder: RunFolder, source: RunFolder) -> Stamps:
    """What tells two states of a run apart: its checkpoint, in ``source``, and its scores; ``None`` for what is not there."""
    return _stamp(source.checkpoint), _stamp(folder.scores_path())


def _stamp(path: Path) -> Stamp | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino


def open_subject(run: Path, scene: str | None, live: bool, say: Callable[[str], None]) -> Subject:
    """Open a run, in ``live`` as soon as its fit has written a checkpoint.

    Args:
        run: its folder.
        scene: another copy of its scene.
        live: wait for what a fit in progress has not written yet.
        say: told why there is a wait.

    Raises:
        InputError: this is no run, or it has no checkpoint and nobody said to wait.
    """
    missing = missing_part(run)
    if missing and not live:
        raise InputError(*missing)
    if missing:
        say(f"Waiting for a fit to write its first checkpoint to {run} (`fit --checkpoint-every 5s` does so sooner).")
    while missing_part(run):
        time.sleep(POLL)
    stamps = stamps_of(RunFolder(run), _source(run))
    return Subject(open_fitted(run, scene).in_its_frame(), stamps)


def missing_part(run: Path) -> tuple[str, str] | None:
    """What a folder lacks to be looked at, and what to do about it; ``None`` if it is complete."""
    try:
        check_run(run)
    except InputError as error:
        return error.sentence, error.remedy
    if not _source(run).checkpoint.is_file():
        return f"{run} has no checkpoint yet.", "`invgraphics view --live` waits for the first one."
    return None


def _source(run: Path) -> RunFolder:
    """The folder whose model a run shows: its own, or that of the fit it is a rendering of."""
    try:
        shown = RunFolder(run).read(Provenance).fitted_run
    except InputError:
        shown = None  # opening it will say what is wrong
    return RunFolder(run if shown is None else run / shown)
