"""Updates of a study's record while it runs: its design, and the state of each cell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from invgraphics.errors import InputError
from invgraphics.experiments.environment import environment
from invgraphics.experiments.executors.base import Outcome, Resources
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import AblateRequest
from invgraphics.runs.folder import RUNS, RunFolder
from invgraphics.runs.study import CellRecord, Status, StudyRecord
from invgraphics.studies.cells import Planned
from invgraphics.studies.study import Study


@dataclass(frozen=True)
class CellState:
    """State of a cell when a study starts.

    Attributes:
        status: ``missing`` will be run; ``done`` is there; ``skipped`` lacks its data; ``later`` is not part of this command,
            and stays what it was.
        reason: why it is skipped.
        forecast: seconds that its run will take, where it will be run.
    """

    status: Literal["missing", "done", "skipped", "later"]
    reason: str | None = None
    forecast: float | None = None


class StudyRecorder:
    """Writer of `StudyRecord`, on every change of a cell's state.

    Args:
        folder: of the study.
        summary: its record without cells.
        plan: all of its cells.

    Raises:
        InputError: the folder holds another study.
    """

    def __init__(self, folder: RunFolder, summary: StudyRecord, plan: list[Planned]) -> None:
        self._folder, self._summary = folder, summary
        old = folder.read(StudyRecord) if folder.has(StudyRecord) else summary
        if old.name != summary.name:
            raise InputError(f"{folder.root} holds the study '{old.name}'.", "Choose another --out.")
        before = {cell.id: cell for cell in old.cells}
        self._cells = [_cell_record(planned, before.get(planned.id)) for planned in plan]

    def start(self, states: Mapping[str, CellState]) -> None:
        """Set the initial state of each cell, and write the record."""
        self._ours = {name for name, state in states.items() if state.status != "later"}
        self._cells = [_started(cell, states[cell.id]) for cell in self._cells]
        self._write()

    def note(self, outcome: Outcome) -> None:
        """Record a run's outcome in all cells that share it."""
        status: Status = "failed" if outcome.status else "done"
        ended = {"status": status, "error": outcome.error or None, "seconds": round(outcome.seconds, 3)}
        name = Path(outcome.request.out).name
        self._cells = [replace(cell, **ended) if cell.id == name else cell for cell in self._cells]
        self._write()

    def failed(self) -> list[CellRecord]:
        """The cells of this command that failed."""
        return [cell for cell in self._cells if cell.status == "failed" and cell.id in self._ours]

    def _write(self) -> None:
        self._folder.write(replace(self._summary, cells=tuple(self._cells)))


def _started(cell: CellRecord, state: CellState) -> CellRecord:
    """Initial record of a cell when the study starts."""
    if state.status == "missing":
        return replace(cell, status="missing", error=None, seconds=None, forecast_seconds=state.forecast)
    if state.status == "done":
        return replace(cell, status="done", error=None)
    return cell if state.status == "later" else replace(cell, status="skipped", error=state.reason, seconds=None)


def _cell_record(planned: Planned, before: CellRecord | None) -> CellRecord:
    """Make a cell's record, with its run's facts from an earlier command's record."""
    cell, budget = planned.cell, planned.job.budget
    ended = before is not None and (before.status == "failed" or (before.status == "done" and planned.job.folder.finished))
    return CellRecord(
        id=planned.id,
        label=planned.label,
        scene=cell.scene,
        method=cell.method,
        seed=cell.seed,
        levels=cell.levels,
        size=planned.fit.size,
        budget=str(budget),
        budget_seconds=budget.seconds,
        budget_steps=budget.steps,
        run=f"{RUNS}/{planned.id}",
        status=before.status if before is not None and ended else "missing",
        error=before.error if before is not None and ended else None,
        seconds=None if before is None else before.seconds,
        forecast_seconds=None if before is None else before.forecast_seconds,
    )


def summarise_study(study: Study, name: str, made_by: tuple[AblateRequest, Resources], job: Job) -> StudyRecord:
    """Make a study's record, without its cells; ``job`` is one of theirs."""
    request, resources = made_by
    machine = environment(job.device)
    return StudyRecord(
        name=name,
        question=study.question,
        design=study.design,
        factors=study.factors,
        base=study.base,
        scenes=study.scenes,
        methods=study.methods,
        seeds=study.seeds,
        budget=study.budget,
        preset=study.preset,
        size=study.size,
        test_views=study.test_views,
        render_with=study.render_with,
        analyses=study.analyses,
        report=study.report,
        approximations=study.approximations,
        known=study.known,
        metric=study.metric,
        each=study.each,
        interactions=study.interactions,
        margins=study.margins,
        words=study.words,
        predictions=study.predictions,
        protocol=job.protocol.record(),
        command=replace(request, keep=False, cells=None, most_seconds=None).shell(),  # all of it, however it was made
        environment=replace(machine, threads=resources.threads, executor=request.executor, jobs=resources.jobs),
        cells=(),
    )
