"""Methods as tables in `import invgraphics as ig`: where their recipes are kept, and values that are set in them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import invgraphics as ig
from invgraphics.data import find
from invgraphics.errors import InputError
from invgraphics.scenes.npz_writer import save_npz
from invgraphics.studies.factors import override
from invgraphics.tables import parse_toml
from invgraphics.testing import toy_scene

pytestmark = pytest.mark.usefixtures("unpainted")

SPLATS = ig.load_method("splatting/gaussians", set={"field.count": 60, "field.max_init": 60, "field.sh_degree": 0})
ONE, TWO = ({**SPLATS.table, "batches": {"views": views}} for views in (1, 2))


@pytest.fixture(autouse=True)
def _toy_beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_npz(toy_scene(views=8, size=16), tmp_path / "toy.npz")
    monkeypatch.chdir(tmp_path)


def _check_named_recipe(run: Path, views: int) -> None:
    """The method that a run's provenance names loads, and to the recipe that was fitted."""
    provenance = json.loads((run / "provenance.json").read_text())
    method = ig.load_method(provenance["method"])
    assert method.recipe.batches.views == views and method.digest == provenance["recipe_sha256"]
    assert provenance["command"].startswith(f"invgraphics fit {provenance['method']} ")


def test_a_refused_fit_leaves_the_finished_run_as_it_is() -> None:
    kept = ig.fit(ONE, "toy.npz", "2steps", out="run")
    before = {path: path.read_bytes() for path in Path("run").rglob("*") if path.is_file()}
    for method in (TWO, {**ONE, "batches": {"veiws": 1}}):
        with pytest.raises(InputError, match=r"holds another run|Unknown key"):
            ig.fit(method, "toy.npz", "2steps", out="run")
    assert before == {path: path.read_bytes() for path in Path("run").rglob("*") if path.is_file()}
    _check_named_recipe(Path("run"), 1)
    seen = []
    again = ig.fit(ONE, "toy.npz", "2steps", out="run", on_step=seen.append)
    assert not seen and again.scores["psnr"] == kept.scores["psnr"]


def test_a_comparison_keeps_each_table_under_its_own_name(in_process) -> None:
    (first,) = ig.compare("toy.npz", [ONE], "2steps", out="report").methods
    report = ig.compare("toy.npz", [TWO, ONE], "2steps", out="report")
    assert report.methods[1] == first != report.methods[0]  # at another place of the list the same method, whose run is kept
    for method, views in zip(report.methods, (2, 1), strict=True):
        _check_named_recipe(report._run_folder(method, 0), views)
    with pytest.raises(InputError, match="named twice"):
        ig.compare("toy.npz", [ONE, dict(reversed(ONE.items()))], "2steps", out="report")


def test_lists_of_tables_and_numpys_values_can_be_set() -> None:
    """The name that comes of it makes the same method again, here and in the processes of a comparison."""
    losses = [{"type": "photometric", "weight": 0.5}, {"type": "opacity", "weight": np.float32(0.25)}]
    values = {"losses": losses, "field.width": np.int64(64), "batches.rays": torch.tensor(32), "field.encoding.type": "hash"}
    method = ig.load_method("volumetric/hash", set=values)
    assert [loss["weight"] for loss in method.table["losses"]] == [0.5, 0.25]
    assert (method.recipe.field.width, method.recipe.batches.rays) == (64, 32)
    assert ig.load_method(method.name).digest == method.digest
    with pytest.raises(InputError, match=r"'field\.width' cannot be set to None: TOML has no NoneType"):
        ig.load_method("volumetric/hash", set={"field.width": None})
    table = {**SPLATS.table, "batches": {"views": np.int64(2)}}
    assert ig.fit(table, "toy.npz", "1steps").method.recipe.batches.views == 2
    with pytest.raises(InputError, match="The table is no recipe: TOML has no NoneType"):
        ig.fit({**table, "summary": None}, "toy.npz", "1steps")


@pytest.mark.parametrize(
    "value",
    [
        3,
        -0.5,
        1e-7,
        float("inf"),
        True,
        'a "b"\n\x7f\\é',
        [],
        [1, [2, 3]],
        {},
        [{"a": 1, "b c": [{"d": {}}]}, {}],
        {"x": {"y": "="}},
    ],
)
def test_values_on_one_line_of_toml_read_as_they_were(value: object) -> None:
    text = override("a", value).removeprefix("a=")
    assert "\n" not in text and parse_toml(f"value = {text}", "it")["value"] == value


def test_a_recipe_s_table_is_a_method() -> None:
    table = parse_toml((find("renderers") / "volumetric" / "hash.toml").read_text(), "the recipe")
    ours, named = (ig.load_method(what, preset="long", set={"field.width": 32}) for what in (table, "volumetric/hash"))
    assert (ours.digest, ours.preset) == (named.digest, "long") and "presets" in table
    with pytest.raises(InputError, match="A method's name has one line"):
        ig.load_method('summary = "Mine"\npaper = "none"\n')


def test_wrong_kinds_of_arguments_are_sentences() -> None:
    for call, sentence in (
        (lambda: ig.fit(ONE, "toy.npz", 20), "'20' is not a budget"),
        (lambda: ig.load_method("volumetric/hash", set="field.width=64"), "'set' cannot be 'field.width=64'"),
        (lambda: ig.load_method("voxels"), "There is no method 'voxels'"),
    ):
        with pytest.raises(InputError, match=sentence):
            call()
    every, few = ig.load_scene("toy.npz", test_views="all"), ig.load_scene("toy.npz", test_views=1)
    assert len(every.test) > len(few.test) == 1
    assert ig.fit(ONE, few, "1steps", device=torch.device("cpu")).scores["psnr"] > 0


def test_another_copy_of_a_run_s_scene_is_the_same_scene(tmp_path: Path) -> None:
    run = ig.fit(ONE, "toy.npz", "1steps", out="kept-with-its-scene")
    assert ig.load_run("kept-with-its-scene", scene="toy.npz").scores["psnr"] == run.scores["psnr"]
    other = ig.save_scene(toy_scene(views=6, size=12), tmp_path / "other.npz")
    with pytest.raises(InputError, match="are not those that kept-with-its-scene was fitted beside"):
        ig.load_run("kept-with-its-scene", scene=str(other))
    # Nor is a run shown on what has taken its scene's place.
    mine = ig.save_scene(toy_scene(views=8, size=14), tmp_path / "mine.npz")
    ig.fit(ONE, str(mine), "1steps", out="fitted")
    other.replace(mine)
    with pytest.raises(InputError, match="are not those that fitted was fitted beside"):
        ig.load_run("fitted")
