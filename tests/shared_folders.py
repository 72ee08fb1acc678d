"""Folders that several test processes share: what takes seconds to make is made by the first that wants it."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from invgraphics import locks

Once = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Folder that is filled once for all test processes, by the first that asks for it; to be read only."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent

    def folder(name: str, fill: Callable[[Path], object]) -> Path:
        path = root / f"once-{name}"
        done = path.with_suffix(".done")
        with locks.locked(path, waiting=lambda holder: None):
            if not done.exists():
                shutil.rmtree(path, ignore_errors=True)
                path.mkdir()
                fill(path)
                done.touch()
        return path

    return folder
