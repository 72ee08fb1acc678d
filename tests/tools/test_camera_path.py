"""Camera paths: smooth through their keyframes, the same camera in every local frame, and films of the files."""

import json
import math
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from training_fixtures import SMALL

from invgraphics.cli import main
from invgraphics.core.transforms import look_at
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import display
from invgraphics.experiments.fitted import open_fitted
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.testing import toy_scene
from invgraphics.tools.camera_path import CameraPath, Keyframe, pinhole, read_camera_path, with_keyframe, without

METHOD = "splatting/gaussians"
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def _circle(turns: list[float], fovs: list[float], radius: float = 3.0) -> tuple[Keyframe, ...]:
    """Keyframes on a circle at fractions of a turn that look at its middle."""
    frames = []
    for turn, fov in zip(turns, fovs, strict=True):
        eye = radius * torch.tensor([math.cos(2 * math.pi * turn), math.sin(2 * math.pi * turn), 0.3], dtype=torch.float64)
        frames.append(Keyframe(look_at(eye, torch.zeros(3, dtype=torch.float64), UP), fov))
    return tuple(frames)


def test_a_path_goes_through_its_keyframes_at_even_times() -> None:
    path = CameraPath(_circle([0, 0.1, 0.3, 0.35], [0.5, 0.9, 0.9, 0.4]), seconds=1.5)
    assert path.duration == 4.5
    for keyframe, found in zip(path.keyframes, path.at(np.array([0, 1.5, 3.0, 4.5])), strict=True):
        torch.testing.assert_close(found.pose, keyframe.pose, atol=1e-9, rtol=0)
        assert found.fov == pytest.approx(keyframe.fov)
    between = path.at(np.linspace(0, 4.5, 200))
    assert all(0.4 - 1e-9 <= one.fov <= 0.9 + 1e-9 for one in between), "no zoom beyond the keyframes'"
    for one in between:
        torch.testing.assert_close(one.pose[:3, :3] @ one.pose[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-9, rtol=0)


def _accelerations(path: CameraPath, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Second differences of positions and viewing directions."""
    poses = torch.stack([one.pose for one in path.at(times)]).numpy()
    return np.diff(poses[:, :3, 3], 2, axis=0), np.diff(poses[:, :3, 2], 2, axis=0)


@pytest.mark.parametrize("loop", [False, True])
def test_a_path_has_no_jerks_at_keyframes_nor_at_a_loops_seam(loop: bool) -> None:
    path = CameraPath(_circle([0, 0.2, 0.4, 0.6, 0.8], [0.8] * 5), seconds=1.0, loop=loop)
    step = 0.01
    times = np.arange(0, path.duration, step)
    if loop:
        times = np.mod(np.arange(0, path.duration + 0.5, step), path.duration)  # across the seam
    # A broken line turns within one step at a keyframe: its second difference there is a whole step long.
    for second, length in zip(_accelerations(path, times), (2 * math.pi * 3 / 5, 2 * math.pi / 5), strict=True):
        assert np.linalg.norm(second, axis=1).max() < 0.05 * length * step
    if loop:
        radius = torch.stack([one.pose[:2, 3].norm() for one in path.at(times)])
        assert float((radius - 3).abs().max()) < 0.05, "five keyframes of a circle are nearly the circle"


def test_one_keyframe_stands_still_and_equal_ones_do_not_break() -> None:
    (only,) = _circle([0.0], [0.7])
    assert CameraPath((only,)).duration == 0 and CameraPath((only,)).frame_count(15) == 1
    assert [one.fov for one in CameraPath((only,)).at(np.zeros(3))] == [0.7] * 3
    for found in CameraPath((only, only), loop=True).at(np.linspace(0, 4, 9)):
        torch.testing.assert_close(found.pose, only.pose, atol=1e-12, rtol=0)


def test_inserting_and_deleting() -> None:
    a, b, c = _circle([0.0, 0.1, 0.2], [0.7] * 3)
    path = with_keyframe(with_keyframe(CameraPath((a,)), c), b, after=0)
    assert path.keyframes == (a, b, c)
    assert without(path, 1).keyframes == (a, c)


def test_a_file_shows_the_same_camera_in_another_local_frame(tmp_path: Path) -> None:
    first = toy_scene(views=4, size=16)
    similarity = torch.tensor([[0.0, -3, 0, 1], [3, 0, 0, 2], [0, 0, 3, -1], [0, 0, 0, 1.0]])
    other = replace(first, world_from_local=similarity)
    pose = first.test[0].camera.cam_to_world
    CameraPath((Keyframe.from_local(pose, 0.8, first),), seconds=0.5, loop=True).write(tmp_path / "path.json")
    path = read_camera_path(tmp_path / "path.json")
    assert (path.seconds, path.loop) == (0.5, True)
    points = torch.rand(20, 3) - 0.5
    in_other = (points - similarity[:3, 3]) @ torch.linalg.inv(similarity[:3, :3]).T
    camera, moved = (pinhole(path.keyframes[0], scene, 64, 48) for scene in (first, other))
    torch.testing.assert_close(camera.cam_to_world, pose, atol=1e-6, rtol=0)
    torch.testing.assert_close(moved.project(in_other)[0], camera.project(points)[0], atol=1e-3, rtol=0)
    assert camera.focal.tolist() == pytest.approx([24 / math.tan(0.4)] * 2)


GOOD = json.loads(CameraPath(_circle([0, 0.2], [0.8, 0.8])).to_json())


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"kind": "something"}, 'has no "kind": "camera path"'),
        ({"schema": 2}, "has schema 2; this version reads 1"),
        ({"keyframes": []}, "has no keyframes"),
        ({"keyframes": [{"fov_degrees": 40}]}, "has no 4 x 4 camera_to_world at keyframe 0"),
        ({"keyframes": [GOOD["keyframes"][0] | {"fov_degrees": 180}]}, "has fov_degrees 180 at keyframe 0"),
        (
            {"keyframes": [GOOD["keyframes"][0] | {"camera_to_world": [[2.0, 0, 0, 0]] * 4}]},
            "is not a rotation and a translation",
        ),
        ({"seconds_between_keyframes": 0}, "has seconds_between_keyframes 0"),
        ({"seconds_between_keyframes": True}, "has seconds_between_keyframes True"),
        ({"loop": "yes"}, "has loop yes"),
    ],
)
def test_a_broken_file_gets_a_sentence(tmp_path: Path, change: dict, sentence: str) -> None:
    (tmp_path / "path.json").write_text(json.dumps(GOOD | change))
    with pytest.raises(InputError) as found:
        read_camera_path(tmp_path / "path.json")
    assert sentence in str(found.value)


def test_no_file_and_no_json(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_camera_path(tmp_path / "none.json")
    (tmp_path / "path.json").write_text("{")
    with pytest.raises(InputError, match="is not valid JSON"):
        read_camera_path(tmp_path / "path.json")


@pytest.fixture(scope="module")
def run(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = str(tmp_path_factory.mktemp("paths") / "run")
    request = FitRequest(
        method=METHOD,
        scene=str(toy_folder),
        out=out,
        budget="20steps",
        overrides=tuple(SMALL[METHOD]),
        checkpoint_every="5steps",
    )
    return fit_run(request)


def _film(file: Path) -> np.ndarray:
    reader = imageio_ffmpeg.read_frames(str(file))
    width, height = next(reader)["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader])


def test_the_command_films_a_saved_path(run: Path, tmp_path: Path, capsys) -> None:
    CameraPath(_circle([0, 0.1, 0.2], [0.8, 0.7, 0.9]), seconds=0.4).write(tmp_path / "path.json")
    out = tmp_path / "film.mp4"
    words = ["render", str(run), "--path", str(tmp_path / "path.json"), "--fps", "10", "--size", "96x64", "--out", str(out)]
    assert main.run(words) == main.DONE
    film = _film(out)
    assert film.shape == (9, 64, 96, 3), "0.8 s at ten pictures a second, both ends included"
    fitted, path = open_fitted(run), read_camera_path(tmp_path / "path.json")
    for keyframe, frame in zip(path.keyframes, film[[0, 4, 8]], strict=True):
        camera = pinhole(keyframe, fitted.scene, 96, 64)
        rendering = fitted.model.render(camera, normals=False)
        expected = display(rendering.over(fitted.scene.background), fitted.scene).numpy().astype(float)
        assert np.abs(frame - expected).mean() < 4 and expected.std() > 10, "but for the film's compression"
    assert "Path:" not in capsys.readouterr().err


def test_the_command_refuses_other_paths(run: Path, tmp_path: Path, capsys) -> None:
    assert main.run(["render", str(run), "--path", "round", "--out", str(tmp_path / "a.mp4")]) == main.BAD_INPUT
    assert "--path cannot be 'round'" in capsys.readouterr().err
    assert main.run(["render", str(run), "--path", "no.json", "--out", str(tmp_path / "a.mp4")]) == main.BAD_INPUT
    assert "'no.json' cannot be read" in capsys.readouterr().err
    words = ["render", str(run), "--path", "timelapse", "--show", "depth", "--out", str(tmp_path / "a.mp4")]
    assert main.run(words) == main.BAD_INPUT
    assert not (tmp_path / "a.mp4").exists()
