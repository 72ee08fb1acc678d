"""Execution of a study: validate every cell, forecast the cost, fit missing cells, write the record."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import torch

from invgraphics import plugins
from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.build import open_with_progress
from invgraphics.experiments.compare_folders import check_not_published, warn_of_replaced
from invgraphics.experiments.executors.base import Executor, Outcome, Resources
from invgraphics.experiments.identity import check_replaceable, run_digest, truth_digest
from invgraphics.experiments.job import Job
from invgraphics.experiments.progress import Reporter
from invgraphics.experiments.renderings import check_variants, is_kept, is_kept_fit, renderings_complete
from invgraphics.experiments.request import AblateRequest
from invgraphics.interruption import INTERRUPTED
from invgraphics.recipes.presets import announcements
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.study import CellRecord, StudyRecord
from invgraphics.scenes.open import missing_data_reason
from invgraphics.studies.analyses import write_analyses
from invgraphics.studies.cells import Planned, make_plan, select
from invgraphics.studies.forecast import Cost, Forecast, limited_threads, total, try_method
from invgraphics.studies.reading import locate, name_of, read_study, with_request
from invgraphics.studies.record import CellState, StudyRecorder, summarise_study
from invgraphics.studies.study import Study
from invgraphics.text import duration
from invgraphics.thread_pools import usable_cores

Size = int | tuple[int, int] | None
"""Longest side in pixels, or (width, height)."""
Trials = dict[tuple[str, str, Size], tuple[Job, Scene]]
"""Method, preset and size -> its first cell's job and scene."""


@dataclass
class _Progress:
    """Progress of a study's runs, weighted by their forecast seconds."""

    expected: dict[str, float]
    began: float
    spent: float = 0.0
    done: int = 0
    failed: int = 0

    def count(self, outcome: Outcome) -> tuple[float, str]:
        """Count a finished run; returns the finished share and the progress message."""
        self.done += 1
        self.failed += outcome.status != 0
        self.spent += self.expected[outcome.request.out]
        everything = max(sum(self.expected.values()), 1e-9)
        left = (time.monotonic() - self.began) * (everything / max(self.spent, 1e-9) - 1)
        failures = f", {self.failed} failed" if self.failed else ""
        share = 1.0 if self.done == len(self.expected) else min(self.spent / everything, 0.999)
        return share, f"{self.done} of {len(self.expected)} runs{failures}, about {duration(left)} left"


def ablate(request: AblateRequest, confirm: Callable[[Forecast], None]) -> tuple[Path, list[CellRecord]]:
    """Run every missing cell of a study; its record is kept up to date throughout.

    Args:
        request: the study, and where and how to run it.
        confirm: is shown the forecast before the first run, and may raise to call it off.

    Returns:
        The study's folder, and the cells that failed.

    Raises:
        InputError: anything that cannot be used; found before the first run.
        KeyboardInterrupt: interrupted; the runs that were under way have checkpoints.
    """
    path = locate(request.study)
    study = with_request(read_study(path), request)
    # Pinned also where a run has the machine to itself, so that its bits do not depend on who starts it.
    threads = torch.get_num_threads() if request.jobs == 1 else max(1, usable_cores() // request.jobs)
    resources = Resources(jobs=request.jobs, threads=threads, gpus=request.gpus, address=request.address, logs=True)
    executor: Executor = plugins.load("executors", request.executor)(resources)
    plan = make_plan(study, request)
    chosen = {planned.id for planned in select(plan, request)}
    folder = RunFolder(Path(request.out))
    check_not_published(folder, StudyRecord)
    folder.create()
    with folder.held():
        record = StudyRecorder(folder, summarise_study(study, name_of(path), (request, resources), plan[0].job), plan)
        fits = {planned.id: planned for planned in plan}
        states = {name: _state(planned, request.keep, name in chosen) for name, planned in fits.items()}
        trials, truths = _open_scenes([planned for name, planned in fits.items() if states[name].status == "missing"])
        missing = [planned for name, planned in fits.items() if states[name].status == "missing"]
        same = {p.id for p in missing if p.job.folder.finished and _is_same(p, truths[_truth_key(p)], threads)}
        states |= {p.id: CellState("done") for p in missing if p.id in same and renderings_complete(p.job)}
        missing = [planned for planned in missing if states[planned.id].status == "missing"]
        # Fits to which only scores or pictures of another renderer are missing.
        fitted = {p.id for p in missing if p.id in same or (request.keep and is_kept_fit(p.job))}
        replaced = [planned for planned in missing if planned.job.folder.finished and planned.id not in fitted]
        _check_threads(replaced, threads)
        warn_of_replaced(len(replaced))
        costs = _try_methods(missing, trials, threads)
        missing.sort(key=lambda planned: _execution_order(planned, study, costs))
        budgets = {planned.id: None if planned.id in fitted else planned.job.budget for planned in missing}
        expected = {planned.id: costs[_cost_key(planned)].seconds(budgets[planned.id]) for planned in missing}
        left = [fits[name] for name, state in states.items() if state.status in ("later", "skipped")]
        later = sum(not planned.job.folder.finished for planned in left)
        forecast = total([(costs[_cost_key(p)], budgets[p.id]) for p in missing], len(fits), request.jobs, later)
        _check_disk(forecast, folder.root)
        for sentence in announcements(planned.method.choice for planned in plan):
            print(sentence, file=sys.stderr)
        for reason in dict.fromkeys(state.reason for state in states.values() if state.status == "skipped"):
            print(f"Left out: {reason}.", file=sys.stderr)
        confirm(forecast)
        record.start(states | {name: CellState("missing", forecast=round(t, 1)) for name, t in expected.items()})
        write_analyses(study.analyses, folder.root)
        _run(executor, missing, expected, (record, folder.root / "jobs"))
        return folder.root, record.failed()


def _state(planned: Planned, keep: bool, chosen: bool) -> CellState:
    """Determine a cell's state without opening its scene: done, skipped, missing or left for later.

    Args:
        planned: the cell and its run.
        keep: whether a finished run counts although the code has changed since: its folder is named by recipe, scene and
            request.
        chosen: whether the cell is part of this command.
    """
    if keep and is_kept(planned.job):
        return CellState("done")
    if reason := missing_data_reason(planned.cell.scene):
        return CellState("skipped", reason)
    return CellState("missing" if chosen else "later")


def _truth_key(planned: Planned) -> tuple[str, Size]:
    """Key of a cell's ground truth: scene and size."""
    return planned.cell.scene, planned.fit.size


def _cost_key(planned: Planned) -> tuple[str, str, Size]:
    """Key of a cell's measured cost: method, preset and size."""
    return planned.cell.method, planned.method.preset, planned.fit.size


def _execution_order(planned: Planned, study: Study, costs: dict[tuple[str, str, Size], Cost]) -> tuple[int, float, int]:
    """Sort key of the execution order: seed, then forecast seconds, then size."""
    size = planned.fit.size
    seconds = costs[_cost_key(planned)].fit_seconds(planned.job.budget)
    return study.seeds.index(planned.cell.seed), seconds, max(size) if isinstance(size, tuple) else size or 0


def _open_scenes(plan: Sequence[Planned]) -> tuple[Trials, dict[tuple[str, Size], str]]:
    """Open every scene once per size, rendered if necessary; keeps those that costs are measured on, and the hashes of all.

    Raises:
        InputError: a scene cannot be used, or not with every level of the data's factors.
    """
    first = {_cost_key(planned): planned for planned in reversed(plan)}
    trials: Trials = {}
    truths = {}
    for place in dict.fromkeys(map(_truth_key, plan)):
        name, _ = place
        group = [planned for planned in plan if _truth_key(planned) == place]
        scene = open_with_progress(name, group[0].job.options)
        for data in dict.fromkeys(planned.job.data for planned in group):
            data.check(scene)
        methods = {planned.method.digest: planned.method for planned in group}.values()
        check_variants(group[0].job.variants, methods, scene)
        truths[place] = truth_digest(scene)
        trials |= {key: (planned.job, scene) for key, planned in first.items() if _truth_key(planned) == place}
    return trials, truths


def _is_same(planned: Planned, truth: str, threads: int) -> bool:
    """Whether the finished run in a cell's place is of this code and these pictures."""
    return planned.job.folder.identity == run_digest(planned.job, truth, threads)


def _check_threads(replaced: Sequence[Planned], threads: int) -> None:
    """Refuse to replace finished fits by fits with another number of threads.

    Raises:
        InputError: names the first.
    """
    for planned in replaced:
        try:
            check_replaceable(planned.job, threads)
        except InputError as error:
            remedy = "Give the same --jobs, add --keep to keep what is finished, or choose another --out."
            raise InputError(error.sentence, remedy) from error


def _try_methods(missing: Sequence[Planned], trials: Trials, threads: int) -> dict[tuple[str, str, Size], Cost]:
    """Measure the cost of a run of each method with each preset at each size, by its first cell, with a run's threads."""
    costs: dict[tuple[str, str, Size], Cost] = {}
    with limited_threads(threads):
        for planned in missing:
            if _cost_key(planned) not in costs:
                costs[_cost_key(planned)] = try_method(*trials[_cost_key(planned)])
    return costs


def _check_disk(forecast: Forecast, folder: Path) -> None:
    free = shutil.disk_usage(folder).free
    if forecast.size > free:
        raise InputError(f"The study will write {forecast.size / 1e9:.2g} GB, and {folder} has {free / 1e9:.2g} GB left.")


def _run(executor: Executor, missing: list[Planned], expected: dict[str, float], files: tuple[StudyRecorder, Path]) -> None:
    """Run the missing cells; ``files`` are the record, and the folder for jobs and their logs."""
    record, jobs = files
    progress = _Progress({p.fit.out: expected[p.id] for p in missing}, time.monotonic())
    fits = [planned.fit for planned in missing]
    with Reporter("study", quiet_seconds=0) as reporter, closing(executor.run(fits, jobs)) as outcomes:
        for outcome in outcomes:
            if outcome.status == INTERRUPTED:
                raise KeyboardInterrupt
            record.note(outcome)
            reporter.show(*progress.count(outcome))
