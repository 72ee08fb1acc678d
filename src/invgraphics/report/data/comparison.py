"""Comparisons: runs scored against the same ground truth, in display order and under display names."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError
from invgraphics.runs.comparison import ComparisonRecord, Failure, Refusal, SceneFacts
from invgraphics.runs.environment import Environment
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.inside import inside
from invgraphics.runs.run import Run, read_run
from invgraphics.runs.scores import DEFAULT, Score


@dataclass(frozen=True)
class Comparison:
    """Runs of several methods on one scene, with baselines, protocol and provenance.

    Attributes:
        scene: name of the scene.
        question: what the comparison is to answer, one sentence.
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
        wall_seconds: duration of the whole command; ``None`` where some of its runs were there before it.
        cells: method -> titles of its field and of its renderer.
        refused: methods that were left out, because they do not go with the scene.
        shown: methods that get pictures and curves; empty for all.
        method_choice: why these methods, where the scene chose them; empty where they were requested.
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
    scene_info: SceneFacts = field(default_factory=SceneFacts)
    environment: Environment = field(default_factory=Environment)
    wall_seconds: float | None = None
    cells: dict[str, tuple[str, str]] = field(default_factory=dict)
    refused: tuple[Refusal, ...] = ()
    shown: tuple[str, ...] = ()
    method_choice: str = ""

    @property
    def drawn_methods(self) -> tuple[tuple[int, str], ...]:
        """(series index, method) of the methods with pictures and curves."""
        return tuple((series, method) for series, method in enumerate(self.methods) if not self.shown or method in self.shown)

    def runs_of(self, method: str) -> tuple[Run, ...]:
        """Runs of ``method``, by seed."""
        return tuple(sorted((run for run in self.runs if run.method == method), key=lambda run: run.seed))

    def failures_of(self, method: str) -> tuple[Failure, ...]:
        """Failed cells of ``method``."""
        return tuple(failure for failure in self.failures if failure.method == method)


def read_comparison(folder: Path) -> Comparison:
    """Read a folder that ``compare`` wrote.

    Raises:
        InputError: a file is missing or broken (it is named), or the runs do not share their ground truth.
    """
    source = folder / ComparisonRecord.FILE
    record = RunFolder(folder).read(ComparisonRecord)
    protocol = str(record.protocol.get("name", DEFAULT))
    runs = tuple(read_run(inside(folder, run), protocol) for run in record.runs)
    if not runs and not record.failures:
        raise InputError(f"'{source}' lists no runs.", "Run `invgraphics compare` again.")
    check_comparable(runs)
    found = [run.method for run in runs] + [failure.method for failure in record.failures]
    return Comparison(
        scene=record.scene,
        question=record.question,
        methods=tuple(dict.fromkeys([*record.methods, *found])),
        runs=runs,
        failures=record.failures,
        budget=record.budget,
        preset=record.preset,
        size=record.size,
        summaries=record.summaries,
        command=record.command,
        baselines=record.baselines,
        noise_ceiling=record.noise_ceiling,
        protocol=record.protocol,
        scene_info=record.scene_info,
        environment=record.environment,
        wall_seconds=record.wall_seconds,
        cells=record.cells,
        refused=record.refused,
        method_choice=record.method_choice,
    )


def check_comparable(runs: tuple[Run, ...]) -> None:
    """Check that all runs share ground truth, test views, background and protocol.

    Raises:
        InputError: ground truth, test views, background or protocol differ; the sentence names both runs.
    """
    for run in runs[1:]:
        first = runs[0]
        left, right = first.provenance, run.provenance
        views, protocols = (first.scores.views, run.scores.views), (first.scores.protocol, run.scores.protocol)
        facts: tuple[tuple[str, bool, Any, Any], ...] = (
            ("ground truth", left.truth_sha256 == right.truth_sha256, left.truth_sha256[:12], right.truth_sha256[:12]),
            ("test views", views[0] == views[1], len(views[0]), len(views[1])),
            ("backgrounds", left.background == right.background, left.background, right.background),
            ("protocol", protocols[0] == protocols[1], *protocols),
        )
        for what, same, one, other in facts:
            if not same:
                raise InputError(
                    f"'{first.folder}' and '{run.folder}' were scored against different {what} ({one} and {other}).",
                    "Compare runs of one scene at one size, with the same test views and protocol.",
                )
