"""A run opened in the viewer: its newest checkpoint, and its training progress and scores."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera, Quantity, RayRenderer, Rendering, Scene, View
from invgraphics.core.transforms import apply_similarity
from invgraphics.errors import InputError
from invgraphics.experiments.fitted import Fitted, open_fitted
from invgraphics.runs import checkpoint
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import RunFolder, check_run
from invgraphics.runs.provenance import Provenance
from invgraphics.viewer.crop import CropBox, crop_model, crop_obstacle

Stamp = tuple[int, int, int]
Stamps = tuple[Stamp | None, Stamp | None]
"""File stamps of a run's checkpoint and scores."""
POLL = 0.5
"""Seconds between two checks of a checkpoint file."""


class LoadedRun:
    """A run with its model; only the render thread may use the model.

    Args:
        fitted: the opened run, whose scene is moved to the fit's frame, anew for each checkpoint.
        stamps: of its files, taken before they were read; ``None`` for current ones.
    """

    def __init__(self, fitted: Fitted, stamps: Stamps | None = None) -> None:
        self._opened, self.fitted = fitted, fitted.in_its_frame()
        self._stamps = stamps or file_stamps(fitted.folder, fitted.source)
        self.steps, self.seconds = self._progress()

    @property
    def scene(self) -> Scene:
        """The run's scene."""
        return self.fitted.scene

    @property
    def name(self) -> str:
        """The method's name."""
        return self.fitted.method.name

    @property
    def independent_pixels(self) -> bool:
        """Whether pixels are independent, so that an image can be rendered in strips."""
        return isinstance(self.fitted.model.renderer, RayRenderer)

    @property
    def has_gaussians(self) -> bool:
        """Whether the field provides Gaussians, which the browser can draw."""
        return Quantity.GAUSSIANS in self.fitted.model.field.provides

    @property
    def crop_obstacle(self) -> str:
        """Why `render` cannot crop this run; empty if it can."""
        return crop_obstacle(self.fitted.model.renderer)

    def render(self, camera: Camera, geometry: bool, crop: CropBox | None = None) -> Rendering:
        """Render one image as evaluation does; on the CPU, with normals if ``geometry``.

        Args:
            camera: in this run's local frame.
            geometry: whether normals are wanted.
            crop: in this run's local frame; without effect where there is a `crop_obstacle`.
        """
        model = self.fitted.model
        if crop is not None and not self.crop_obstacle:
            model = crop_model(model, crop)
        return model.render(camera, normals=geometry)

    def to_local(self, camera: Camera, scene: Scene) -> Camera:
        """Transform a camera from ``scene``'s local frame to this run's, through the world frame."""
        if scene is self.scene:
            return camera
        return camera.moved(apply_similarity(self.from_local(scene), camera.cam_to_world.double()).to(camera.cam_to_world))

    def crop_to_local(self, crop: CropBox, scene: Scene) -> CropBox:
        """Transform a crop box from ``scene``'s local frame to this run's, as the axis-aligned box around it."""
        return crop if scene is self.scene else crop.transformed(self.from_local(scene))

    def from_local(self, scene: Scene) -> Float[Tensor, "4 4"]:
        """The similarity from ``scene``'s local frame to this run's, double precision."""
        return torch.linalg.inv(self.scene.world_from_local.double()) @ scene.world_from_local.double()

    def views(self) -> list[tuple[str, View]]:
        """Test and training views with unique names."""
        splits = (("test", self.scene.test), ("train", self.scene.train))
        return [
            (f"{split} {index}: {view.name.removeprefix(f'{split}/')}", view)
            for split, views in splits
            for index, view in enumerate(views)
        ]

    def has_update(self) -> bool:
        """Whether the checkpoint or scores on disk are newer than those loaded; thread-safe."""
        stamps = file_stamps(self.fitted.folder, self.fitted.source)
        return stamps[0] is not None and stamps != self._stamps

    def reload(self) -> None:
        """Load the newest checkpoint.

        Raises:
            InputError: it is not readable, or does not fit the recipe that this run had when it was opened.
        """
        fitted = self.fitted
        self._stamps = file_stamps(fitted.folder, fitted.source)  # first: a file written meanwhile is newer
        state = checkpoint.load(fitted.source.checkpoint, fitted.model.device)
        try:
            loaded = self._opened.at_checkpoint(state)
        except RuntimeError as error:
            raise InputError(f"{fitted.source.root} has become another run.", "Start the viewer again.") from error
        if loaded.poses is not None:
            self.fitted = loaded.in_its_frame()
        self.steps, self.seconds = self._progress()

    def summary(self) -> dict[str, str]:
        """Scene, training progress, primitive count and test scores as text, by name."""
        primitives = self.fitted.model.field.primitive_count()
        facts = {"scene": self.scene.name, "fit": f"step {self.steps:,}, {self.seconds:.1f} s"}
        if primitives is not None:
            facts["primitives"] = f"{primitives:,}"
        facts["test views"] = _scores(self.fitted.folder) or "not scored yet"
        return facts

    def _progress(self) -> tuple[int, float]:
        """Steps and seconds of the fit, from its folder."""
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
    templates = {"psnr": "PSNR {:.2f} dB", "ssim": "SSIM {:.3f}"}
    return ", ".join(words.format(quality[name].mean) for name, words in templates.items() if name in quality)


def file_stamps(folder: RunFolder, source: RunFolder) -> Stamps:
    """Stamps of a run's checkpoint, in ``source``, and scores; ``None`` for missing files."""
    return _stamp(source.checkpoint), _stamp(folder.scores_path())


def _stamp(path: Path) -> Stamp | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino


def open_run(run: Path, scene: str | None, live: bool, say: Callable[[str], None]) -> LoadedRun:
    """Open a run, in ``live`` as soon as its fit has written a checkpoint.

    Args:
        run: its folder.
        scene: another copy of its scene.
        live: wait for files that a fit in progress has not written yet.
        say: called with the reason of a wait.

    Raises:
        InputError: this is no run, or it has no checkpoint and ``live`` is false.
    """
    missing = missing_file(run)
    if missing and not live:
        raise InputError(*missing)
    if missing:
        say(f"Waiting for a fit to write its first checkpoint to {run} (`fit --checkpoint-every 5s` does so sooner).")
    while missing_file(run):
        time.sleep(POLL)
    stamps = file_stamps(RunFolder(run), _source(run))
    return LoadedRun(open_fitted(run, scene), stamps)


def missing_file(run: Path) -> tuple[str, str] | None:
    """Sentence and remedy for a folder that cannot be viewed; ``None`` if it can."""
    try:
        check_run(run)
    except InputError as error:
        return error.sentence, error.remedy
    if not _source(run).checkpoint.is_file():
        return f"{run} has no checkpoint yet.", "`invgraphics view --live` waits for the first one."
    return None


def _source(run: Path) -> RunFolder:
    """Folder of a run's checkpoint: its own, or that of the fit it is a rendering of."""
    try:
        return RunFolder(run).fit(RunFolder(run).read(Provenance))
    except InputError:
        return RunFolder(run)  # opening the run reports the error
