"""Pictures of the window are those that evaluations make, whatever way they are cut, coloured and put together."""

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import torch
from PIL import Image

from invgraphics.experiments.fitted import open_fitted
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.viewer.cameras import Gaze, Mount
from invgraphics.viewer.colouring import EMPTY, ERROR_LIMIT, resized
from invgraphics.viewer.pace import LEAST
from invgraphics.viewer.painting import Order, Painter
from invgraphics.viewer.subject import Subject, open_subject

METHODS = ("volumetric/nerf", "volumetric/hash", "splatting/gaussians")


@pytest.fixture(scope="module")
def subjects(runs: dict[str, Path]) -> dict[str, Subject]:
    return {method: Subject(open_fitted(run)) for method, run in runs.items()}


def _painted(order: Order, *subjects: Subject, pixels: float = LEAST):
    painter = Painter(subjects)
    for pace in painter.paces.values():
        pace.pixels = pixels
    pictures = []
    pieces = sum(1 for _ in painter.paint(order, pictures.append))
    return pictures, pieces


def _gaze(subject: Subject, index: int = 0) -> Gaze:
    camera = subject.scene.test[index].camera
    return Gaze(camera.cam_to_world, 0.7, 1.6)


def _composited(subject: Subject, camera) -> np.ndarray:
    rendering = subject.render(camera, geometry=False)
    colour = rendering.rgb + (1 - rendering.alpha[..., None]) * subject.scene.background
    return np.floor(colour.clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8)


@pytest.mark.parametrize("method", METHODS)
def test_free_pictures_grow_and_end_with_the_renderers_own(subjects: dict[str, Subject], method: str) -> None:
    subject = subjects[method]
    gaze = _gaze(subject)
    pictures, pieces = _painted(Order(gaze, (160, 100), longest=120), subject)
    sizes = [painted.size for painted in pictures]
    assert sizes == sorted(sizes) and len(sizes) > 1 and sizes[-1] == (120, 75)
    assert [painted.finest for painted in pictures] == [False] * (len(sizes) - 1) + [True]
    assert sizes[0][0] * sizes[0][1] == pytest.approx(LEAST, rel=0.1)
    assert pieces > len(sizes) if subject.by_rays else pieces == len(sizes), "only pictures by rays come in strips"
    expected = _composited(subject, gaze.camera(120, 75))
    assert np.abs(pictures[-1].picture.astype(int) - expected).max() <= 1
    assert expected.std() > 10


@pytest.mark.parametrize("method", METHODS)
def test_at_a_photograph_the_picture_is_the_one_that_was_scored(
    subjects: dict[str, Subject], runs: dict[str, Path], method: str
) -> None:
    subject, run = subjects[method], runs[method]
    for index in (0, 1):
        view = subject.scene.test[index]
        order = Order(_gaze(subject, index), (160, 100), view=view)
        painted = _painted(order, subject)[0][-1]
        mount = Mount.of(view.camera, 1.6)
        rows, columns = slice(mount.top, mount.top + 32), slice(mount.left, mount.left + 32)
        saved = np.asarray(Image.open(run / "test" / f"{index:04d}.png"))
        assert np.abs(painted.picture[rows, columns].astype(int) - saved).max() <= 1
        around = painted.picture.copy()
        around[rows, columns] = EMPTY
        assert (around == EMPTY).all()
        scores = json.loads((run / "scores.json").read_text())["quality"]["psnr"]["per_view"]
        assert painted.psnr == pytest.approx((scores[index],), abs=0.01)


def test_truth_is_the_photograph_and_error_its_difference(subjects: dict[str, Subject], runs: dict[str, Path]) -> None:
    subject = subjects["volumetric/hash"]
    view = subject.scene.test[0]
    order = Order(replace(_gaze(subject), aspect=1.0), (100, 100), shown="truth", view=view)
    (truth,), pieces = _painted(order, subject)
    assert pieces == 0 and truth.finest
    folder = runs["volumetric/hash"]
    saved = folder / json.loads((folder / "provenance.json").read_text())["truth"] / "0000.png"
    expected = np.asarray(Image.open(saved))
    np.testing.assert_array_equal(truth.picture, expected)

    error = _painted(replace(order, shown="error"), subject)[0][-1]
    prediction = np.asarray(Image.open(folder / "test" / "0000.png"))
    difference = np.abs(prediction.astype(float) - expected).mean(axis=-1) / 255 / ERROR_LIMIT
    drawn = mpl.colormaps["magma"](difference.clip(0, 1))[..., :3] * 255
    assert np.abs(error.picture - drawn).mean() < 1.5
    assert str(ERROR_LIMIT) in error.legend


@pytest.mark.parametrize("method", METHODS)
def test_depth_and_normals(subjects: dict[str, Subject], method: str) -> None:
    subject = subjects[method]
    order = Order(_gaze(subject), (64, 40), shown="depth", longest=64, resting=True)
    ((depth,), _), ((normal,), _) = _painted(order, subject), _painted(replace(order, shown="normal"), subject)
    rendering = subject.render(order.gaze.camera(64, 40), geometry=True)
    solid = (rendering.alpha >= 0.5).numpy()
    assert solid.any() and not solid.all()
    assert (depth.picture[~solid] == EMPTY).all() and (normal.picture[~solid] == EMPTY).all()
    nearest, farthest = rendering.depth[torch.from_numpy(solid)].quantile(torch.tensor([0.01, 0.99])).tolist()
    assert f"{nearest:.3g} (bright) to {farthest:.3g} (dark)" in depth.legend
    at = rendering.depth.masked_fill(~torch.from_numpy(solid), torch.inf).argmin()
    assert depth.picture.reshape(-1, 3)[at].tolist() == [253, 231, 37], "viridis ends in yellow"
    expected = (rendering.normal.numpy()[solid] + 1) / 2 * 255
    assert np.abs(normal.picture[solid] - expected).max() <= 1


def test_split_shows_one_run_left_of_the_line_and_the_other_right(subjects: dict[str, Subject]) -> None:
    pair = subjects["volumetric/hash"], subjects["splatting/gaussians"]
    order = Order(_gaze(pair[0]), (80, 50), longest=80, layout="split", share=0.3)
    split = _painted(order, *pair)[0][-1].picture
    left, right = (_painted(replace(order, layout=which), *pair)[0][-1].picture for which in ("first", "second"))
    assert np.abs(split[:, :23].astype(int) - left[:, :23]).max() <= 1
    assert np.abs(split[:, 24:].astype(int) - right[:, 24:]).max() <= 1
    assert (split[:, 23] == EMPTY).all()
    for share, alone in ((0.0, right), (1.0, left)):
        whole = _painted(replace(order, share=share), *pair)[0][-1].picture
        assert np.abs(whole.astype(int) - alone).max() <= 1
    assert (left != right).any()


def test_split_at_a_photograph_is_where_the_window_says(subjects: dict[str, Subject]) -> None:
    pair = subjects["volumetric/hash"], subjects["splatting/gaussians"]
    order = Order(_gaze(pair[0]), (80, 50), view=pair[0].scene.test[0], layout="split", share=0.5)
    split = _painted(order, *pair)[0][-1]
    left, right = (_painted(replace(order, layout=which), *pair)[0][-1] for which in ("first", "second"))
    middle = split.picture.shape[1] // 2
    assert np.abs(split.picture[:, : middle - 1].astype(int) - left.picture[:, : middle - 1]).max() <= 1
    assert np.abs(split.picture[:, middle + 1 :].astype(int) - right.picture[:, middle + 1 :]).max() <= 1
    assert split.psnr == () and len(left.psnr) == len(right.psnr) == 1


def test_side_by_side_shows_both_whole(subjects: dict[str, Subject]) -> None:
    pair = subjects["volumetric/hash"], subjects["splatting/gaussians"]
    order = Order(_gaze(pair[0]), (80, 50), longest=80, layout="side by side")
    both = _painted(order, *pair)[0][-1]
    assert both.picture.shape == (50, 80, 3)
    half = replace(order.gaze, aspect=0.8).camera(40, 50)
    for one, columns in zip(pair, (slice(0, 39), slice(40, 80)), strict=True):
        whole = slice(0, 39) if columns.start == 0 else slice(0, 40)
        assert np.abs(both.picture[:, columns].astype(int) - _composited(one, half)[:, whole]).max() <= 1
    at_view = _painted(replace(order, view=pair[0].scene.test[0]), *pair)[0][-1]
    assert len(at_view.psnr) == 2


class Slow(Subject):
    """A run whose every piece takes long."""

    def render(self, camera, geometry):
        time.sleep(0.05)
        return super().render(camera, geometry)


@pytest.mark.parametrize("layout", ["split", "side by side"])
def test_each_side_refines_by_itself(subjects: dict[str, Subject], layout) -> None:
    """The fast run is as fine as it gets before the slow one is; until then its half of the window does not change."""
    slow, fast = Slow(subjects["volumetric/nerf"].fitted), subjects["splatting/gaussians"]
    order = Order(_gaze(slow), (160, 100), longest=160, layout=layout)
    pictures, _ = _painted(order, slow, fast)
    right = [resized(painted.picture, (160, 100))[:, 84:].astype(int) for painted in pictures]
    early = [index for index, seen in enumerate(right) if np.abs(seen - right[-1]).mean() < 1]
    assert not pictures[early[0]].finest and early[0] < len(pictures) - 1
    assert early == list(range(early[0], len(pictures)))
    left = [resized(painted.picture, (160, 100))[:, :76].astype(int) for painted in pictures]
    assert np.abs(left[early[0]] - left[-1]).mean() > 1, "the slow side is still coarse then"


def test_background_can_be_chosen(subjects: dict[str, Subject]) -> None:
    subject = subjects["splatting/gaussians"]
    order = Order(_gaze(subject), (64, 40), longest=64, resting=True)
    (own,), (black,) = (_painted(each, subject)[0] for each in (order, replace(order, background=(0.0, 0.0, 0.0))))
    rendering = subject.render(order.gaze.camera(64, 40), geometry=False)
    empty, premultiplied = (rendering.alpha < 1e-3).numpy(), rendering.rgb.clamp(0, 1).numpy()
    assert empty.any() and (own.picture[empty] > 250).all() and (black.picture[empty] < 5).all()
    assert np.abs(black.picture - premultiplied * 255).max() <= 1


def test_a_second_run_in_another_frame_shows_the_same_place(subjects: dict[str, Subject]) -> None:
    """The same fit in a frame that is turned, moved and three times as large."""
    first = subjects["volumetric/hash"]
    similarity = torch.tensor([[0.0, -3, 0, 1], [3, 0, 0, 2], [0, 0, 3, -1], [0, 0, 0, 1.0]])
    other = Subject(replace(first.fitted, scene=replace(first.scene, world_from_local=similarity)))
    camera = first.scene.test[0].camera
    placed = other.placed(camera, first.scene)
    points = torch.rand(20, 3) - 0.5
    in_other = (points - similarity[:3, 3]) @ torch.linalg.inv(similarity[:3, :3]).T
    torch.testing.assert_close(placed.project(in_other)[0], camera.project(points)[0], atol=1e-3, rtol=0)
    assert first.placed(camera, first.scene) is camera


def test_a_newer_checkpoint_is_noticed_and_shown(runs: dict[str, Path], tmp_path: Path) -> None:
    run = Path(shutil.copytree(runs["splatting/gaussians"], tmp_path / "run"))
    subject = open_subject(run, None, live=True, say=print)
    assert not subject.changed() and subject.steps == 60 and "PSNR" in subject.facts()["test views"]
    before = _composited(subject, subject.scene.test[0].camera)
    state = checkpoint.load(run / CHECKPOINT)
    keep = len(state["field"]["means"]) // 2  # density control changes the number
    for name, values in state["field"].items():
        state["field"][name] = values[:keep] if values.ndim else values
    checkpoint.save(run / CHECKPOINT, state)
    (run / "fit.json").write_text('{"steps": 120, "seconds": 9.5}')
    assert subject.changed()
    subject.refresh()
    assert not subject.changed() and subject.facts()["fit"] == "step 120, 9.5 s"
    assert subject.facts()["primitives"] == f"{keep:,}"
    assert (_composited(subject, subject.scene.test[0].camera) != before).any()
    (run / "scores.json").unlink()
    assert subject.changed()
    subject.refresh()
    assert subject.facts()["test views"] == "not scored yet" and not subject.changed()
    (run / CHECKPOINT).unlink()
    assert not subject.changed(), "a fit that starts again removes the file first"
