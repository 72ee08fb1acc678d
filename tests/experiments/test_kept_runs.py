"""Runs of recipes that differ only by keys without effect on pictures of their size are kept, others refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_up_runs import provenance_table

from invgraphics.errors import InputError
from invgraphics.experiments.identity import check_replaceable
from invgraphics.experiments.job import Job
from invgraphics.experiments.renderings import is_kept
from invgraphics.experiments.request import FitRequest
from invgraphics.recipes.recipe import load_method
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
