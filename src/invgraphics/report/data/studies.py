"""Study folders: what was varied, which cells ran, and each scene's part as a comparison of its variants."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError
from invgraphics.report.data.factors import METHOD, Factor, Observation, level_text
from invgraphics.report.data.reading import need, number, optional, read_run, read_table
from invgraphics.report.data.records import Comparison, Failure, Run
from invgraphics.report.data.variants import find_factors, variant_name

STUDY = "study.json"
STATUSES = ("done", "failed", "missing", "skipped")


@dataclass(frozen=True)
class StudyCell:
    """One cell of a study.

    Attributes:
        id: name of its run; cells that come to the same settings share one.
        scene: its scene.
        method: ``renderer/recipe``.
        seed: its seed.
        levels: factor -> level as written, the method included.
        variant: method and levels in words, the same for all scenes and seeds.
        status: ``done``, ``failed``, ``missing``, or ``skipped`` where its data was not there.
        error: why it failed or was skipped; empty otherwise.
        seconds: what it took; ``None`` where unknown.
        run: its run, where it is done.
        label: method, scene@size, budget and seed in a line.
        size: of its pictures: the longest side, or width × height, px; empty for the scene's own.
        budget: of its fit, in words.
        amount: of its budget: (unit, seconds or steps); ``None`` where unknown.
        forecast: seconds that it was expected to take; ``None`` where unknown.
    """

    id: str
    scene: str
    method: str
    seed: int
    levels: dict[str, str]
    variant: str
    status: str
    error: str
    seconds: float | None
    run: Run | None
    label: str = ""
    size: str = ""
    budget: str = ""
    amount: tuple[str, float] | None = None
    forecast: float | None = None


@dataclass(frozen=True)
class Known:
    """A red verdict whose cause is known: pattern of the cells' labels, rule, cause, and issue or empty."""

    cells: str
    rule: str
    cause: str
    issue: str


@dataclass(frozen=True)
class Study:
    """Everything a study's page shows.

    Attributes:
        name: of the study.
        question: what was asked, one sentence.
        design: ``factorial``, ``one-at-a-time`` or ``list``.
        factors: what was varied, the method first where there are several.
        base: level of each key that the design varies around.
        scenes: in the order of the study.
        methods: likewise.
        seeds: likewise.
        budget: of every fit; empty where it is a factor.
        preset: for instance ``laptop`` or ``paper``.
        size: width and height of the test pictures, px, or as written.
        protocol: how scores were made.
        command: reproduces the study.
        environment: machine and versions.
        cells: all of them, in order.
        approximations: ``name``, and the renderers ``exact`` and ``approximate`` that are compared on every fit.
        analyses: names of the computations beside the fits.
        report: what its page is about: ``effects`` or ``verdicts``.
        known: red verdicts whose causes are known.
    """

    name: str
    question: str
    design: str
    factors: tuple[Factor, ...]
    base: dict[str, str]
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    budget: str
    preset: str
    size: str
    protocol: dict[str, Any]
    command: str
    environment: dict[str, Any]
    cells: tuple[StudyCell, ...]
    approximations: tuple[dict[str, Any], ...] = ()
    analyses: tuple[str, ...] = ()
    report: str = "effects"
    known: tuple[Known, ...] = ()

    @property
    def variants(self) -> tuple[str, ...]:
        """Every combination of method and levels, in order."""
        return tuple(dict.fromkeys(cell.variant for cell in self.cells))

    @property
    def failures(self) -> tuple[StudyCell, ...]:
        """The cells that failed."""
        return tuple(cell for cell in self.cells if cell.status == "failed")

    def count(self, status: str) -> int:
        """Number of cells with a status."""
        return sum(cell.status == status for cell in self.cells)

    def observations(self) -> tuple[Observation, ...]:
        """The runs that are done, with their levels."""
        return tuple(Observation(cell.run, cell.scene, cell.levels) for cell in self.cells if cell.run is not None)


def is_study(folder: Path) -> bool:
    """Whether ``folder`` holds a study."""
    return (folder / STUDY).is_file()


def read_study(folder: Path) -> Study:
    """Read a folder that ``ablate`` wrote, finished or not.

    Raises:
        InputError: a file is missing or broken; the sentence names it.
    """
    source = folder / STUDY
    table = read_table(source)
    protocol = _protocol(table.get("protocol"), source)
    entries = need(table, "cells", list, source)
    if not entries:
        raise InputError(f"'{source}' lists no cells.", "Give a study with at least one scene, method and seed.")
    base = {str(key): level_text(value) for key, value in optional(table, "base", dict, source, {}).items()}
    cells = [_cell(entry, base, folder, str(protocol.get("name", "default"))) for entry in entries]
    declared = optional(table, "factors", dict, source, {})
    factors = find_factors(declared, base, cells)
    return Study(
        name=optional(table, "name", str, source, folder.resolve().name),
        question=optional(table, "question", str, source, ""),
        design=optional(table, "design", str, source, ""),
        factors=factors,
        base=base,
        scenes=_listed(table.get("scenes"), (cell.scene for cell in cells)),
        methods=_listed(table.get("methods"), (cell.method for cell in cells)),
        seeds=tuple(sorted({cell.seed for cell in cells})),
        budget=_written(table.get("budget")),
        preset=_written(table.get("preset")),
        size=_written(table.get("size")),
        protocol=protocol,
        command=optional(table, "command", str, source, ""),
        environment=optional(table, "environment", dict, source, {}),
        cells=tuple(replace(cell, variant=variant_name(cell, factors)) for cell in cells),
        approximations=tuple(_approximations(table, source)),
        analyses=tuple(str(name) for name in optional(table, "analyses", list, source, [])),
        report=optional(table, "report", str, source, "effects"),
        known=tuple(_known(entry, source) for entry in optional(table, "known", list, source, [])),
    )


def scene_comparisons(study: Study) -> list[Comparison]:
    """Each scene as a comparison of its variants; once per ground truth, where a factor changes the truth itself."""
    comparisons = []
    for scene in study.scenes:
        here = [cell for cell in study.cells if cell.scene == scene]
        runs = [(cell, replace(cell.run, method=cell.variant)) for cell in here if cell.run is not None]
        truths = list(dict.fromkeys(_truth_of(run) for _, run in runs)) or [None]
        for index, truth in enumerate(truths):
            kept = [(cell, run) for cell, run in runs if _truth_of(run) == truth]
            failures = [cell for cell in here if cell.status == "failed"] if index == 0 else []
            variants = dict.fromkeys(cell.variant for cell in here if cell in failures or any(cell is one for one, _ in kept))
            title = scene if len(truths) == 1 else f"{scene}, truth {index + 1} of {len(truths)}"
            comparisons.append(_comparison(study, title, tuple(variants), tuple(run for _, run in kept), failures))
    return [comparison for comparison in comparisons if comparison.methods]


def _truth_of(run: Run) -> tuple[Any, ...]:
    """What two runs must share to be shown side by side."""
    return run.truth_hash, run.views, json.dumps(run.provenance.get("background"))


def _comparison(
    study: Study, scene: str, variants: tuple[str, ...], runs: tuple[Run, ...], failures: Sequence[StudyCell]
) -> Comparison:
    return Comparison(
        scene=scene,
        question=study.question,
        methods=variants,
        runs=runs,
        failures=tuple(Failure(cell.variant, cell.seed, cell.error) for cell in failures),
        budget=study.budget,
        preset=study.preset,
        protocol=study.protocol,
        environment=study.environment,
    )


def _cell(entry: Any, base: Mapping[str, str], folder: Path, protocol: str) -> StudyCell:
    source = folder / STUDY
    method, status = need(entry, "method", str, source), need(entry, "status", str, source)
    if status not in STATUSES:
        raise InputError(f"'{source}': 'status' cannot be {status!r}.", f"Expected one of: {', '.join(STATUSES)}.")
    own = {str(key): level_text(value) for key, value in optional(entry, "levels", dict, source, {}).items()}
    run = read_run(folder / need(entry, "run", str, source), protocol) if status == "done" else None
    scene, size = need(entry, "scene", str, source), _written(entry.get("size"))
    return StudyCell(
        id=need(entry, "id", str, source),
        scene=scene,
        method=method,
        seed=need(entry, "seed", int, source),
        levels={METHOD: method} | dict(base) | own,
        variant="",
        status=status,
        error=optional(entry, "error", str, source, "") or ("no message" if status == "failed" else ""),
        seconds=number(entry.get("seconds"), "seconds", source),
        run=run,
        label=optional(entry, "label", str, source, f"{method} {scene}"),
        size=size,
        budget=optional(entry, "budget", str, source, ""),
        amount=_amount(entry, source),
        forecast=number(entry.get("forecast_seconds"), "forecast_seconds", source),
    )


def _amount(entry: Mapping[str, Any], source: Path) -> tuple[str, float] | None:
    """A budget's unit and amount."""
    for unit in ("seconds", "steps"):
        amount = number(entry.get(f"budget_{unit}"), f"budget_{unit}", source)
        if amount is not None:
            return unit, amount
    return None


def _known(entry: Any, source: Path) -> Known:
    cells, rule, cause = (need(entry, key, str, source) for key in ("cells", "rule", "cause"))
    return Known(cells, rule, cause, str(entry.get("issue") or ""))


def _approximations(table: Mapping[str, Any], source: Path) -> list[dict[str, Any]]:
    pairs = optional(table, "approximations", list, source, [])
    return [{key: need(pair, key, str, source) for key in ("name", "exact", "approximate")} for pair in pairs]


def _protocol(value: Any, source: Path) -> dict[str, Any]:
    if value is None or isinstance(value, str):
        return {"name": value or "default"}
    if not isinstance(value, Mapping):
        raise InputError(f"'{source}': 'protocol' cannot be {value!r}.")
    return dict(value)


def _listed(value: Any, found: Iterable[str]) -> tuple[str, ...]:
    """Those of ``found`` in the order that the study states, then the rest."""
    present = list(dict.fromkeys(found))
    stated = [str(item) for item in value if str(item) in present] if isinstance(value, list) else []
    return tuple(dict.fromkeys([*stated, *present]))


def _written(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, list):
        return " × ".join(str(item) for item in value)
    return str(value)
