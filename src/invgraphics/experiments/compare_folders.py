"""Run folders of a comparison: whose they are, which fits are still to be made, and which finished runs count as made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.identity import run_digest, truth_digest
from invgraphics.experiments.job import Job
from invgraphics.experiments.progress import warn
from invgraphics.experiments.renderings import is_kept, is_kept_fit, renderings_complete
from invgraphics.experiments.request import CompareRequest, FitRequest
from invgraphics.runs.comparison import ComparisonRecord
from invgraphics.runs.folder import RUNS, RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.runs.schema import Record


def name_others(request: CompareRequest) -> None:
    """Warn of runs of earlier commands in the same folder, which are not part of this report."""
    mine = {Path(fit.out) for fit in request.fits()}
    others = sorted(path.parent for path in Path(request.out).glob(f"{RUNS}/*/seed-*/{Provenance.FILE}"))
    if left := [folder.relative_to(request.out).as_posix() for folder in others if folder not in mine]:
        warn(f"Not part of this report, but of an earlier command on {request.out}: {', '.join(left)}.")


def check_not_published(folder: RunFolder, record: type[Record]) -> None:
    """Refuse a folder that holds a report's page without the record of its runs: a published one, which would be replaced.

    Raises:
        InputError: it is one.
    """
    if (folder.root / "index.html").is_file() and not folder.has(record):
        raise InputError(f"{folder.root} holds a published report, which would be replaced.", "Choose another --out.")


def check_folders(request: CompareRequest) -> None:
    """Refuse a published report's folder, and methods of other names whose runs would share one: built in, and a file.

    Raises:
        InputError: names the folder, or two methods.
    """
    check_not_published(RunFolder(Path(request.out)), ComparisonRecord)
    owners: dict[Path, str] = {}
    for method in request.methods:
        folder = request.folder(method, request.seeds[0]).parent
        other = owners.setdefault(folder, method)
        if other != method:
            raise InputError(
                f"The runs of '{other}' and '{method}' would share the folder {folder}.", "Rename the recipe's file."
            )


def missing_fits(request: CompareRequest, jobs: Sequence[Job]) -> list[FitRequest]:
    """Fits to start: all, since each finds by itself what is finished, but those that are kept and complete."""
    methods = {job.request.method: job.method for job in jobs}
    return [fit for fit in request.fits() if not (request.keep and is_kept(Job.of(fit, methods[fit.method])))]


def any_finished(request: CompareRequest) -> bool:
    """Whether a run of an earlier command is finished in one of the folders, by whatever code."""
    return any(RunFolder(Path(fit.out)).finished for fit in request.fits())


def made_before(request: CompareRequest, jobs: Sequence[Job], scene: Scene | None) -> set[str]:
    """Folders of finished runs that count though no fit of this command has ended: of this code and these pictures, or kept.

    Those of earlier code are about to be replaced, as a warning says; they are no result of a command that is interrupted.

    Args:
        request: with its methods.
        jobs: one of each method.
        scene: as loaded; ``None`` where no run is finished.
    """
    if scene is None:
        return set()
    methods, truth = {job.request.method: job.method for job in jobs}, ""
    found, replaced = set(), 0
    for fit in request.fits():
        job = Job.of(fit, methods[fit.method])
        if request.keep and is_kept_fit(job):
            found.add(fit.out)
        elif job.folder.finished and renderings_complete(job):
            truth = truth or truth_digest(scene)
            if job.folder.identity == run_digest(job, truth, torch.get_num_threads()):
                found.add(fit.out)
            else:
                replaced += 1
    warn_of_replaced(replaced)
    return found


def warn_of_replaced(count: int) -> None:
    """Warn of finished runs that are fitted again because code or pictures have changed, and name the way to keep them."""
    if count:
        what = "1 finished run is" if count == 1 else f"{count} finished runs are"
        warn(f"{what} of other code, packages or pictures, and fitted again; --keep keeps what other code or packages made.")
