"""``study.json``: a study's design, and the state of each of its cells."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from invgraphics.runs.environment import Environment
from invgraphics.runs.schema import Record

Status = Literal["done", "failed", "missing", "skipped"]


@dataclass(frozen=True)
class Approximation:
    """A pair of renderers that differ in one approximation only, compared on every fit.

    Attributes:
        name: of the approximation.
        exact: renderer without it, one of the study's ``render_with``.
        approximate: renderer with it, likewise.
    """

    name: str
    exact: str
    approximate: str


@dataclass(frozen=True)
class KnownDeviation:
    """An expected failing verdict with its cause; the report still shows it.

    Attributes:
        cells: pattern of the cells' labels, for instance ``splatting/* fence@800 *``.
        rule: that they break, one of `invgraphics.report.statistics.rules.RULES`.
        cause: why, one sentence.
        issue: where it is followed up: a number or a link.
    """

    cells: str
    rule: Literal["budget", "monitor", "views", "dead", "memory", "finite", "late"]
    cause: str
    issue: int | str = ""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """A statement made before anything ran: how far two kinds of fits are apart, and between which bounds that should lie.

    Factors that it does not name are held equal: the mean difference over those of their levels that both sides have counts.

    Attributes:
        text: the statement, one sentence.
        source: where it comes from.
        before: factor -> level (``method`` among them) of the fits that are subtracted.
        after: the same of the fits that they are subtracted from.
        where: levels that both sides have.
        against: levels in place of ``where``; the statement is then about the growth of the difference from there to here.
        scenes: of the study's; empty for all.
        metric: key of the score.
        low: lower bound, in the metric's stored unit; ``None`` for no bound.
        high: upper bound, likewise.
    """

    text: str
    source: str
    before: dict[str, Any]
    after: dict[str, Any]
    where: dict[str, Any] = field(default_factory=dict)
    against: dict[str, Any] = field(default_factory=dict)
    scenes: tuple[str, ...] = ()
    metric: str = "psnr"
    low: float | None = None
    high: float | None = None

    def __post_init__(self) -> None:
        bounds = [bound for bound in (self.low, self.high) if bound is not None]
        if not bounds or bounds != sorted(bounds):
            raise ValueError("A prediction needs 'low', 'high' or both, in rising order.")


@dataclass(frozen=True, kw_only=True)
class CellRecord:
    """Record of a study's cell: its levels, run folder, state and times.

    Attributes:
        id: name of its run's folder; cells that come to the same settings share one.
        label: method, scene@size, other levels, budget and seed in a line.
        scene: built-in scene or path of a data set, as given.
        method: ``renderer/recipe``.
        seed: its seed.
        levels: factor -> level.
        size: longest side in pixels, or (width, height); ``None`` for the scene's own.
        budget: in words.
        budget_seconds: of the fit; ``None`` where the budget counts steps.
        budget_steps: likewise.
        run: folder, relative to the study.
        status: ``done``, ``failed``, ``missing``, or ``skipped`` where its data was not there.
        error: why it failed or was skipped.
        seconds: that the run took, start and evaluation included.
        forecast_seconds: that it was expected to take.
    """

    id: str
    label: str = ""
    scene: str
    method: str
    seed: int
    levels: dict[str, Any] = field(default_factory=dict)
    size: int | tuple[int, int] | None = None
    budget: str = ""
    budget_seconds: float | None = None
    budget_steps: int | None = None
    run: str
    status: Status
    error: str | None = None
    seconds: float | None = None
    forecast_seconds: float | None = None


@dataclass(frozen=True, kw_only=True)
class StudyRecord(Record):
    """Record of a study: design, conditions, and the state of every cell.

    Attributes:
        name: of the study.
        question: that it answers, one sentence.
        design: ``factorial``, ``one-at-a-time`` or ``list``.
        factors: factor -> its levels.
        base: key -> level that the design varies around.
        scenes: built-in scenes or paths of data sets, as given.
        methods: ``renderer/recipe``.
        seeds: each cell is fitted once per seed.
        budget: of each fit, where no factor says otherwise.
        preset: of the recipes; ``None`` for the one that suits each cell's budget.
        size: longest side in pixels, or (width, height); ``None`` for the scenes' own.
        test_views: number of test views, or ``all``.
        render_with: renderers that show every fitted field besides its own.
        analyses: computations beside the fits.
        report: what the page is about, ``effects`` or ``verdicts``.
        approximations: pairs of renderers that are compared on every fit.
        known: red verdicts whose causes are known.
        metric: key of the score that the question is about.
        each: factor that the question asks about level by level (``method``); empty where the mean answers it.
        interactions: pairs of factors whose interaction is the question.
        margins: metric -> difference that is of no interest, stated before anything ran.
        predictions: statements made before anything ran, which the report judges.
        words: ``factor level`` -> what the report calls that level.
        protocol: how scores were made: ``name``, ``summary`` and further facts.
        command: makes the study again.
        environment: machine and versions.
        cells: all of them, in order.
    """

    FILE: ClassVar[str] = "study.json"

    name: str
    question: str = ""
    design: Literal["factorial", "one-at-a-time", "list"] = "factorial"
    factors: dict[str, Any] = field(default_factory=dict)
    base: dict[str, Any] = field(default_factory=dict)
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...] = ()
    budget: str = ""
    preset: str | None = None
    size: int | tuple[int, int] | None = None
    test_views: int | str | None = None
    render_with: tuple[str, ...] = ()
    analyses: tuple[str, ...] = ()
    report: Literal["effects", "verdicts"] = "effects"
    approximations: tuple[Approximation, ...] = ()
    known: tuple[KnownDeviation, ...] = ()
    metric: str = "psnr"
    each: str = ""
    interactions: tuple[tuple[str, str], ...] = ()
    margins: dict[str, float] = field(default_factory=dict)
    predictions: tuple[Prediction, ...] = ()
    words: dict[str, str] = field(default_factory=dict)
    protocol: dict[str, Any] = field(default_factory=dict)
    command: str = ""
    environment: Environment = field(default_factory=Environment)
    cells: tuple[CellRecord, ...]


def level_text(value: Any) -> str:
    """Format a factor's level as text; equal values give equal text."""
    if isinstance(value, str):
        return value
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e6:
        value = int(value)
    return json.dumps(value, sort_keys=True)
