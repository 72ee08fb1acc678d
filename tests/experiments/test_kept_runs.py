"""Runs of recipes that differ only by keys without effect on pictures of their size are kept, others refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_up_runs import provenance_table
from PIL import Image
from training_fixtures import SMALL, InProcess

from invgraphics.errors import InputError
from invgraphics.experiments.compare import compare
from invgraphics.experiments.executors.base import Outcome
from invgraphics.experiments.identity import check_replaceable, run_digest, truth_digest
from invgraphics.experiments.job import Job
from invgraphics.experiments.renderings import is_kept
from invgraphics.experiments.request import AblateRequest, CompareRequest, FitRequest
from invgraphics.recipes.recipe import load_method
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.studies.ablate import ablate
from invgraphics.training.budget import Budget

METHOD = "splatting/gaussians"


def finished(folder: Path, size: int, *overrides: str) -> Job:
    """A request at ``size``, in whose folder the same request with ``overrides`` was finished."""
    made = load_method(METHOD, "laptop", overrides, Budget.parse("60s"))
    options = {"size": size, "test_views": 16}
    record = provenance_table(method=METHOD, recipe_sha256=made.digest, options=options)
    (folder / "provenance.json").write_text(json.dumps(record))
    (folder / "scores.json").write_text("{}")
    return Job.of(
        FitRequest(method=METHOD, scene="balls", size=size, test_views=16, budget="60s", preset="laptop", out=str(folder))
    )


@pytest.mark.parametrize(("size", "kept"), [(128, True), (800, False)])
def test_small_pictures_at_the_start_are_no_other_fit_of_small_photographs(tmp_path: Path, size: int, kept: bool) -> None:
    job = finished(tmp_path, size, "batches.start_size=0")
    assert is_kept(job) is kept
    if kept:
        check_replaceable(job)
    else:
        with pytest.raises(InputError, match="its recipe is"):
            check_replaceable(job)


def test_another_recipe_is_another_run_at_every_size(tmp_path: Path) -> None:
    job = finished(tmp_path, 128, "batches.views=7")
    assert not is_kept(job)
    with pytest.raises(InputError, match="its recipe is"):
        check_replaceable(job)


@pytest.mark.parametrize("keep", [False, True])
def test_a_comparison_that_is_interrupted_lists_no_run_of_earlier_code(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], keep: bool
) -> None:
    """Such a run was about to be fitted again; what this code made, or what the command keeps, is part of the comparison."""
    ended = []

    def run(self: object, requests: Sequence[FitRequest], jobs: Path) -> Iterator[Outcome]:
        ended.extend(Path(request.out).name for request in requests)
        yield from ()
        raise KeyboardInterrupt

    monkeypatch.setattr("invgraphics.experiments.compare.LocalExecutor.run", run)
    overrides = tuple(SMALL[METHOD])
    request = CompareRequest(
        scene=str(toy_folder),
        out=str(tmp_path),
        methods=(METHOD,),
        seeds=(0, 1, 2),
        budget="9steps",
        overrides=overrides,
        keep=keep,
    )
    truth = truth_digest(open_scene(str(toy_folder), SceneOptions()))
    for seed, fit in enumerate(request.fits()[:2]):
        job = Job.of(fit)
        identity = run_digest(job, truth, torch.get_num_threads()) if seed else "of earlier code"
        record = provenance_table(
            method=METHOD, scene=fit.scene, seed=seed, budget=fit.budget, recipe_sha256=job.method.digest, cell_sha256=identity
        )
        job.folder.create()
        (job.folder.root / "provenance.json").write_text(json.dumps(record | {"options": {"test_views": fit.test_views}}))
        (job.folder.root / "scores.json").write_text("{}")
    with pytest.raises(KeyboardInterrupt):
        compare(request)
    found = [Path(name).name for name in json.loads((tmp_path / "compare.json").read_text())["runs"]]
    assert ended == (["seed-2"] if keep else ["seed-0", "seed-1", "seed-2"])
    assert found == (["seed-0", "seed-1"] if keep else ["seed-1"])
    replaced = "1 finished run is of other code, packages or pictures, and fitted again; --keep keeps what other"
    assert (replaced in capsys.readouterr().err) is not keep


def test_a_kept_fit_is_shown_by_another_renderer_without_a_new_fit(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_process: type[InProcess]
) -> None:
    """The code has changed, and the second command asks for pictures that the first did not; the third finds all there."""
    shared = {"scene": str(toy_folder), "out": str(tmp_path), "methods": (METHOD,), "budget": "2steps"}
    first = CompareRequest(**shared, overrides=tuple(SMALL[METHOD]))
    compare(first)
    (run,) = [Path(fit.out) for fit in first.fits()]
    before = (run / "checkpoint.safetensors").read_bytes()
    monkeypatch.setattr("invgraphics.experiments.identity.code_version", lambda: "9.9+later")
    compare(CompareRequest(**shared, overrides=tuple(SMALL[METHOD]), render_with=("gaussian-volume/exact:steps=8",), keep=True))
    assert (run / "checkpoint.safetensors").read_bytes() == before
    assert len(json.loads((run / "renderings.json").read_text())["renderings"]) == 2
    in_process.made.clear()
    compare(CompareRequest(**shared, overrides=tuple(SMALL[METHOD]), render_with=("gaussian-volume/exact:steps=8",), keep=True))
    assert not in_process.made


@pytest.mark.usefixtures("in_process")
def test_a_study_shows_kept_fits_by_another_renderer_without_a_new_fit(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The code has changed; without ``keep`` the fit would be made again."""
    study = f'question = "?"\nscenes = ["{toy_folder}"]\nmethods = ["{METHOD}"]\nseeds = [0]\nbudget = "2steps"\n'
    base = "[base]\n" + "".join(f'"{METHOD}:{key}" = {value}\n' for key, value in (item.split("=") for item in SMALL[METHOD]))
    (tmp_path / "one.toml").write_text(study + base)
    request = AblateRequest(study=str(tmp_path / "one.toml"), out=str(tmp_path / "out"))
    ablate(request, lambda forecast: None)
    (run,) = (tmp_path / "out" / "runs").iterdir()
    before = (run / "checkpoint.safetensors").read_bytes(), (run / "fit.json").read_bytes()
    monkeypatch.setattr("invgraphics.experiments.identity.code_version", lambda: "9.9+later")
    (tmp_path / "one.toml").write_text('render_with = ["gaussian-volume/exact:steps=8"]\n' + study + base)
    forecasts = []
    ablate(replace(request, keep=True), forecasts.append)
    assert [forecast.missing for forecast in forecasts] == [1]
    assert ((run / "checkpoint.safetensors").read_bytes(), (run / "fit.json").read_bytes()) == before
    assert len(json.loads((run / "renderings.json").read_text())["renderings"]) == 2


@pytest.mark.usefixtures("in_process")
def test_kept_fits_are_not_shown_beside_other_pictures(toy_folder: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(toy_folder, data)
    shared = {"scene": str(data), "out": str(tmp_path / "out"), "methods": (METHOD,), "budget": "2steps"}
    compare(CompareRequest(**shared, overrides=tuple(SMALL[METHOD])))
    for picture in sorted((data / "test").glob("*.png")):
        Image.fromarray(255 - np.asarray(Image.open(picture))).save(picture)
    with pytest.raises(InputError, match=r"The test views of .* are not those that"):
        compare(CompareRequest(**shared, overrides=tuple(SMALL[METHOD]), protocol="float", keep=True))
