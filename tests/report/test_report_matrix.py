"""The table of methods on a comparison's page, and patterns that name many methods at once."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
from made_up_runs import made_up_run

from invgraphics.core import Scene
from invgraphics.errors import InputError, NotComposableError
from invgraphics.experiments import compare as comparing
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import CompareRequest
from invgraphics.recipes.recipe import expand, methods
from invgraphics.recipes.table import matrix as recipe_matrix
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.pages.comparison import markdown_matrix
from invgraphics.report.pages.matrix import method_matrix
from invgraphics.report.pages.parts import Drawn, Part
from invgraphics.report.statistics.summary import summarise
from invgraphics.runs.comparison import Failure, Refusal
from invgraphics.runs.scores import Score
from invgraphics.scenes.truth import POINTS as EXACT_POINTS
from invgraphics.testing import toy_scene

CELLS = {
    "a": ("grid", "volume"),
    "b": ("grid", "volume"),
    "c": ("grid", "surface"),
    "d": ("network", "volume"),
    "e": ("network", "surface"),
    "f": ("points", "surface"),
}
PSNR = {"a": 30.0, "b": 31.0, "c": 25.0, "d": 28.0, "e": 26.5}


def page(cells: dict[str, tuple[str, str]], runs: dict[str, Sequence[float]], failed: str = "f") -> Part:
    made = [
        made_up_run({"psnr": Score(mean=value, unit="dB", higher_is_better=True)}, method, seed, cost={"fit_seconds": 60.0})
        for method, values in runs.items()
        for seed, value in enumerate(values)
    ]
    comparison = Comparison(
        scene="balls",
        question="?",
        methods=tuple(cells),
        runs=tuple(made),
        failures=(Failure(method=failed, seed=0, error="It diverged."),),
        cells=cells,
        refused=(Refusal(method="g|h", reason="It needs a mask."),),
    )
    return Part("", comparison, summarise(comparison), [], None, Drawn(None, [], [], ()), [], None)


def test_every_method_stands_in_its_cell_and_the_best_are_marked() -> None:
    table = method_matrix(page(CELLS, {name: [value] for name, value in PSNR.items()}))
    assert table is not None
    assert table.columns == ("volume", "surface")
    named = {
        (field, table.columns[column]): [entry.method for entry in cell]
        for field, row in table.rows
        for column, cell in enumerate(row)
    }
    assert named[("grid", "volume")] == ["a", "b"]
    assert named[("points", "volume")] == []
    entries = {entry.method: entry for _, row in table.rows for cell in row for entry in cell}
    assert set(entries) == set(CELLS)
    # By hand: 31 leads the grids and volume rendering, 28 the networks, 26.5 the surfaces; points have no rival.
    assert {name for name, entry in entries.items() if entry.best_of_row} == {"b", "d"}
    assert {name for name, entry in entries.items() if entry.best_of_column} == {"b", "e"}
    assert entries["f"].failed == "failed: It diverged."
    assert entries["a"].score == "30.00"
    assert ("Fit", "60.0 s") in entries["a"].figures
    lines = markdown_matrix(table)
    assert "| grid | a 30.00, b 31.00 | c 25.00 |" in lines
    assert r"- g\|h: It needs a mask." in lines


def test_a_method_that_lacks_a_seed_is_not_marked() -> None:
    runs = {name: [value, value] for name, value in PSNR.items()} | {"b": [31.0]}
    table = method_matrix(page(CELLS, runs))
    assert table is not None
    marked = {entry.method for _, row in table.rows for cell in row for entry in cell if entry.best_of_row}
    assert marked == {"a", "d"}


def test_few_methods_or_unknown_cells_have_no_table() -> None:
    few = {name: CELLS[name] for name in "abc"}
    assert method_matrix(page(few, {"a": [30.0], "b": [31.0]}, failed="c")) is None
    part = page(CELLS, {"a": [30.0]})
    part.comparison.cells.clear()
    assert method_matrix(part) is None


def test_patterns_name_methods_once_and_in_order() -> None:
    names, optional = expand(["splatting/gaussians", "learned/*", "all"])
    assert names[:3] == ("splatting/gaussians", "learned/attention", "learned/srn")
    assert sorted(names) == sorted(methods())
    assert optional == set(methods()) - {"splatting/gaussians"}
    assert expand(["mine.toml"]) == (("mine.toml",), frozenset())
    with pytest.raises(InputError, match=r"No method matches 'imaginary/\*'"):
        expand(["imaginary/*"])


def test_a_pattern_leaves_out_what_does_not_go_with_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = toy_scene(views=2, size=8)
    monkeypatch.setattr(comparing, "open_with_progress", lambda *_: scene)

    def build(method: object, *_: object) -> None:
        if getattr(method, "name", "") == "splatting/gaussians-mip":
            raise NotComposableError("It needs more views.")

    monkeypatch.setattr(comparing, "build_model", build)
    named = ("splatting/gaussians", "splatting/gaussians-mip", "volumetric/hash")
    request = CompareRequest(
        scene="toy",
        methods=named,
        optional=frozenset(named[:2]),
        requested="splatting/*",
        out=str(tmp_path),
        overrides=("batches.opaque=false",),
    )
    kept, jobs, seen, refused = comparing._resolve(request)
    assert all(isinstance(one, Scene) for one in seen)
    assert kept.methods == ("splatting/gaussians", "volumetric/hash")
    assert [job.request.method for job in jobs] == list(kept.methods)
    assert refused == [Refusal(method="splatting/gaussians-mip", reason="It needs more views.")]
    assert "--methods 'splatting/*'" in kept.shell()
    monkeypatch.setattr(comparing, "build_model", lambda method, *_: build(type("M", (), {"name": "splatting/gaussians-mip"})))
    with pytest.raises(InputError, match="None of the methods goes with the scene"):
        comparing._resolve(CompareRequest(scene="toy", methods=named[:2], optional=frozenset(named), out=str(tmp_path)))


def test_a_key_that_only_some_methods_have_refuses_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparing, "open_with_progress", lambda *_: toy_scene(views=2, size=8))
    monkeypatch.setattr(comparing, "build_model", lambda *_: None)
    names = ("learned/srn", "volumetric/nerf")
    request = CompareRequest(
        scene="toy", methods=names, optional=frozenset(names), out=str(tmp_path), overrides=("renderer.steps=5",)
    )
    kept, _, _, refused = comparing._resolve(request)
    assert kept.methods == ("learned/srn",)
    assert refused[0].method == "volumetric/nerf"
    assert "steps" in refused[0].reason
    with pytest.raises(InputError, match="steps"):
        comparing._resolve(CompareRequest(scene="toy", methods=names, out=str(tmp_path), overrides=("renderer.steps=5",)))


@pytest.mark.parametrize(
    ("methods", "overrides", "points", "start"),
    [
        (("splatting/gaussians", "volumetric/hash"), (), EXACT_POINTS, "sfm"),
        (("splatting/gaussians", "volumetric/hash"), ("data.init=scene",), EXACT_POINTS, "scene"),
        (("volumetric/nerf", "volumetric/hash"), (), EXACT_POINTS, "scene"),  # which have no use for points
        (("volumetric/hash",), ("renderer.sampler.points_until=0.1",), EXACT_POINTS, "sfm"),
        (("splatting/gaussians", "volumetric/hash"), (), "4,096 from SfM", "scene"),
    ],
)
def test_methods_are_compared_from_a_start_that_all_could_have(
    methods: tuple[str, ...],
    overrides: tuple[str, ...],
    points: str,
    start: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = replace(toy_scene(views=2, size=8), notes={"points": points})
    monkeypatch.setattr(comparing, "open_with_progress", lambda *_: scene)
    request = CompareRequest(scene="toy", methods=methods, out=str(tmp_path), overrides=overrides, seeds=(0, 1))
    request, jobs, _, _ = comparing._resolve(request)
    assert {job.data.init for job in jobs} == {Job.of(fit).data.init for fit in request.fits()} == {start}
    assert ("--set data.init=" in request.shell()) == (start == "sfm" or bool(overrides))


@pytest.mark.parametrize(
    ("known", "alpha", "space", "overrides", "start"),
    [
        (False, False, "contracted", (), "sfm"),
        (False, False, "contracted", ("data.init=random",), "random"),
        (True, False, "contracted", (), "scene"),
        (False, True, "contracted", (), "scene"),
        (False, False, "box", (), "scene"),
    ],
)
def test_photographs_of_an_open_space_without_points_are_searched_for_some(
    known: bool,
    alpha: bool,
    space: Literal["box", "contracted"],
    overrides: tuple[str, ...],
    start: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = toy_scene(views=2, size=8, space=space)
    train = tuple(view if alpha else replace(view, alpha=None) for view in scene.train)
    scene = replace(scene, train=train, points=scene.points if known else None)
    monkeypatch.setattr(comparing, "open_with_progress", lambda *_: scene)
    monkeypatch.setattr(comparing, "degrade", lambda scene, *_: scene)
    request = CompareRequest(scene="toy", methods=("volumetric/hash",), out=str(tmp_path), overrides=overrides)
    request, jobs, _, _ = comparing._resolve(request)
    assert {job.data.init for job in jobs} == {Job.of(fit).data.init for fit in request.fits()} == {start}


def test_cells_are_those_of_the_table_of_recipes() -> None:
    job = Job.of(CompareRequest(scene="toy", methods=("volumetric/hash",), out="x").fits()[0])
    _, _, cells = recipe_matrix()
    assert "volumetric/hash" in cells[comparing.cell_of(job.method.table)]
