"""From the command to the files: fits that choose their poses, their scores, and photographs that are located in them."""

import json
import math
import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image

from invgraphics.cli.main import run as command
from invgraphics.core.transforms import apply_similarity, look_at
from invgraphics.experiments.evaluate import display
from invgraphics.experiments.fitted import open_fitted
from invgraphics.metrics.poses import Similarity, rotation_angle
from invgraphics.training.poses import motion_about

SMALL = [
    *("--set", "field.count=300", "--set", "field.max_init=300", "--set", "field.sh_degree=1"),
    *("--test-views", "2"),
]


@pytest.fixture(scope="module")
def run(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fit of the toy scene with given poses."""
    out = tmp_path_factory.mktemp("located") / "run"
    assert command(["fit", "splatting/gaussians", str(toy_folder), "--budget", "150steps", "--out", str(out), *SMALL]) == 0
    return out


def test_refined_poses_are_scored_and_shown(toy_folder: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "run"
    chosen = ["--optimise", "poses", "--set", "data.pose_noise=3", "--set", "training.poses.test_steps=5"]
    budget = ["--budget", "40steps", "--out", str(out)]
    assert command(["fit", "splatting/gaussians", str(toy_folder), *budget, *chosen, *SMALL]) == 0
    scores = json.loads((out / "scores.json").read_text())
    assert scores["test_poses"].endswith("refined for 5 steps to each test photograph")
    assert scores["test_poses"] in capsys.readouterr().out
    for name, unit in (("pose_rotation_deg", "deg"), ("pose_translation_percent", "%")):
        quality = scores["quality"][name]
        assert not quality["higher_is_better"]
        assert quality["unit"] == unit
        assert 0 < quality["mean"] <= quality["max"] < 30
        assert len(quality["per_training_view"]) == 12
    # Scored again from the checkpoint: the same numbers.
    assert command(["evaluate", str(out)]) == 0
    again = json.loads((out / "scores.json").read_text())
    assert again["quality"] == scores["quality"]


def test_a_photograph_is_found(run: Path, tmp_path: Path, capsys) -> None:
    """What the fit shows some way off a training view, which has to be found among all; and then the way back."""
    fitted = open_fitted(run)
    start = fitted.scene.train[3].camera
    truth = start.moved(start.cam_to_world @ motion_about(torch.tensor([0.1, -0.08, 0.05, 0.1, 0.1, 0.2]), torch.tensor(3.0)))
    picture = fitted.model.render(truth, normals=False)
    photo, out = tmp_path / "photo.png", tmp_path / "found.json"
    Image.fromarray(display(picture.over(fitted.scene.background), fitted.scene).numpy()).save(photo)
    assert command(["locate", str(run), str(photo), "--out", str(out), "--steps", "240", "--starts", "2"]) == 0
    found = json.loads(out.read_text())
    assert found["starts"][0]["start"] == 3
    assert found["loss"] < 0.1 * found["starts"][0]["loss_at_start"]
    pose = torch.tensor(found["cam_to_world"])
    expected = apply_similarity(fitted.scene.world_from_local, truth.cam_to_world)
    assert float(rotation_angle(pose[:3, :3], expected[:3, :3])) < 2
    assert float((pose[:3, 3] - expected[:3, 3]).norm()) < 0.15
    with Image.open(out.with_suffix(".png")) as sheet:
        assert sheet.size == (3 * 24 + 8, 24)
    assert "error" not in found
    assert f"{found['loss']:.6f}" in capsys.readouterr().out


def test_the_error_of_a_test_view_is_told(run: Path, toy_folder: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "found.json"
    photo = toy_folder / "test" / "r_0.png"
    assert command(["locate", str(run), str(photo), "--out", str(out), "--steps", "3", "--start", "random"]) == 0
    found = json.loads(out.read_text())
    truth = torch.tensor(json.loads((toy_folder / "transforms_test.json").read_text())["frames"][0]["transform_matrix"])
    forward = -truth[:3, 2] @ torch.tensor(found["cam_to_world"])[:3, 2]
    assert found["error"]["rotation_deg"] >= math.degrees(math.acos(min(float(forward), 1.0))) - 1e-2
    assert f"test view '{found['test_view']}'" in capsys.readouterr().out


def test_a_photograph_with_another_shape_and_lens(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    wide = tmp_path / "wide.png"
    with Image.open(toy_folder / "test" / "r_0.png") as image:
        canvas = Image.new("RGBA", (60, 48))
        canvas.paste(image.resize((48, 48)), (6, 0))
        canvas.save(wide)
    fov = math.degrees(2 * math.atan(0.5 * 60 / (1.3 * 48)))
    for name, more, size in (("cropped", [], [24, 24]), ("own", ["--fov", f"{fov}"], [24, 19])):
        out = tmp_path / f"{name}.json"
        assert command(["locate", str(run), str(wide), "--out", str(out), "--steps", "3", "--near", "0", *more]) == 0
        found = json.loads(out.read_text())
        assert found["size"] == size
        assert found["focal"][0] == pytest.approx(1.3 * 24 * (1 if name == "cropped" else 48 / 60), rel=2e-2)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--near", "99"], "training view '99'"),
        (["--fov", "200"], "--fov"),
        (["--starts", "0"], "--starts"),
        (["--out", "/dev/null/x.json"], "folder"),
        (["--out", "x.png"], ".json"),
    ],
)
def test_wrong_use_gets_a_sentence(arguments: list[str], said: str, run: Path, toy_folder: Path, capsys) -> None:
    photo = toy_folder / "test" / "r_0.png"
    assert command(["locate", str(run), str(photo), *arguments]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("out", ["photo.json", "photo.png"])
def test_the_photograph_is_not_overwritten(out: str, run: Path, toy_folder: Path, tmp_path: Path, capsys) -> None:
    """The pictures lie beside the result, under its name."""
    photo = Path(shutil.copy(toy_folder / "test" / "r_0.png", tmp_path / "photo.png"))
    before = photo.read_bytes()
    assert command(["locate", str(run), str(photo), "--out", str(tmp_path / out)]) == 2
    assert "cannot be" in capsys.readouterr().err and photo.read_bytes() == before


def test_unreadable_photographs_and_no_runs(run: Path, tmp_path: Path, capsys) -> None:
    text = tmp_path / "note.png"
    text.write_text("no picture")
    for folder, photo, said in (
        (run, text, "note.png"),
        (run, tmp_path / "none.png", "does not exist"),
        (tmp_path, text, "run"),
    ):
        assert command(["locate", str(folder), str(photo), "--out", str(tmp_path / "x.json")]) == 2
        assert said in capsys.readouterr().err


def test_only_poses_can_be_optimised(capsys) -> None:
    assert command(["fit", "splatting/gaussians", "textured", "--optimise", "lens"]) == 2
    assert "Expected: poses" in capsys.readouterr().err


def test_the_way_back_undoes_a_similarity() -> None:
    turn = look_at(*(torch.randn(3, dtype=torch.float64) for _ in range(3)))[:3, :3]
    similarity = Similarity(1.7, turn, torch.tensor([0.3, -2.0, 0.7]).double())
    points = torch.randn(5, 3, dtype=torch.float64)
    torch.testing.assert_close(similarity.inverse().points(similarity.points(points)), points)
