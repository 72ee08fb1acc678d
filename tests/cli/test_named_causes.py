"""Messages name what was mistaken for what, and the way out."""

from pathlib import Path

import pytest

import invgraphics as ig
from invgraphics.cli import main
from invgraphics.scenes.open import DATA


def _said(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main.run(words) == main.BAD_INPUT
    return capsys.readouterr().err


def test_a_scene_in_the_place_of_a_method_and_the_reverse(capsys: pytest.CaptureFixture[str]) -> None:
    assert "'bricks' is a scene; the order is `fit METHOD SCENE`." in _said(["fit", "bricks", "volumetric/hash"], capsys)
    with pytest.raises(ig.InputError, match="'volumetric/hash' is a method; the order is"):
        ig.load_scene("volumetric/hash")


def test_a_real_capture_by_part_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("nerf_synthetic_mic", "other"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv(DATA, str(tmp_path))
    assert "Did you mean '$INVGRAPHICS_DATA/nerf_synthetic_mic'?" in _said(["fit", "volumetric/hash", "mic"], capsys)
    said = _said(["fit", "volumetric/hash", "$INVGRAPHICS_DATA/mic"], capsys)
    assert "mic is not in $INVGRAPHICS_DATA.\nIt holds nerf_synthetic_mic, other." in said
    monkeypatch.delenv(DATA)
    assert "Real captures: '$INVGRAPHICS_DATA/NAME'" in _said(["fit", "volumetric/hash", "mic"], capsys)
    assert "Set the variable to the folder" in _said(["fit", "volumetric/hash", "$INVGRAPHICS_DATA/mic"], capsys)


def test_a_parameter_group_that_the_recipe_lacks() -> None:
    with pytest.raises(
        ig.InputError, match=r"has no parameter group 'tabel'. Did you mean 'table'?.*\nIts groups: field, table"
    ):
        ig.load_method("volumetric/hash", set={"optimiser.groups.tabel.lr": 0.1})
    new = {"optimiser.groups.first.lr": 0.1, "optimiser.groups.first.match": "field.geometry"}
    assert "first" in ig.load_method("volumetric/hash", set=new).table["optimiser"]["groups"]


def test_a_key_of_one_method_among_several(toy_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["compare", str(toy_folder), "--methods", "volumetric/hash,splatting/gaussians", "--set", "field.dropout=0.2"]
    assert "--methods METHOD:KEY=VALUE,OTHER" in _said(words, capsys)


def test_help_of_a_command_by_either_word(capsys: pytest.CaptureFixture[str]) -> None:
    shown = []
    for words in (["help", "doctor"], ["doctor", "--help"]):
        with pytest.raises(SystemExit):
            main.run(words)
        shown.append(capsys.readouterr().out)
    assert shown[0] == shown[1] and "usage: invgraphics doctor" in shown[0]


def test_a_budget_that_is_spent_has_nothing_to_resume(toy_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    method = ig.load_method("splatting/gaussians", set={"field.count": 50})
    fit = ig.fit(method, str(toy_folder), "5steps")
    assert fit.steps == 5 and fit.seconds > 0
    capsys.readouterr()
    fit.resume("3steps")
    assert "Nothing to resume: 5 steps" in capsys.readouterr().err
    fit.resume("7steps")
    assert fit.steps == 7 and "Nothing to resume" not in capsys.readouterr().err


def test_lists_of_a_kind_tell_what_its_members_mean(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["list", "metrics", "scenes"]) == 0
    text = capsys.readouterr().out
    assert "structural similarity: Gaussian 11x11 window" in text
    mugs = next(line for line in text.splitlines() if line.strip().startswith("mugs"))
    assert "64x64" in mugs and "16, 8 of 144 objects" in mugs
    assert "'bricks'. It is a scene: `invgraphics list scenes`." in _said(["list", "bricks"], capsys)


def test_commas_are_no_remedy_where_there_is_one_method(capsys: pytest.CaptureFixture[str]) -> None:
    said = _said(["fit", "volumetric/hash", "bricks", "splatting/gaussians"], capsys)
    assert "Unrecognized options: splatting/gaussians" in said and "--methods" not in said


def test_a_comparison_does_not_replace_a_published_report(
    toy_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "index.html").write_text("")
    words = ["compare", str(toy_folder), "--methods", "splatting/gaussians", "--budget", "1steps", "--out", str(tmp_path)]
    assert "holds a published report, which would be replaced.\nChoose another --out." in _said(words, capsys)
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["index.html"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["fit", "splatting/gaussians", "bricks", "--max-primitives", "abc"],
            "parsing --max-primitives: 'abc' is not a whole number",
        ),
        (["fit", "splatting/gaussians", "bricks", "--seed", "x"], "parsing --seed: 'x' is not a whole number"),
        (
            ["compare", "bricks", "--methods", "volumetric/hash", "splatting/gaussians"],
            "have commas between them: --methods A,B.",
        ),
        (
            ["fit", "volumetric/hash", "bricks", "--set", "renderer.sampler=even"],
            "renderer.sampler.type names one of the samplers: ",
        ),
    ],
)
def test_values_that_cannot_be_read(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    said = _said(words, capsys)
    assert sentence in said and "NoneType" not in said


def test_a_view_in_the_place_of_its_camera(scene: ig.Scene) -> None:
    model = ig.Model(
        ig.testing.TwoBalls(),
        ig.renderers.volumetric.VolumetricConfig(ig.renderers.samplers.StratifiedConfig(8)).build(scene),
        scene.bounds,
    )
    with pytest.raises(ig.InputError, match=r"A View is no camera.\nThat of a view is view.camera."):
        model.render(scene.test[0])  # pyright: ignore[reportArgumentType]
