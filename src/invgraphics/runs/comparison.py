"""``compare.json``: several methods on one scene under one budget."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from invgraphics.runs.environment import Environment
from invgraphics.runs.schema import Record
from invgraphics.runs.scores import Score


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A failed cell of a comparison, with the error."""

    method: str
    seed: int
    error: str


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """A method that a comparison left out, because it does not go with the scene, and why."""

    method: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """Facts about a scene: numbers of views, colour space, background and bounds.

    Attributes:
        train: number of training views.
        val: of validation views.
        test: of test views that are scored.
        colour: colour space, ``srgb`` or ``linear``.
        background: in [0, 1], in that colour space.
        space: kind of its bounds, ``box`` or ``contracted``.
        notes: by topic.
    """

    train: int | None = None
    val: int | None = None
    test: int | None = None
    colour: str = ""
    background: tuple[float, float, float] | None = None
    space: str = ""
    notes: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ComparisonRecord(Record):
    """Record of a comparison: its question, conditions, and the folders of its runs.

    Attributes:
        scene: its name.
        question: that the comparison answers, one sentence.
        methods: in the order of the report.
        method_choice: why these methods, where the scene chose them; empty where they were requested.
        summaries: method -> what it is, one line.
        cells: method -> titles of its field and of its renderer, the row and the column of the table of methods.
        refused: methods that a pattern named and that do not go with the scene.
        seeds: each method is fitted once per seed.
        budget: of every fit, ``60s`` or ``5000steps``.
        size: width and height of the test pictures, px.
        preset: of all fits; empty where they differ.
        presets: method -> preset.
        preset_choice: what chose the presets, in words; empty where fits differ.
        preset_chosen_on: method -> scenes on which the preset's values were chosen.
        render_with: renderers that show every fitted field besides its own.
        command: makes the comparison again.
        baselines: trivial prediction -> metric -> score.
        noise_ceiling: PSNR between two half-sample renderings of the truth, dB.
        protocol: how scores were made: ``name``, ``summary`` and further facts.
        scene_info: what is known about the scene.
        environment: machine and versions.
        runs: folders of the finished runs, relative.
        failures: cells that gave no run.
        wall_seconds: duration of the whole command; ``None`` where some of its runs were there before it.
    """

    FILE: ClassVar[str] = "compare.json"
    RENAMED: ClassVar[Mapping[str, str]] = {"scene_info.notes.suspicion": "inconsistent_poses"}

    scene: str
    question: str = ""
    methods: tuple[str, ...]
    method_choice: str = ""
    summaries: dict[str, str] = field(default_factory=dict)
    cells: dict[str, tuple[str, str]] = field(default_factory=dict)
    refused: tuple[Refusal, ...] = ()
    seeds: tuple[int, ...] = ()
    budget: str = ""
    size: tuple[int, int] | None = None
    preset: str = ""
    presets: dict[str, str] = field(default_factory=dict)
    preset_choice: str = ""
    preset_chosen_on: dict[str, tuple[str, ...]] = field(default_factory=dict)
    render_with: tuple[str, ...] = ()
    command: str = ""
    baselines: dict[str, dict[str, Score]] = field(default_factory=dict)
    noise_ceiling: float | None = None
    protocol: dict[str, Any] = field(default_factory=dict)
    scene_info: SceneFacts = field(default_factory=SceneFacts)
    environment: Environment = field(default_factory=Environment)
    runs: tuple[str, ...]
    failures: tuple[Failure, ...] = ()
    wall_seconds: float | None = None
