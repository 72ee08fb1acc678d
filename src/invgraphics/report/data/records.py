"""What a report knows: scores, runs, failures and the comparison they belong to."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Score:
    """One quality metric over the test views of one run.

    Attributes:
        mean: the protocol's aggregate; ``None`` where it is not a number.
        unit: for instance ``dB``; empty where there is none.
        higher_is_better: the metric's direction.
        per_view: one value per test view, in the run's order; empty where only the aggregate is known.
    """

    mean: float | None
    unit: str
    higher_is_better: bool
    per_view: tuple[float | None, ...]


@dataclass(frozen=True)
class Progress:
    """One line of a run's history.

    Attributes:
        step: optimisation steps taken.
        seconds: time spent in optimisation, nothing else.
        psnr: on the monitored views, dB; ``None`` where it was not measured.
        share: of the budget that is spent, in [0, 1]; ``None`` where unknown.
        dead: share of the primitives that can no longer change; ``None`` where unknown.
        broken: quantities of the line that are not finite.
    """

    step: int
    seconds: float
    psnr: float | None
    share: float | None = None
    dead: float | None = None
    broken: tuple[str, ...] = ()


@dataclass(frozen=True)
class Run:
    """One fitted cell, as its folder tells it.

    Attributes:
        folder: where it lies.
        method: ``renderer/recipe``; a report may extend it to tell variants apart.
        seed: random seed of the fit.
        preset: size of the recipe, for instance ``laptop`` or ``paper``.
        scene: name of the scene.
        protocol: name of the scoring protocol.
        views: names of the test views; view i has its pictures in ``test/%04d``.
        quality: metric -> score.
        cost: quantity -> value, SI units and counts; ``None`` where the method has no such thing.
        skipped: metric -> why it could not be computed.
        history: training progress, oldest first.
        provenance: hashes, code version and the command that reproduces the run.
        environment: the machine and the versions.
        truth: folder of the truth's pictures.
        disturbed: why its times say nothing, the subject left out: other programs had its cores; empty where they did not.
        shortfall: why it may have lost to the mean training image, and what to try; empty where it has not.
    """

    folder: Path
    method: str
    seed: int
    preset: str
    scene: str
    protocol: str
    views: tuple[str, ...]
    quality: dict[str, Score]
    cost: dict[str, float | None]
    skipped: dict[str, str]
    history: tuple[Progress, ...]
    provenance: dict[str, Any]
    environment: dict[str, Any]
    truth: Path
    disturbed: str = ""
    shortfall: str = ""

    @property
    def truth_hash(self) -> str:
        """SHA-256 of the ground-truth pixels."""
        return str(self.provenance["truth_sha256"])


@dataclass(frozen=True)
class Failure:
    """A cell that gave no run, and why."""

    method: str
    seed: int
    error: str


@dataclass(frozen=True)
class Comparison:
    """Everything a page shows.

    Attributes:
        scene: name of the scene.
        question: what was asked, one sentence.
        methods: in the order in which they are shown.
        runs: the cells that succeeded.
        failures: the cells that did not.
        budget: what every fit was given, ``60s`` or ``5000steps``; empty where fits had different budgets.
        preset: for instance ``laptop`` or ``paper``; empty where fits differ.
        size: width and height of the test pictures, px.
        summaries: method -> what it is, one line.
        command: reproduces the whole comparison; empty where there is none.
        baselines: trivial predictor -> metric -> score.
        noise_ceiling: PSNR between two half-sample renders of the truth, dB.
        protocol: how scores were made: ``name``, ``summary`` and further facts.
        scene_info: what is known about the scene.
        environment: machine and versions.
        wall_seconds: duration of the whole command.
        shown: methods that get pictures and curves; empty for all.
    """

    scene: str
    question: str
    methods: tuple[str, ...]
    runs: tuple[Run, ...]
    failures: tuple[Failure, ...] = ()
    budget: str = ""
    preset: str = ""
    size: tuple[int, int] | None = None
    summaries: dict[str, str] = field(default_factory=dict)
    command: str = ""
    baselines: dict[str, dict[str, Score]] = field(default_factory=dict)
    noise_ceiling: float | None = None
    protocol: dict[str, Any] = field(default_factory=dict)
    scene_info: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, Any] = field(default_factory=dict)
    wall_seconds: float | None = None
    shown: tuple[str, ...] = ()

    @property
    def drawn_methods(self) -> tuple[tuple[int, str], ...]:
        """(series, method) of what gets pictures and curves."""
        return tuple((series, method) for series, method in enumerate(self.methods) if not self.shown or method in self.shown)

    def runs_of(self, method: str) -> tuple[Run, ...]:
        """Runs of ``method``, by seed."""
        return tuple(sorted((run for run in self.runs if run.method == method), key=lambda run: run.seed))

    def failures_of(self, method: str) -> tuple[Failure, ...]:
        """Failed cells of ``method``."""
        return tuple(failure for failure in self.failures if failure.method == method)
