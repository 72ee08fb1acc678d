"""`reconstruct`: turn a folder of photographs into a scene, in a worker process, once."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from invgraphics import locks
from invgraphics.errors import InputError
from invgraphics.files import write_text
from invgraphics.scenes.photos.job import DATABASE, QUALITY, TOP_VIEW, PhotoJob
from invgraphics.scenes.pictures.masks import FOLDER
from invgraphics.scenes.process import Progress, run_worker
from invgraphics.tables import parse_json, read_json

WORK = ".import"
"""Where unfinished work lies inside the folder of the result; features and matches stay there for another try."""

JOB, RESULT = "job.json", "result"
MATCHES = (DATABASE, f"{DATABASE}-wal", f"{DATABASE}-shm")
RESULTS = ("images", FOLDER, "sparse", TOP_VIEW, QUALITY)
"""What the work process leaves for the folder, the proof of completeness last."""

REFUSED = "refused"
"""Folder, inside that of an earlier usable result, of a later result that is not usable: it replaces no usable one."""


def reconstruct(job: PhotoJob, out: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Poses, points and straight pictures of a folder of photographs, which `invgraphics.scenes.open` then opens by itself.

    The same request finds its finished result, or goes on with what an interrupted one has left. One that differs in mapper or
    lens alone finds the features and matches.

    Args:
        job: which photographs, and how.
        out: a new or empty folder, or one of an earlier call.
        progress: called with (done, in all, what is being done).

    Returns:
        The content of quality.json in `result_folder`, ``out`` as a rule. Its ``usable`` is false where too few photographs
        could be placed, with the reason in ``refusal``; what could be placed is kept, but replaces no usable result.

    Raises:
        InputError: there are no photographs, the folder holds something else or cannot be written, or the work failed.
    """
    _check_source(job)
    key = job.key()
    report = progress or (lambda done, total, what: None)
    with writing(out) as lock:
        _check_target(job, out)
        (out / WORK).mkdir(parents=True, exist_ok=True)
        quality = _read_result(out, key) or _make(job, key, out, report, lock)
        _clear(out / WORK, (JOB, *MATCHES))
    return quality


def result_folder(out: Path, quality: dict[str, Any]) -> Path:
    """Folder of the import that ``quality`` reports on: ``out``, or its `REFUSED` where an earlier usable result is kept."""
    for folder in (out, out / REFUSED):
        found = read_quality(folder)
        if found is not None and found["key"] == quality.get("key"):
            return folder
    return out


def _read_result(out: Path, key: str) -> dict[str, Any] | None:
    """Read the report of the finished import with this key, usable or refused; ``None`` where there is none."""
    return next((found for found in map(read_quality, (out, out / REFUSED)) if found is not None and found["key"] == key), None)


@contextmanager
def writing(out: Path) -> Iterator[int]:
    """Lock the folder ``out``, which need not be there yet; yields the lock's descriptor.

    Raises:
        InputError: it cannot be written, or another process is writing it.
    """
    try:
        out.absolute().parent.mkdir(parents=True, exist_ok=True)
        with locks.locked(out) as lock:
            yield lock
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror or error}.", "Choose another --out.") from error


def read_quality(out: Path) -> dict[str, Any] | None:
    """Read the report of a finished import; ``None`` where there is none."""
    quality = _read_json(out / QUALITY)
    if quality is None or "key" not in quality:
        return None
    return {"consistency" if name == "suspicion" else name: value for name, value in quality.items()}  # its first name


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
    quality, left = read_quality(out), _read_json(out / WORK / JOB)
    for found, what in ((quality, "scene"), (left, "unfinished import")):
        if found is not None and Path(found["job"]["folder"]).resolve() != job.path.resolve():
            raise InputError(f"{out} holds the {what} of {found['job']['folder']}.", "Choose a new or empty folder.")
    if quality is not None or not out.exists() or not any(out.iterdir()) or (out / WORK).is_dir():
        return
    raise InputError(f"{out} already exists and holds something else.", "Choose a new or empty folder.")


def _make(job: PhotoJob, key: str, out: Path, progress: Progress, lock: int) -> dict[str, Any]:
    work = out / WORK
    request = work / JOB
    whole = replace(job, folder=str(job.path.resolve()))  # found again from any other folder
    asked = {"key": key, "matches": job.matches_key(), "job": parse_json(whole.text(), "the job")}
    left = _read_json(request)
    if left is None or left.get("matches") != asked["matches"]:  # of no use
        _clear(work, ())
    elif left.get("key") != key:
        _clear(work, (JOB, *MATCHES))
    write_text(request, json.dumps(asked))
    run_worker(
        "invgraphics.scenes.photos.work",
        work,
        progress,
        subject=f"The photographs of {job.folder} could not be put together",
        remedy="If memory ran out, make them smaller (--max-size). Finished steps are kept for the same command.",
        lock=lock,
    )
    _move_result(work / RESULT, out)
    quality = _read_result(out, key)
    if quality is None:
        raise InputError(f"{out} was not written.", "Choose another --out.")
    return quality


def _move_result(result: Path, out: Path) -> None:
    """Move a finished result to ``out`` in place of the earlier one; to `REFUSED` if that one is usable and this one is not."""
    earlier, made = read_quality(out), read_quality(result)
    refused = earlier is not None and earlier.get("usable") and made is not None and not made["usable"]
    target = out / REFUSED if refused else out
    target.mkdir(exist_ok=True)
    for name in reversed(RESULTS):  # an old report goes first, a new one comes last
        _remove(target / name)
    for name in RESULTS:
        if (result / name).exists():
            (result / name).replace(target / name)
    if not refused:
        _remove(out / REFUSED)


def _clear(work: Path, but: Sequence[str]) -> None:
    for path in work.iterdir():
        if path.name not in but:
            _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
