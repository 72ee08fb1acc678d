"""Training loop around a fit: history, checkpoints, monitor PSNR, progress and interruptions, outside the fit's clock."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType

import torch
from torch import Tensor

from invgraphics.core import Camera, Conditional, Context, RayRenderer, Rays, Scene, View
from invgraphics.core.finite import describe_non_finite
from invgraphics.errors import InputError, NumericalError
from invgraphics.experiments.clocks import fit_record
from invgraphics.experiments.posed import transform_camera, world_to_fit
from invgraphics.experiments.progress import Reporter
from invgraphics.interruption import Terminated
from invgraphics.metrics.cost import PeakMemory
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.history import Moment
from invgraphics.training.budget import Cadence
from invgraphics.training.fit import Fit
from invgraphics.training.limits import dead_gaussians

MARKS = (0.01, 0.02, 0.04, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Points of the fit at which the monitor looks."""


class Monitor:
    """PSNR on a fixed set of pixels of a few views that are not trained on, all of them if there are few, for curves over time.

    Pixels lie within the views' masks. Uses validation views, or test views where a data set has none; what it sees never
    reaches the fit.
    """

    VIEWS, PIXELS = 4, 4096

    def __init__(self, scene: Scene, device: torch.device) -> None:
        source = scene.val or scene.test
        chosen = sorted({round(i * (len(source) - 1) / max(self.VIEWS - 1, 1)) for i in range(self.VIEWS)})
        self._views: list[View] = [source[i] for i in chosen]
        self._scene, self._device = scene, device
        self._bounds = scene.bounds.to(device)
        generator = torch.Generator().manual_seed(0)
        per_view = self.PIXELS // len(self._views)
        self._pixels = [_some_pixels(view, per_view, generator) for view in self._views]

    @torch.no_grad()
    def psnr(self, fit: Fit) -> float:
        """PSNR in dB over all monitored pixels, over the declared background."""
        ctx = Context(self._bounds, progress=fit.progress)
        background = self._scene.background.to(self._device)
        errors = []
        poses = fit.plan.poses
        drift = None if poses is None else world_to_fit(poses, self._scene)
        for view, flat in zip(self._views, self._pixels, strict=True):
            camera = view.camera if drift is None else transform_camera(view.camera, drift)
            prediction = self._predict(fit, view.subject, camera, flat, ctx, background)
            errors.append((prediction.clamp(0, 1).cpu() - view.over(self._scene.background, flat)).square().mean())
        return -10 * math.log10(max(float(torch.stack(errors).mean()), 1e-10))

    def _predict(self, fit: Fit, subject: int | None, camera: Camera, flat: Tensor, ctx: Context, background: Tensor) -> Tensor:
        renderer, field = fit.plan.model.renderer, fit.plan.model.field
        if isinstance(field, Conditional) and subject is not None and subject in field.subjects:
            field = field.of_subject(subject)
        if isinstance(renderer, RayRenderer):
            pixels = camera.pixel_centres_of(flat)
            rays: Rays = camera.rays(pixels).to(self._device)
            return torch.cat([renderer.render_rays(field, part, ctx)[0].over(background) for part in rays.chunks(4096)])
        picture = renderer.render_image(field, camera.to(self._device), ctx)[0].over(background)
        return picture.reshape(-1, 3)[flat.to(self._device)]


def _some_pixels(view: View, most: int, generator: torch.Generator) -> Tensor:
    """Flat indices of random valid pixels, all where there are no more than ``most``."""
    valid = view.valid().reshape(-1).nonzero()[:, 0]
    return valid if len(valid) <= most else valid[torch.randint(len(valid), (most,), generator=generator)]


class Recorder:
    """Runs a fit, records its history and keeps its run folder up to date.

    Args:
        fit: what to run.
        folder: where to write; ``None`` to write nothing.
        cadence: how often to write a checkpoint.
        title: of the progress display.
        snapshots: how many states of the model to keep, evenly over the fit, besides the first.
        on_step: is given the fit before its first step and after each one, on no clock.
        memory: peak of the fit, saved with each checkpoint; ``None`` where it is not measured.

    Attributes:
        history: each evaluation by the monitor.
    """

    def __init__(
        self,
        fit: Fit,
        folder: RunFolder | None,
        cadence: Cadence,
        title: str,
        snapshots: int = 0,
        on_step: Callable[[Fit], None] | None = None,
        memory: PeakMemory | None = None,
    ) -> None:
        self._fit, self._folder, self._cadence, self._title = fit, folder, cadence, title
        self._on_step, self._memory = on_step, memory
        self.history: list[Moment] = []
        self._monitor = Monitor(fit.plan.scene, fit.plan.device)
        self._saved_at = (fit.steps, time.monotonic())
        self._finite_at = fit.steps
        self._marks = [mark for mark in MARKS if mark > fit.progress]
        self._snapshots = snapshots
        self._stopped_by = 0
        self._loss = math.nan

    def run(self) -> None:
        """Fit until the budget is spent.

        Raises:
            KeyboardInterrupt: Ctrl-C or SIGTERM came; the run folder holds a checkpoint of the last whole step.
            NumericalError: the fit left the finite numbers; the history and the last checkpoint remain.
        """
        self._stopped_by = 0
        # Signal handlers can be installed in the main thread only.
        numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
        before = {number: signal.signal(number, self._stop) for number in numbers}
        try:
            with Reporter(self._title) as reporter:
                if self._fit.steps == 0:
                    self._record()
                    self._keep_snapshot(0.0)
                    self._call()
                self._fit.run(lambda loss: self._after_step(loss, reporter))
            self._save()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        if self._stopped_by:
            raise Terminated if self._stopped_by == signal.SIGTERM else KeyboardInterrupt

    def _call(self) -> None:
        if self._on_step is not None:
            self._on_step(self._fit)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._stopped_by = number

    def _after_step(self, loss: float, reporter: Reporter) -> bool:
        fit = self._fit
        self._loss = loss
        self._keep_snapshot(min(fit.progress, 1.0))
        if self._marks and fit.progress >= self._marks[0]:
            self._marks = [mark for mark in self._marks if mark > fit.progress]
            psnr = self._record()
            reporter.show(fit.progress, f"step {fit.steps}, {fit.seconds:.0f} s, monitor {psnr:.1f} dB")
        else:
            reporter.show(min(fit.progress, 0.999), f"step {fit.steps}, loss {loss:.4f}")
        if self._due():
            self._save()
        self._call()
        return bool(self._stopped_by)

    def _due(self) -> bool:
        step, moment = self._saved_at
        if self._cadence.steps is not None:
            return self._fit.steps - step >= self._cadence.steps
        return time.monotonic() - moment >= (self._cadence.seconds or 30.0)

    def _check_finite(self) -> None:
        """Check every tensor of the fit, which kernels may hide: before anything of it is recorded.

        Raises:
            NumericalError: a value is not finite; the sentence names the steps between which that happened.
        """
        if found := describe_non_finite(self._fit.state()):
            since = f" (all were at step {self._finite_at})" if self._finite_at < self._fit.steps else ""
            raise NumericalError(f"Step {self._fit.steps}: {found}{since}; the fit stops here.")
        self._finite_at = self._fit.steps

    def _save(self) -> None:
        self._check_finite()
        if self._folder is not None:
            checkpoint.save(self._folder.checkpoint, self._fit.state())
            peak = None if self._memory is None else self._memory.peak_bytes
            self._folder.write(fit_record(self._fit.steps, self._fit.clocks(), peak))
        self._saved_at = (self._fit.steps, time.monotonic())

    def _keep_snapshot(self, progress: float) -> None:
        """Write a snapshot of the model if one is due and not yet written."""
        if self._folder is None or not self._snapshots:
            return
        path = self._folder.snapshot(math.floor(progress * self._snapshots))
        if not path.is_file():
            self._check_finite()
            path.parent.mkdir(exist_ok=True)
            state = self._fit.state()
            checkpoint.save(path, {part: state[part] for part in ("field", "renderer", "fit")})

    def _record(self) -> float:
        self._check_finite()
        fit = self._fit
        psnr = self._monitor.psnr(fit)
        dead = dead_gaussians(fit.plan.model.field, [view.camera for view in fit.plan.scene.train])
        moment = Moment(
            step=fit.steps,
            seconds=round(fit.seconds, 4),
            progress=round(fit.progress, 6),
            psnr=psnr,
            loss=self._loss if math.isfinite(self._loss) else None,
            primitives=fit.plan.model.field.primitive_count(),
            dead=None if dead is None else round(dead.share, 6),
        )
        self.history.append(moment)
        if self._folder is not None:
            self._folder.append_history(moment)
        return psnr


def cut_snapshots(folder: RunFolder, step: int) -> None:
    """Remove snapshots of steps after ``step``, from which a resumed fit continues and writes its own; unreadable ones too."""
    for path in folder.snapshots:
        try:
            kept = int(checkpoint.load(path)["fit"]["steps"]) <= step
        except (InputError, KeyError):
            kept = False
        if not kept:
            path.unlink(missing_ok=True)
