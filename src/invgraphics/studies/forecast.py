"""Cost forecast of a study, measured by the first seconds of a fit and pictures of each method."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from invgraphics.core import Scene
from invgraphics.errors import InputError, NumericalError
from invgraphics.experiments.build import build_model, build_plan, use_kernels
from invgraphics.experiments.evaluate import expected_seconds
from invgraphics.experiments.job import Job, make_training_scene
from invgraphics.experiments.renderings import check_variants
from invgraphics.experiments.start import CHECKPOINT_COPIES
from invgraphics.experiments.variants import RendererVariant, with_renderer
from invgraphics.metrics.cost import model_bytes
from invgraphics.text import duration
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit

START_SECONDS = 6.0
"""Until a process has loaded torch, the compiled kernels and a scene; measured on two laptop cores."""

TRIAL_SECONDS = 3.0
"""Of each fit, before its pictures are timed: occupancy grids begin full, with pictures ten times slower than later ones."""

TRIAL_SHARE = 0.1
"""Of a fit's budget, at most."""

PIXEL_BYTES = 20
"""A test view's colour, alpha and normal (float16), depth (float32) and 8-bit picture, before compression."""


@dataclass(frozen=True)
class Cost:
    """Measured cost of one run of a method.

    Attributes:
        step: seconds of a training step.
        other: seconds of everything but the fit: start and evaluation.
        size: bytes of the run folder.
    """

    step: float
    other: float
    size: int

    def seconds(self, budget: Budget | None) -> float:
        """Seconds of a run with this budget; ``None`` for one that is fitted, and only scored or shown."""
        return self.other + (0.0 if budget is None else self.fit_seconds(budget))

    def fit_seconds(self, budget: Budget) -> float:
        """Seconds of the fit alone."""
        limits = [] if budget.seconds is None else [budget.seconds]
        limits += [] if budget.steps is None else [budget.steps * self.step]
        return min(limits, default=0.0)


@dataclass(frozen=True)
class Forecast:
    """Forecast cost of a study's missing runs.

    Attributes:
        runs: of the whole study.
        missing: of them, still to be made.
        seconds: of all missing runs, on this machine.
        size: bytes that they will write.
        later: of them, neither finished nor part of this command.
    """

    runs: int
    missing: int
    seconds: float
    size: int
    later: int = 0

    @property
    def hours(self) -> float:
        """Hours of all missing runs."""
        return self.seconds / 3600

    def __str__(self) -> str:
        runs = f"{self.runs} runs, {self.runs - self.missing - self.later} of them finished"
        runs += f", {self.later} left out" if self.later else ""
        return f"{runs}; the rest takes about {duration(self.seconds)} and {self.size / 1e9:.2g} GB."


@contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """Give torch's and Numba's pools so many threads, as a run that shares the machine has; what they had comes back."""
    import numba

    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(count)
    numba.set_num_threads(min(count, before[1]))
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


def try_method(job: Job, scene: Scene) -> Cost:
    """Measure the cost of one method on one scene.

    Raises:
        InputError: field, renderer or scene do not go together.
    """
    seed, device = job.request.seed, job.device
    use_kernels(job.request.kernels, device)
    pixels = sum(view.camera.width * view.camera.height for view in scene.test)
    shown = make_training_scene(job, scene)
    try:
        fit = Fit(build_plan(job.method, shown, job.budget, seed, device))
        step = _try_steps(fit)
        evaluation = expected_seconds(fit.plan.model, scene)
        check_variants(job.variants, [job.method], scene)
        evaluation += sum(_seconds_through(variant, job, scene) for variant in job.variants)
        size = CHECKPOINT_COPIES * model_bytes(fit.plan.model.parts.values())
    except InputError:
        raise
    except (NumericalError, MemoryError, RuntimeError):  # its cell will fail with a sentence, and the others go on
        return Cost(0.0, START_SECONDS, 0)
    return Cost(step, START_SECONDS + evaluation, size + PIXEL_BYTES * pixels * (1 + len(job.variants)))


def _seconds_through(variant: RendererVariant, job: Job, scene: Scene) -> float:
    """Expected seconds of the pictures through another renderer; 0 where a new field has nothing that it could show, yet."""
    model = build_model(with_renderer(job.method, variant), scene, job.request.seed, job.device, shown=True)
    try:
        return expected_seconds(model, scene)
    except InputError:
        return 0.0


def _try_steps(fit: Fit) -> float:
    """Run the first steps of a fit, at least two; returns the mean seconds of a step after the first."""
    fit.step()  # compiles and allocates
    began, taken, spent = time.perf_counter(), 0, 0.0
    while taken == 0 or (spent < TRIAL_SECONDS and fit.progress < TRIAL_SHARE):
        fit.step()
        taken, spent = taken + 1, time.perf_counter() - began
    return spent / taken


def total(costs: Sequence[tuple[Cost, Budget | None]], runs: int, jobs: int, later: int = 0) -> Forecast:
    """Sum the costs of missing runs, ``jobs`` at a time; a study has ``runs``, ``later`` of them left out."""
    seconds = sum(cost.seconds(budget) for cost, budget in costs) / jobs
    return Forecast(runs, len(costs), seconds, sum(cost.size for cost, _ in costs), later)
