"""Cache of rendered scenes: location, completeness, and a lock between processes that render the same one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from invgraphics import locks
from invgraphics.errors import InputError
from invgraphics.files import copy_file
from invgraphics.tables import read_json

VARIABLE = "INVGRAPHICS_CACHE"
TRUTH = "truth.json"
REQUEST = "job.json"
SCHEMA = 1
INSTANCES = "instances"
"""Key of ``truth.json`` of a class of objects: its numbers of instances."""
VIEWS = "views.npz"
"""A class's views, in the format of `invgraphics.scenes.npz`."""
AVERAGED_FROM = "averaged_from"
"""Key of ``truth.json``: size and samples of the larger rendering whose pictures were averaged."""


def root() -> Path:
    """Folder of all rendered scenes, created if need be.

    Raises:
        InputError: it cannot be written.
    """
    base = Path(os.environ.get(VARIABLE) or Path.home() / ".cache" / "invgraphics").expanduser().resolve()
    scenes = base / "scenes"
    try:
        scenes.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(scenes, error) from error
    if not os.access(scenes, os.W_OK | os.X_OK):
        raise unwritable(scenes, PermissionError("permission denied"))
    return scenes


def unwritable(folder: Path, error: OSError) -> InputError:
    """Make the error for a cache folder that cannot be written."""
    return InputError(f"{folder} cannot be written: {error.strerror or error}.", f"Set {VARIABLE} to a folder with free space.")


def read_truth(folder: Path) -> dict[str, Any] | None:
    """Read a folder's ``truth.json``; ``None`` where it is missing, broken, or a listed file has lost bytes."""
    try:
        content = read_json(folder / TRUTH)
        whole = content["schema"] == SCHEMA and all((folder / path).stat().st_size == n for path, n in content["files"].items())
    except (InputError, OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return content if whole else None


@contextmanager
def locked(folder: Path, waiting: Callable[[], None]) -> Iterator[int]:
    """Hold an exclusive lock on ``folder``, and yield its descriptor; a second process waits."""
    file = folder.with_name(f"{folder.name}.lock")
    try:
        file.touch()
    except OSError as error:
        raise unwritable(folder.parent, error) from error
    with locks.locked(folder, file, lambda holder: waiting()) as descriptor:
        yield descriptor


def copy(source: Path, target: Path) -> Path:
    """Copy a complete scene atomically to a new or empty folder; a no-op if that already holds it.

    Raises:
        InputError: the target holds something else, or cannot be written.
    """
    try:
        target.absolute().parent.mkdir(parents=True, exist_ok=True)
        with locks.locked(target):
            return _copy(source, target)
    except OSError as error:
        raise InputError(f"{target} cannot be written: {error.strerror or error}.") from error


def _copy(source: Path, target: Path) -> Path:
    wanted, present = read_truth(source), read_truth(target)
    if wanted and present and wanted["key"] == present["key"]:
        return target
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{target} already exists and holds something else.", "Choose a new or empty folder.")
    partial = target.with_name(f".{target.name}.partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(source, partial, copy_function=copy_file)
        partial.replace(target)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return target
