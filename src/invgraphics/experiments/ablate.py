"""A study, from its description to its runs: validate everything, forecast, run what is missing, record."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from invgraphics import plugins
from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.analyses import write_analyses
from invgraphics.experiments.build import device_of, training_data
from invgraphics.experiments.cells import Planned, make_plan
from invgraphics.experiments.environment import environment
from invgraphics.experiments.executors.base import INTERRUPTED, Executor, Outcome, Resources
from invgraphics.experiments.executors.local import cores
from invgraphics.experiments.folder import RunFolder
from invgraphics.experiments.forecast import Cost, Forecast, duration, total, try_method
from invgraphics.experiments.identity import TruthDigest, identify
from invgraphics.experiments.presets import announcements
from invgraphics.experiments.progress import Reporter
from invgraphics.experiments.renderings import check_eyes, rendered
from invgraphics.experiments.request import AblateRequest
from invgraphics.experiments.study import Study, locate, name_of, read_study
from invgraphics.metrics.protocols import protocol_named
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.training.budget import Budget

RECORD = "study.json"
"""What a study's folder holds beside its runs: the design, and the state of every cell."""


@dataclass
class _Progress:
    """How far the runs are, and how long they took compared with the forecast."""

    expected: dict[str, float]
    began: float
    spent: float = 0.0
    done: int = 0
    failed: int = 0

    def count(self, outcome: Outcome) -> tuple[float, str]:
        """Take a run into account; returns the finished share and what to say."""
        self.done += 1
        self.failed += outcome.status != 0
        self.spent += self.expected[outcome.request.out]
        everything = max(sum(self.expected.values()), 1e-9)
        left = (time.monotonic() - self.began) * (everything / max(self.spent, 1e-9) - 1)
        failures = f", {self.failed} failed" if self.failed else ""
        share = 1.0 if self.done == len(self.expected) else min(self.spent / everything, 0.999)
        return share, f"{self.done} of {len(self.expected)} runs{failures}, about {duration(left)} left"


def ablate(request: AblateRequest, confirm: Callable[[Forecast], None]) -> tuple[Path, list[dict[str, Any]]]:
    """Make every run of a study that is missing; ``study.json`` is true at any moment.

    Args:
        request: the study, and where and how to run it.
        confirm: is shown the forecast before the first run, and may raise to call it off.

    Returns:
        The study's folder, and the entries of ``study.json`` of the cells that failed.

    Raises:
        InputError: anything that cannot be used; found before the first run.
        KeyboardInterrupt: interrupted; the runs that were under way have checkpoints.
    """
    path = locate(request.study)
    study = read_study(path).overridden(request)
    # Pinned also where a run has the machine to itself, so that its bits do not depend on who starts it.
    threads = torch.get_num_threads() if request.jobs == 1 else max(1, cores() // request.jobs)
    resources = Resources(jobs=request.jobs, threads=threads, gpus=request.gpus, address=request.address, logs=True)
    executor: Executor = plugins.load("executors", request.executor)(resources)
    plan = make_plan(study, request)
    folder = RunFolder(Path(request.out))
    folder.create()
    with folder.held():
        record = Record(folder, _summary(study, name_of(path), request, resources), plan)
        first, truths = _open_scenes(study, plan)
        fits = {planned.id: planned for planned in plan}
        missing = [planned for planned in fits.values() if not _is_finished(planned, truths[planned.cell.scene], threads)]
        costs = _try_methods(missing, first)
        forecast = total([(costs[p.kind], Budget.parse(p.fit.budget)) for p in missing], len(fits), request.jobs)
        _check_disk(forecast, folder.root)
        for sentence in announcements(planned.method.choice for planned in plan):
            print(sentence, file=sys.stderr)
        confirm(forecast)
        record.start({planned.id for planned in missing})
        write_analyses(study.analyses, folder.root)
        _run(executor, missing, costs, (record, folder.root / "jobs"))
        return folder.root, record.failed()


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

    def start(self, missing: set[str]) -> None:
        """Mark what is missing, and write."""
        for entry in self._cells:
            if entry["id"] in missing:
                entry |= {"status": "missing", "error": None, "seconds": None}
            else:
                entry |= {"status": "done", "error": None}
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
    cell = planned.cell
    return {
        "id": planned.id,
        "scene": cell.scene,
        "method": cell.method,
        "seed": cell.seed,
        "levels": cell.levels,
        "run": f"runs/{planned.id}",
        "status": "missing",
        "error": None,
        "seconds": before.get("seconds"),
    }


def _summary(study: Study, name: str, request: AblateRequest, resources: Resources) -> dict[str, Any]:
    """Everything of ``study.json`` but the cells."""
    keys = ("question", "design", "factors", "base", "scenes", "methods", "seeds", "budget", "preset", "size", "test_views")
    keys += ("render_with", "analyses")
    machine = environment(device_of(request.device))
    machine |= {"threads": resources.threads, "executor": request.executor, "jobs": resources.jobs}
    return {
        "schema": 1,
        "name": name,
        **{key: getattr(study, key) for key in keys},
        "approximations": [asdict(pair) for pair in study.approximations],
        "protocol": asdict(protocol_named(study.protocol)),
        "command": request.shell(),
        "environment": machine,
    }


def _open_scenes(study: Study, plan: list[Planned]) -> tuple[Scene, dict[str, TruthDigest]]:
    """Open every scene once, rendering what has to be; the first one is kept, of the others the fingerprints.

    Raises:
        InputError: a scene cannot be used, or not with every level of the data's factors.
    """
    views = None if study.test_views == "all" else study.test_views
    first: Scene | None = None
    truths = {}
    for name in study.scenes:
        with Reporter(f"rendering {name}") as reporter:
            options = SceneOptions(size=study.size, test_views=views, spp=study.spp)
            scene = open_scene(name, options, lambda done, n, what, r=reporter: r.show(done / max(n, 1), what))
        for data in dict.fromkeys(training_data(planned.fit) for planned in plan):
            data.check(scene)
        check_eyes(study.render_with, {planned.method.digest: planned.method for planned in plan}.values(), scene)
        first, truths[name] = first or scene, TruthDigest.of(scene)
    assert first is not None, "a study has at least one scene"
    return first, truths


def _is_finished(planned: Planned, truth: TruthDigest, threads: int) -> bool:
    run = RunFolder(Path(planned.fit.out))
    same = run.finished and run.identity == identify(planned.fit, planned.method, truth, threads)
    return same and rendered(run, planned.fit, planned.method)


def _try_methods(missing: list[Planned], scene: Scene) -> dict[tuple[str, str], Cost]:
    """What a run of each method and preset costs, measured on one scene."""
    costs: dict[tuple[str, str], Cost] = {}
    for planned in missing:
        if planned.kind not in costs:
            costs[planned.kind] = try_method(planned.fit, planned.method, scene)
    return costs


def _check_disk(forecast: Forecast, folder: Path) -> None:
    free = shutil.disk_usage(folder).free
    if forecast.size > free:
        raise InputError(f"The study will write {forecast.size / 1e9:.2g} GB, and {folder} has {free / 1e9:.2g} GB left.")


def _run(executor: Executor, missing: list[Planned], costs: dict[tuple[str, str], Cost], files: tuple[Record, Path]) -> None:
    """Run what is missing; ``files`` are the record, and the folder for jobs and their logs."""
    record, jobs = files
    expected = {p.fit.out: costs[p.kind].seconds(Budget.parse(p.fit.budget)) for p in missing}
    progress = _Progress(expected, time.monotonic())
    fits = [planned.fit for planned in missing]
    with Reporter("study", quiet_seconds=0) as reporter, closing(executor.run(fits, jobs)) as outcomes:
        for outcome in outcomes:
            if outcome.status == INTERRUPTED:
                raise KeyboardInterrupt
            record.note(outcome)
            reporter.show(*progress.count(outcome))
