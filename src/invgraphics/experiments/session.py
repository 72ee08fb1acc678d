"""Fits as objects of the public interface: in memory, or loaded from a run folder."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import final

from invgraphics.core import Model, Scene
from invgraphics.experiments.build import configure_torch, use_kernels
from invgraphics.experiments.clocks import disturbance, fit_costs, fit_record
from invgraphics.experiments.display import ScoreTable, curve_svg
from invgraphics.experiments.evaluate import scene_as_trained, score_model
from invgraphics.experiments.fitted import Fitted
from invgraphics.experiments.job import Job, in_region, make_training_scene, region_of
from invgraphics.experiments.recorder import Recorder
from invgraphics.experiments.renderings import check_variants
from invgraphics.experiments.run import prepare, warm_up
from invgraphics.experiments.scaled import scaled_scores
from invgraphics.experiments.variants import as_shown, variant_named, with_renderer
from invgraphics.interruption import Terminated
from invgraphics.metrics.cost import PeakMemory
from invgraphics.recipes.recipe import Method
from invgraphics.runs.history import Moment, read_history
from invgraphics.runs.provenance import Provenance
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit
from invgraphics.training.poses import Poses

OnStep = Callable[[Fit], None]


class FittedRun(ABC):
    """A method fitted to a scene.

    Attributes:
        method: what was fitted.
        scene: as loaded, with the views that score it.
    """

    method: Method
    scene: Scene
    _data: tuple[Mapping[str, object], int]  # changes of the training data, and their seed

    @property
    @abstractmethod
    def model(self) -> Model:
        """The fitted field and its renderer."""

    @property
    @abstractmethod
    def poses(self) -> Poses | None:
        """The training cameras' poses, where they were fitted too."""

    @property
    @abstractmethod
    def history(self) -> tuple[Moment, ...]:
        """Training history: ``step``, ``seconds``, ``progress``, ``psnr`` on held-out views, and ``loss``.

        It has a dozen moments; ``on_step`` sees every step's ``fit.loss``.
        """

    @property
    def steps(self) -> int:
        """Training steps so far."""
        return self.history[-1].step if self.history else 0

    @property
    def seconds(self) -> float:
        """Seconds of optimisation so far."""
        return self.history[-1].seconds if self.history else 0.0

    @property
    @abstractmethod
    def finished(self) -> bool:
        """Whether the budget is spent."""

    @property
    @abstractmethod
    def scores(self) -> ScoreTable:
        """Scores under the default protocol; without a run folder, computed on first access."""

    def evaluate(self, protocol: str = "default") -> ScoreTable:
        """Render and score the test views by the rules of the command line.

        Args:
            protocol: ``default`` (pictures rounded to 8 bits) or ``float``.

        Raises:
            InputError: there is no such protocol.
        """
        seen = self.as_trained(self.scene)
        found = score_model(self.model, self.scene, protocol, self.method.name, self.poses, training_scene=seen)
        refined = self.poses is not None
        quality, skipped = scaled_scores(self.model, self.scene, protocol, self._data[0], refined=refined)
        return ScoreTable(replace(found, quality=found.quality | quality, skipped=found.skipped | skipped))

    def as_trained(self, scene: Scene) -> Scene:
        """A copy of the run's scene with the photographs that the fit saw, of which the mean training image is."""
        return scene_as_trained(scene, *self._data)

    def through(self, renderer: str) -> Model:
        """Model of the fitted field with the renderer of another method; with its own, as it was fitted.

        Another renderer has constants in place of learnt state: an occupancy grid is full, a width the one at a fit's end.

        Args:
            renderer: a method's name; settings of its renderer may follow, ``gaussian-volume/exact:steps=8``.

        Raises:
            InputError: that renderer needs what the field does not provide, or has learnt state without a constant substitute.
        """
        if renderer == self.method.name:
            return self.model
        variant = variant_named(renderer, self.method.preset)
        check_variants([variant], [self.method], self.scene)
        if variant.table == self.method.table["renderer"]:
            return self.model
        other = with_renderer(self.method, variant).recipe.renderer.build(self.scene).untrained().to(self.model.device)
        return replace(self.model, field=as_shown(self.model.field, other), renderer=other)

    def __repr__(self) -> str:
        state = "finished" if self.finished else "not finished"
        return f"{self.method.name} on {self.scene.name}: {state}, {self.steps} steps, {self.seconds:.1f} s"

    def _repr_svg_(self) -> str:
        points = [(moment.seconds, moment.psnr) for moment in self.history if moment.psnr is not None]
        return curve_svg(points, repr(self), ("s", "monitor PSNR in dB"))


@final
class MemoryRun(FittedRun):
    """A fit in this process, without a run folder; an interrupted one can be resumed.

    Args:
        job: what to fit, and how.
        scene: as loaded.
        on_step: is given the fit before its first step and after each one.

    Raises:
        InputError: method and scene do not go together, or would need more memory than there is.
        NumericalError: the fit left the finite numbers.
    """

    def __init__(self, job: Job, scene: Scene, on_step: OnStep | None = None) -> None:
        self.method = job.method
        self._job, self._on_step, self._data = job, on_step, (job.data.changes(), job.request.seed)
        self._history: list[Moment] = []
        self._scores: ScoreTable | None = None
        configure_torch(job.device)
        use_kernels(job.request.kernels, job.device)
        with PeakMemory(job.device) as memory:
            shown = make_training_scene(job, scene)
            self.scene = in_region(scene, region_of(shown))
            self.fit = prepare(job, shown, scene)
            warm_up(self.fit, job.method, memory)
        self._run()

    def _run(self) -> None:
        recorder = Recorder(self.fit, None, self._job.cadence, self.method.name, on_step=self._on_step)
        try:
            recorder.run()
        except Terminated:
            raise
        except KeyboardInterrupt:
            print(f"Interrupted after {self.fit.steps} steps; resume() continues.", file=sys.stderr)
        finally:
            self._history += recorder.history
            self._scores = None

    def resume(self, budget: str | None = None) -> None:
        """Continue the fit from its current step, in place; an interrupted fit ends with the same bits as an uninterrupted one.

        Args:
            budget: of the whole fit from its beginning, ``60s`` or ``5000steps``; ``None`` for the one that it had. A larger
                one stretches all schedules of a finished fit, which are shares of the budget: learning rates rise again, and
                degrees of harmonics, coarse-to-fine windows, sizes of pictures and scheduled sharpness go back.

        Raises:
            InputError: the budget cannot be read.
        """
        if budget is not None:
            self.fit.set_budget(Budget.parse(budget))
        if self.finished:
            spent = f"{self.steps} steps and {self.seconds:.1f} s are done, the whole budget of {self.fit.plan.budget}"
            print(f"Nothing to resume: {spent}.", file=sys.stderr)
        self._run()

    @property
    def model(self) -> Model:
        """The fitted field and its renderer."""
        return self.fit.model

    @property
    def poses(self) -> Poses | None:
        """The training cameras' poses, where they are fitted too."""
        return self.fit.plan.poses

    @property
    def history(self) -> tuple[Moment, ...]:
        """See `FittedRun.history`."""
        return tuple(self._history)

    @property
    def finished(self) -> bool:
        """Whether the budget is spent."""
        return self.fit.progress >= 1

    @property
    def scores(self) -> ScoreTable:
        """Scores under the default protocol, computed on first access."""
        if self._scores is None:
            found = self.evaluate().record
            cost = fit_costs(fit_record(self.fit.steps, self.fit.clocks())) | found.cost
            self._scores = ScoreTable(replace(found, cost=cost, disturbed=disturbance(cost)))
        return self._scores


@final
class FolderRun(FittedRun):
    """A fit loaded from its run folder.

    Args:
        fitted: the run's scene and model.

    Attributes:
        folder: where the run is.
    """

    def __init__(self, fitted: Fitted) -> None:
        self.method, self.scene, self._fitted = fitted.method, fitted.scene, fitted
        self.folder: Path = fitted.folder.root
        self._data = (record := fitted.source.read(Provenance)).data, record.data_seed

    @property
    def model(self) -> Model:
        """The fitted field and its renderer, from the last checkpoint."""
        return self._fitted.model

    @property
    def poses(self) -> Poses | None:
        """The training cameras' poses, where they were fitted too."""
        return self._fitted.poses

    @property
    def history(self) -> tuple[Moment, ...]:
        """See `FittedRun.history`."""
        return read_history(self._fitted.source.history)

    @property
    def finished(self) -> bool:
        """Whether the run has its scores."""
        return self._fitted.folder.finished

    @property
    def scores(self) -> ScoreTable:
        """Scores from the run folder; those of the last checkpoint where the run was interrupted."""
        return ScoreTable(self._fitted.folder.read_scores()) if self.finished else self.evaluate()
