"""Study folders: factors and cells, and each scene as a comparison of its variants."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import METHOD, Factor, FailedFit, Observation, StudyCell
from invgraphics.report.data.variants import find_factors, variant_name
from invgraphics.runs.comparison import Failure
from invgraphics.runs.environment import Environment
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.inside import inside
from invgraphics.runs.run import Run, read_run
from invgraphics.runs.scores import DEFAULT
from invgraphics.runs.study import Approximation, CellRecord, KnownDeviation, Prediction, StudyRecord, level_text
from invgraphics.text import common_value


@dataclass(frozen=True)
class Study:
    """A study: design (factors, scenes, methods, seeds), cells and provenance.

    Attributes:
        name: of the study.
        question: what the study is to answer, one sentence.
        design: ``factorial``, ``one-at-a-time`` or ``list``.
        factors: the varied factors, the method first where there are several.
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
        approximations: pairs of renderers that are compared on every fit.
        analyses: names of the computations beside the fits.
        report: what its page is about: ``effects`` or ``verdicts``.
        known: red verdicts whose causes are known.
        metric: key of the score that the question is about.
        each: factor that the question asks about level by level; empty where the mean answers it.
        interactions: pairs of factors whose interaction is the question.
        margins: metric -> difference that is of no interest.
        predictions: statements made before anything ran.
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
    environment: Environment
    cells: tuple[StudyCell, ...]
    approximations: tuple[Approximation, ...] = ()
    analyses: tuple[str, ...] = ()
    report: str = "effects"
    known: tuple[KnownDeviation, ...] = ()
    metric: str = "psnr"
    each: str = ""
    interactions: tuple[tuple[str, str], ...] = ()
    margins: Mapping[str, float] = field(default_factory=dict)
    predictions: tuple[Prediction, ...] = ()

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
        """Finished runs with their factor levels."""
        return tuple(Observation(cell.run, cell.scene, cell.levels) for cell in self.cells if cell.run is not None)

    def lost(self) -> tuple[FailedFit, ...]:
        """Failed fits with their factor levels."""
        return tuple(FailedFit(cell.scene, cell.levels) for cell in self.failures)


def is_study(folder: Path) -> bool:
    """Whether ``folder`` holds a study."""
    return (folder / StudyRecord.FILE).is_file()


def read_study(folder: Path) -> Study:
    """Read a folder that ``ablate`` wrote, finished or not.

    Raises:
        InputError: a file is missing or broken; the sentence names it.
    """
    source = folder / StudyRecord.FILE
    record = RunFolder(folder).read(StudyRecord)
    if not record.cells:
        raise InputError(f"'{source}' lists no cells.", "Give a study with at least one scene, method and seed.")
    base = {key: level_text(value) for key, value in record.base.items()}
    protocol = str(record.protocol.get("name", DEFAULT))
    shown = _scene_names([*record.scenes, *(cell.scene for cell in record.cells)])
    cells = [_cell(cell, shown[cell.scene], base, folder, protocol) for cell in record.cells]
    factors = find_factors(record, base, cells)
    return Study(
        name=record.name,
        question=record.question,
        design=record.design,
        factors=factors,
        base=base,
        scenes=_in_stated_order([shown[scene] for scene in record.scenes], (cell.scene for cell in cells)),
        methods=_in_stated_order(record.methods, (cell.method for cell in cells)),
        seeds=tuple(sorted({cell.seed for cell in cells})),
        budget=_budget_of(cells, record.budget),
        preset=record.preset or "",
        size=_size_text(record.size),
        protocol=record.protocol,
        command=record.command,
        environment=record.environment,
        cells=tuple(replace(cell, variant=variant_name(cell, factors)) for cell in cells),
        approximations=record.approximations,
        analyses=record.analyses,
        report=record.report,
        known=record.known,
        metric=record.metric,
        each=record.each,
        interactions=record.interactions,
        margins=record.margins,
        predictions=tuple(
            replace(one, scenes=tuple(shown.get(scene, scene) for scene in one.scenes)) for one in record.predictions
        ),
    )


def scene_comparisons(study: Study) -> list[Comparison]:
    """One comparison of variants per scene, and per ground truth where a factor changes the truth itself."""
    comparisons = []
    for scene in study.scenes:
        here = [cell for cell in study.cells if cell.scene == scene]
        runs = [(cell, replace(cell.run, method=cell.variant)) for cell in here if cell.run is not None]
        truths = list(dict.fromkeys(_truth_of(run) for _, run in runs)) or [None]
        for index, truth in enumerate(truths):
            kept = [(cell, run) for cell, run in runs if _truth_of(run) == truth]
            failures = [cell for cell in here if cell.status == "failed" and _shown_in(cell, runs, truths) == index]
            variants = dict.fromkeys(cell.variant for cell in here if cell in failures or any(cell is one for one, _ in kept))
            title = scene if len(truths) == 1 else f"{scene}, truth {index + 1} of {len(truths)}"
            comparisons.append(_comparison(study, title, tuple(variants), tuple(run for _, run in kept), failures))
    return [comparison for comparison in comparisons if comparison.methods]


def _shown_in(failed: StudyCell, runs: Sequence[tuple[StudyCell, Run]], truths: Sequence[Any]) -> int:
    """Index of the truth that a failed fit would have had: that of its variant's other seeds; 0 where there is none."""
    alike = [truths.index(_truth_of(run)) for cell, run in runs if cell.variant == failed.variant]
    return min(alike, default=0)


def _truth_of(run: Run) -> tuple[Any, ...]:
    """Identity of the ground truth that comparable runs share: hash, test views and background."""
    return run.provenance.truth_sha256, run.scores.views, run.provenance.background


def _comparison(
    study: Study, scene: str, variants: tuple[str, ...], runs: tuple[Run, ...], failures: Sequence[StudyCell]
) -> Comparison:
    return Comparison(
        scene=scene,
        question=study.question,
        methods=variants,
        runs=runs,
        failures=tuple(Failure(method=cell.variant, seed=cell.seed, error=cell.error) for cell in failures),
        budget=study.budget,
        preset=study.preset,
        protocol=study.protocol,
        environment=study.environment,
    )


def _budget_of(cells: Sequence[StudyCell], stated: str) -> str:
    """The budget that all cells share; empty where it is a factor."""
    own = [cell.budget for cell in cells if cell.budget]
    return common_value(own) if own else stated


def _scene_names(scenes: Sequence[str]) -> dict[str, str]:
    """Map scenes to their names on the page: of a path the last folder, unless another scene has the same."""
    short = {scene: Path(scene).name for scene in scenes}
    return {scene: name if list(short.values()).count(name) == 1 else scene for scene, name in short.items()}


def _cell(record: CellRecord, scene: str, base: Mapping[str, str], folder: Path, protocol: str) -> StudyCell:
    own = {key: level_text(value) for key, value in record.levels.items()}
    amounts = (("seconds", record.budget_seconds), ("steps", record.budget_steps))
    return StudyCell(
        id=record.id,
        scene=scene,
        method=record.method,
        seed=record.seed,
        levels={METHOD: record.method} | dict(base) | own,
        variant="",
        status=record.status,
        error=record.error or ("no message" if record.status == "failed" else ""),
        seconds=record.seconds,
        run=read_run(inside(folder, record.run), protocol) if record.status == "done" else None,
        label=record.label or f"{record.method} {scene}",
        size=_size_text(record.size),
        budget=record.budget,
        amount=next(((unit, float(amount)) for unit, amount in amounts if amount is not None), None),
        forecast=record.forecast_seconds,
    )


def _in_stated_order(stated: Sequence[str], found: Iterable[str]) -> tuple[str, ...]:
    """Order ``found`` as ``stated``, unstated items last."""
    present = list(dict.fromkeys(found))
    return tuple(dict.fromkeys([*(item for item in stated if item in present), *present]))


def _size_text(size: int | tuple[int, int] | None) -> str:
    if size is None:
        return ""
    return str(size) if isinstance(size, int) else f"{size[0]} × {size[1]}"
