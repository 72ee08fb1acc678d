"""Paths of a run folder stay inside it, for whoever reads or writes them."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from made_up_runs import made_up_provenance, provenance_table
from PIL import Image

from invgraphics.errors import InputError
from invgraphics.runs import checkpoint
from invgraphics.runs.collection import runs_of
from invgraphics.runs.folder import CHECKPOINT, RunFolder
from invgraphics.runs.history import Moment
from invgraphics.runs.inside import inside
from invgraphics.runs.provenance import Provenance
from invgraphics.tools.predictions import open_pictures
from invgraphics.viewer.loaded_run import missing_file


@pytest.mark.parametrize("name", ["../b", "/etc/passwd", "x/../../b", "link", "link/more", "chain", "circle", "a\0b"])
def test_what_leads_outside_is_refused(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    (tmp_path / "b").mkdir()
    (folder / "link").symlink_to("../b")
    (folder / "chain").symlink_to("link")
    (folder / "circle").symlink_to("circle")
    with pytest.raises(InputError, match=r"leads outside|cannot be followed"):
        inside(folder, name)


def test_what_stays_inside_is_joined(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "a").symlink_to("folder")
    assert inside(tmp_path, "a", "x") == tmp_path / "a" / "x"
    assert inside(tmp_path / "a", "..", "a") == tmp_path / "a" / ".." / "a"


USES: dict[str, tuple[str, Callable[[RunFolder], object]]] = {
    "checkpoint": (CHECKPOINT, lambda run: checkpoint.load(run.checkpoint)),
    "snapshots": ("snapshots/0000.safetensors", lambda run: run.snapshots),
    "predictions": ("test/0000.npz", lambda run: run.predictions),
    "picture": ("test/0000.png", lambda run: run.picture(0)),
    "history": ("history.jsonl", lambda run: run.append_history(Moment(step=1, seconds=1.0))),
    "scores": ("scores.json", lambda run: run.finished),
    "provenance": ("provenance.json", lambda run: run.identity),
    "recipe": ("recipe.toml", lambda run: run.read_recipe()),
    "writing the recipe": ("recipe.toml", lambda run: run.write_recipe({})),
    "clearing": ("test", lambda run: run.clear()),
}


@pytest.mark.parametrize("what", USES)
def test_a_run_folder_follows_no_link_out_of_it(tmp_path: Path, what: str) -> None:
    name, use = USES[what]
    secret, run = tmp_path / "secret", RunFolder(tmp_path / "run")
    secret.mkdir()
    (secret / "a.npz").write_text("a secret")
    path = run.root / name
    path.parent.mkdir(parents=True)
    path.symlink_to(secret if what == "clearing" else secret / "a.npz")
    with pytest.raises(InputError, match="leads outside"):
        use(run)
    assert (secret / "a.npz").read_text() == "a secret"


@pytest.mark.parametrize(
    ("run", "truth", "good"),
    [
        ("a", "truth/c0", True),
        ("set/runs/hash", "../../truth/c0", True),
        ("set/runs/hash/seed-0", "../../../truth/c0", True),
        ("set/runs/hash/seed-0/rendered/exact", "../../../../../truth/c0", True),
        ("a/rendered/exact", "../../truth/c0", True),
        ("a", "../truth/c0", False),
        ("set/runs/hash", "../../c0", False),
        ("set/runs/hash", "../../../truth/c0", False),
        ("set/jobs/hash", "../../truth/c0", False),
    ],
)
def test_truth_lies_in_the_run_or_beside_the_runs(tmp_path: Path, run: str, truth: str, good: bool) -> None:
    folder, provenance = RunFolder(tmp_path / run), made_up_provenance(truth=truth)
    if good:
        assert folder.truth(provenance) == (tmp_path / run / truth).resolve()
    else:
        with pytest.raises(InputError, match="'truth' cannot be"):
            folder.truth(provenance)


def test_a_rendering_shows_the_fit_that_it_lies_in_only(tmp_path: Path) -> None:
    rendering = RunFolder(tmp_path / "run" / "rendered" / "exact")
    assert rendering.fit(made_up_provenance(fitted_run="../..")).root == (tmp_path / "run").resolve()
    assert rendering.fit(made_up_provenance()) is rendering
    for elsewhere in ("../../../other", str(tmp_path / "other"), "."):
        with pytest.raises(InputError, match="'fitted_run' cannot be"):
            rendering.fit(made_up_provenance(fitted_run=elsewhere))


def saved_run(root: Path) -> Path:
    """A run with one prediction and its truth."""
    for folder in ("test", "truth/c0"):
        (root / folder).mkdir(parents=True)
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(root / folder / "0000.png")
    np.savez(root / "test" / "0000.npz", rgb=np.zeros((8, 8, 3)), alpha=np.ones((8, 8)), depth=np.ones((8, 8)))
    np.savez(root / "truth" / "c0" / "0000.npz", depth=np.ones((8, 8)))
    (root / Provenance.FILE).write_text(json.dumps(provenance_table(truth="truth/c0")))
    (root / "recipe.toml").write_text("")
    checkpoint.save(root / CHECKPOINT, {"field": {"a": torch.zeros(1)}})
    return root


@pytest.mark.parametrize("name", ["test/0000.png", "test/0000.npz", "truth/c0/0000.png", "truth/c0/0000.npz"])
def test_saved_pictures_elsewhere_are_not_scored(tmp_path: Path, name: str) -> None:
    run = saved_run(tmp_path / "run")
    assert open_pictures(run).names == ("0000",)
    (run / name).rename(tmp_path / "elsewhere.bin")
    (run / name).symlink_to(tmp_path / "elsewhere.bin")
    with pytest.raises(InputError, match="leads outside"):
        open_pictures(run)


def test_the_viewer_opens_no_checkpoint_elsewhere(tmp_path: Path) -> None:
    run = saved_run(tmp_path / "run")
    assert missing_file(run) is None
    (run / CHECKPOINT).rename(tmp_path / "elsewhere")
    (run / CHECKPOINT).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="leads outside"):
        missing_file(run)


CELL = {"id": "c", "scene": "s", "method": "m", "seed": 0, "status": "done"}


@pytest.mark.parametrize("outside", ["/etc", "../b", "runs/../../b"])
@pytest.mark.parametrize(
    ("record", "runs"),
    [
        ("compare.json", lambda name: {"scene": "s", "methods": ["m"], "runs": [name]}),
        (
            "study.json",
            lambda name: {"name": "n", "scenes": ["s"], "methods": ["m"], "cells": [CELL | {"run": name}]},
        ),
    ],
)
def test_runs_that_a_record_names_outside_its_folder_are_refused(tmp_path: Path, record: str, runs, outside: str) -> None:
    """A damaged or foreign record; an absolute path used to end as a fault of invgraphics."""
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / record).write_text(json.dumps({"schema": 1} | runs(outside)))
    with pytest.raises(InputError, match="leads outside"):
        runs_of(tmp_path / "a")
