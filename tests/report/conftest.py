"""A comparison folder and a study folder, raw and reported."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from report_folders import write_comparison, write_study
from shared_folders import Once


@pytest.fixture(scope="session")
def pristine_comparison(once: Once) -> Path:
    """A comparison folder that nobody may change."""
    return once("comparison", lambda folder: write_comparison(folder / "balls")) / "balls"


@pytest.fixture
def comparison_folder(pristine_comparison: Path, tmp_path: Path) -> Path:
    """A comparison folder of one's own."""
    return Path(shutil.copytree(pristine_comparison, tmp_path / "balls"))


@pytest.fixture(scope="session")
def built_report(pristine_comparison: Path, once: Once) -> Path:
    """The folder of a finished report; read only."""
    from invgraphics.report.build import build_report

    return once("report", lambda folder: build_report(shutil.copytree(pristine_comparison, folder / "balls"))) / "balls"


@pytest.fixture
def edit() -> Callable[[Path, Callable[[dict[str, Any]], None]], None]:
    """Change a JSON file in place."""

    def change(path: Path, by: Callable[[dict[str, Any]], None]) -> None:
        table = json.loads(path.read_text())
        by(table)
        path.write_text(json.dumps(table))

    return change


@pytest.fixture(scope="session")
def pristine_study(once: Once) -> Path:
    """A study folder that nobody may change."""
    return once("study", lambda folder: write_study(folder / "views")) / "views"


@pytest.fixture
def small_study(tmp_path: Path, once: Once) -> Path:
    """A study of four cells, one of which failed."""

    def write(folder: Path) -> None:
        write_study(folder / "small", {"balls": (0,)}, {"data.train_views": [40, 20]}, (0, 1), {1: "failed"})

    return shutil.copytree(once("small-study", write) / "small", tmp_path / "small")


@pytest.fixture(scope="session")
def built_study(pristine_study: Path, once: Once) -> Path:
    """The folder of a reported study; read only."""
    from invgraphics.report.study import build_study_report

    return once("study-report", lambda folder: build_study_report(shutil.copytree(pristine_study, folder / "views"))) / "views"
