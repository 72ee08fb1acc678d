"""`reconstruct`: turn a folder of photographs into a scene, in a worker process, once."""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from invgraphics.errors import InputError
from invgraphics.scenes.photos.job import DATABASE, QUALITY, TOP_VIEW, PhotoJob
from invgraphics.scenes.process import Progress, run_worker
from invgraphics.tables import parse_json, read_json

WORK = ".import"
"""Where unfinished work lies inside the folder of the result; features and matches stay there for another try."""

JOB, LOCK, RESULT = "job.json", "lock", "result"
MATCHES = (DATABASE, f"{DATABASE}-wal", f"{DATABASE}-shm")
RESULTS = ("images", "sparse", TOP_VIEW, QUALITY)
"""What the work process leaves for the folder, the proof of completeness last."""


def reconstruct(job: PhotoJob, out: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Poses, points and straight pictures of a folder of photographs, which `invgraphics.scenes.open` then opens by itself.

    The same request finds its finished result, or goes on with what an interrupted one has left. One that differs in mapper or
    lens alone finds the features and matches.

    Args:
        job: which photographs, and how.
        out: a new or empty folder, or one of an earlier call.
        progress: called with (done, in all, what is being done).

    Returns:
        The content of ``out``/quality.json. Its ``usable`` is false where too few photographs could be placed, with the reason
        in ``refusal``; what could be placed is kept all the same.

    Raises:
        InputError: there are no photographs, the folder holds something else or cannot be written, or the work failed.
    """
    _check_source(job)
    key = job.key()
    report = progress or (lambda done, total, what: None)
    try:
        _check_target(job, out)
        (out / WORK).mkdir(parents=True, exist_ok=True)
        with _locked(out):
            quality = read_quality(out)
            if quality is None or quality["key"] != key:
                quality = _make(job, key, out, report)
            _clear(out / WORK, (JOB, LOCK, *MATCHES))
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror or error}.", "Choose another --out.") from error
    return quality


def read_quality(out: Path) -> dict[str, Any] | None:
    """The report of a finished import; ``None`` where there is none."""
    quality = _read_json(out / QUALITY)
    return quality if quality is not None and "key" in quality else None


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        table = read_json(path)
    except InputError:
        return None
    return table if isinstance(table, dict) else None


def _check_source(job: PhotoJob) -> None:
    if not job.path.exists():
        raise InputError(f"There is no folder '{job.folder}'.", "Expected: a folder of photographs.")
    if not job.path.is_dir():
        raise InputError(f"'{job.folder}' is no folder.", "Put the photographs into a folder of their own and name that.")
    if not any(job.path.iterdir()):
        raise InputError(f"{job.folder} is an empty folder.", "Put photographs into it: JPEG, PNG, WebP, TIFF or BMP.")


def _check_target(job: PhotoJob, out: Path) -> None:
    if out.resolve().is_relative_to(job.path.resolve()):
        raise InputError(f"{out} lies inside the folder of the photographs.", "Choose an --out beside it.")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file.", "Name a new or empty folder.")
    quality = read_quality(out)
    if quality is not None and Path(quality["job"]["folder"]).resolve() != job.path.resolve():
        raise InputError(f"{out} holds the scene of {quality['job']['folder']}.", "Choose a new or empty folder.")
    if quality is not None or not out.exists() or not any(out.iterdir()) or (out / WORK).is_dir():
        return
    raise InputError(f"{out} already exists and holds something else.", "Choose a new or empty folder.")


def _make(job: PhotoJob, key: str, out: Path, progress: Progress) -> dict[str, Any]:
    work = out / WORK
    request = work / JOB
    asked = {"key": key, "matches": job.matches_key(), "job": parse_json(job.text(), "the job")}
    left = _read_json(request)
    if left is None or left.get("matches") != asked["matches"]:  # of no use
        _clear(work, (LOCK,))
    elif left != asked:
        _clear(work, (LOCK, JOB, *MATCHES))
    request.write_text(json.dumps(asked), encoding="utf-8")
    run_worker(
        "invgraphics.scenes.photos.work",
        work,
        progress,
        subject=f"The photographs of {job.folder} could not be put together",
        remedy="If memory ran out, make them smaller (--max-size). What is done is kept: the same command goes on from there.",
    )
    for name in reversed(RESULTS):  # an old report goes first, a new one comes last
        _remove(out / name)
    for name in RESULTS:
        if (work / RESULT / name).exists():
            (work / RESULT / name).replace(out / name)
    quality = read_quality(out)
    if quality is None:
        raise InputError(f"{out} was not written.", "Choose another --out.")
    return quality


def _clear(work: Path, but: Sequence[str]) -> None:
    for path in work.iterdir():
        if path.name not in but:
            _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Hold an exclusive lock on ``out``; the system releases it when a process dies."""
    with (out / WORK / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"Another process is filling {out}.", "Wait for it, or choose another --out.") from None
        yield
