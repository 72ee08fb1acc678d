"""A report reads and copies nothing from outside a run, whatever links and names in its folder say."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from judged_folders import entry, write_judged

from invgraphics.errors import InputError
from invgraphics.report.build import build_from_runs, build_report
from invgraphics.report.study import build_study_report
from invgraphics.runs.folder import PUBLISHED

SECRET = "the words of a diary"


def assert_kept(out: Path) -> None:
    """No file of a report holds the secret."""
    assert not [path for path in out.rglob("*") if path.is_file() and SECRET.encode() in path.read_bytes()]


def refused(build: Callable[[], object], out: Path, sentence: str = "leads outside") -> None:
    with pytest.raises(InputError, match=sentence) as caught:
        build()
    assert SECRET not in str(caught.value)
    assert_kept(out)


def replace_by_link(path: Path, target: Path) -> None:
    path.unlink()
    path.symlink_to(target)


@pytest.fixture
def judged(tmp_path: Path) -> Path:
    """A study of one cell, and a file outside that holds a secret."""
    (tmp_path / "secret").write_text(SECRET)
    return write_judged(tmp_path / "study", [entry("volumetric/hash", "bricks", 200, "60s")])


@pytest.mark.parametrize("public", [False, True])
@pytest.mark.parametrize("name", [*PUBLISHED, "../../study.json"])
@pytest.mark.parametrize("relative", [False, True])
def test_a_link_to_a_file_elsewhere_is_not_followed(
    judged: Path, tmp_path: Path, name: str, public: bool, relative: bool
) -> None:
    path = next((judged / "runs").iterdir()) / name
    target = tmp_path / "secret"
    shutil.copyfile(path, target)  # a good file, so that only the link is wrong
    with target.open("a") as file:
        file.write(" " if name.endswith(("json", "jsonl")) else f"# {SECRET}\n")
    path = path.parent.resolve() / path.name if ".." not in name else judged / "study.json"
    replace_by_link(path, Path(os.path.relpath(target, path.parent)) if relative else target)
    refused(lambda: build_study_report(judged, tmp_path / "out", public), tmp_path / "out")


def test_a_folder_that_is_a_link_is_not_followed(judged: Path, tmp_path: Path) -> None:
    run = next((judged / "runs").iterdir())
    shutil.move(run, tmp_path / "elsewhere")
    run.symlink_to(tmp_path / "elsewhere")
    refused(lambda: build_study_report(judged, tmp_path / "out"), tmp_path / "out")


@pytest.mark.parametrize("where", ["../elsewhere", "{tmp}/elsewhere", "runs/../../elsewhere"])
def test_a_record_names_no_folder_elsewhere(judged: Path, tmp_path: Path, where: str) -> None:
    shutil.move(next((judged / "runs").iterdir()), tmp_path / "elsewhere")
    table = json.loads((judged / "study.json").read_text())
    table["cells"][0]["run"] = where.format(tmp=tmp_path)
    (judged / "study.json").write_text(json.dumps(table))
    refused(lambda: build_study_report(judged, tmp_path / "out"), tmp_path / "out")


def test_a_record_names_no_place_elsewhere_to_write_to(judged: Path, tmp_path: Path) -> None:
    table = json.loads((judged / "study.json").read_text())
    table["cells"][0]["id"] = "../../planted"
    (judged / "study.json").write_text(json.dumps(table))
    refused(lambda: build_study_report(judged, tmp_path / "out"), tmp_path / "out")
    assert not (tmp_path / "planted").exists()


def test_a_link_to_a_pipe_is_not_waited_for(judged: Path, tmp_path: Path) -> None:
    path = next((judged / "runs").iterdir()) / "recipe.toml"
    path.unlink()
    os.mkfifo(path)
    refused(lambda: build_study_report(judged, tmp_path / "out"), tmp_path / "out", "neither a file nor a folder")


@pytest.mark.parametrize("public", [False, True])
@pytest.mark.parametrize("where", ["../../../elsewhere", "{tmp}/elsewhere", "../../../../elsewhere"])
def test_truth_elsewhere_is_not_shown(
    comparison_folder: Path, tmp_path: Path, edit: Callable[..., None], where: str, public: bool
) -> None:
    for place in (tmp_path / "elsewhere", comparison_folder / "elsewhere"):
        shutil.copytree(next((comparison_folder / "truth").iterdir()), place)
    for path in comparison_folder.rglob("provenance.json"):
        edit(path, lambda table: table.update(truth=where.format(tmp=tmp_path)))
    out = tmp_path / "out"
    refused(lambda: build_report(comparison_folder, out, public), out, "'truth' cannot be|is missing")  # once redacted
    runs = sorted((comparison_folder / "runs").glob("*/seed-0"))
    refused(lambda: build_from_runs(runs, out, public), out, "'truth' cannot be")


@pytest.mark.parametrize(
    "name", ["truth/*/0000.png", "truth/*/0000.npz", "runs/*/seed-0/test/0000.png", "runs/*/seed-0/test/0000.npz"]
)
def test_a_picture_elsewhere_is_not_shown(comparison_folder: Path, tmp_path: Path, name: str) -> None:
    path = next(comparison_folder.glob(name))
    shutil.move(path, tmp_path / path.name)
    path.symlink_to(tmp_path / path.name)
    runs = sorted((comparison_folder / "runs").glob("*/seed-0"))
    refused(lambda: build_from_runs(runs, tmp_path / "out"), tmp_path / "out")


def test_links_inside_a_folder_and_to_it_are_followed(judged: Path, tmp_path: Path) -> None:
    run = next((judged / "runs").iterdir())
    shutil.move(run / "recipe.toml", run / "mine.toml")
    (run / "recipe.toml").symlink_to("mine.toml")
    (tmp_path / "latest").symlink_to(judged)
    assert build_study_report(tmp_path / "latest", tmp_path / "out").is_file()
