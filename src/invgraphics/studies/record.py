"""``study.json``: what a study is, and how far each of its cells is, true at any moment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from invgraphics.errors import InputError
from invgraphics.experiments.environment import environment
from invgraphics.experiments.executors.base import Outcome, Resources
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import AblateRequest
from invgraphics.runs.folder import RunFolder
from invgraphics.studies.cells import Planned
from invgraphics.studies.study import Study

RECORD = "study.json"
"""What a study's folder holds beside its runs: the design, and the state of every cell."""


@dataclass(frozen=True)
class CellState:
    """How far a cell is when a study starts.

    Attributes:
        status: ``missing`` will be run; ``done`` is there; ``skipped`` lacks its data; ``later`` is not part of this command,
            and stays what it was.
        reason: why it is skipped.
        forecast: seconds that its run will take, where it will be run.
    """

    status: Literal["missing", "done", "skipped", "later"]
    reason: str | None = None
    forecast: float | None = None


class Record:
    """``study.json``: what the study is, and how far each of its cells is."""

    def __init__(self, folder: RunFolder, summary: dict[str, Any], plan: list[Planned]) -> None:
        """Take over what an earlier run of the same study recorded.

        Raises:
            InputError: the folder holds another study.
        """
        self._folder = folder
        old = folder.read_json(RECORD) if (folder.root / RECORD).is_file() else {}
        if old and old.get("name") != summary["name"]:
            raise InputError(f"{folder.root} holds the study '{old.get('name')}'.", "Choose another --out.")
        before = {entry["id"]: entry for entry in old.get("cells", [])}
        self._cells = [_entry(planned, before.get(planned.id, {})) for planned in plan]
        self._summary = summary

    def start(self, states: Mapping[str, CellState]) -> None:
        """Take over how far each run is, and write."""
        for entry in self._cells:
            state = states[entry["id"]]
            if state.status == "missing":
                entry |= {"status": "missing", "error": None, "seconds": None, "forecast_seconds": state.forecast}
            elif state.status == "done":
                entry |= {"status": "done", "error": None}
            elif state.status == "skipped":
                entry |= {"status": "skipped", "error": state.reason, "seconds": None}
        self._write()

    def note(self, outcome: Outcome) -> None:
        """Write how a run ended into all cells that share it."""
        for entry in self._cells:
            if entry["id"] == Path(outcome.request.out).name:
                entry["status"] = "failed" if outcome.status else "done"
                entry["error"] = outcome.error or None
                entry["seconds"] = round(outcome.seconds, 3)
        self._write()

    def failed(self) -> list[dict[str, Any]]:
        """The cells that failed."""
        return [entry for entry in self._cells if entry["status"] == "failed"]

    def _write(self) -> None:
        self._folder.write_json(RECORD, self._summary | {"cells": self._cells})


def _entry(planned: Planned, before: dict[str, Any]) -> dict[str, Any]:
    cell, budget = planned.cell, planned.job.budget
    ended = before.get("status") == "failed" or (before.get("status") == "done" and planned.job.folder.finished)
    return {
        "id": planned.id,
        "label": planned.label,
        "scene": cell.scene,
        "method": cell.method,
        "seed": cell.seed,
        "levels": cell.levels,
        "size": planned.fit.size,
        "budget": str(budget),
        "budget_seconds": budget.seconds,
        "budget_steps": budget.steps,
        "run": f"runs/{planned.id}",
        "status": before["status"] if ended else "missing",
        "error": before.get("error") if ended else None,
        "seconds": before.get("seconds"),
        "forecast_seconds": before.get("forecast_seconds"),
    }


def summarise_study(study: Study, name: str, asked: tuple[AblateRequest, Resources], job: Job) -> dict[str, Any]:
    """Everything of ``study.json`` but the cells; ``job`` is one of theirs."""
    request, resources = asked
    keys = ("question", "design", "factors", "base", "scenes", "methods", "seeds", "budget", "preset", "size", "test_views")
    keys += ("render_with", "analyses", "report")
    machine = environment(job.device)
    machine |= {"threads": resources.threads, "executor": request.executor, "jobs": resources.jobs}
    return {
        "schema": 1,
        "name": name,
        **{key: getattr(study, key) for key in keys},
        "approximations": [asdict(pair) for pair in study.approximations],
        "known": [asdict(deviation) for deviation in study.known],
        "protocol": job.protocol.record(),
        "command": request.shell(),
        "environment": machine,
    }
