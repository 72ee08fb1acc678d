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
from training_fixtures import SMALL

from invgraphics.experiments.fitted import open_fitted
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.tools.colorize import EMPTY, ERROR_LIMIT, resize_image
from invgraphics.viewer.cameras import LetterboxedView, ViewerCamera
from invgraphics.viewer.loaded_run import LoadedRun, open_run
from invgraphics.viewer.overlays import CameraFrustums, Overlays
from invgraphics.viewer.progressive import LAYOUTS, ProgressiveRenderer, RenderRequest
from invgraphics.viewer.resolution import MIN_PIXELS

METHODS = ("volumetric/nerf", "volumetric/hash", "splatting/gaussians")


@pytest.fixture(scope="module")
def loaded_runs(runs: dict[str, Path]) -> dict[str, LoadedRun]:
    return {method: LoadedRun(open_fitted(run)) for method, run in runs.items()}


def _frames(request: RenderRequest, *loaded_runs: LoadedRun, pixels: float = MIN_PIXELS):
    renderer = ProgressiveRenderer(loaded_runs)
    for pace in renderer.resolutions.values():
        pace.pixels = pixels
    pictures = []
    pieces = sum(1 for _ in renderer.render(request, pictures.append))
    return pictures, pieces


def _camera(loaded: LoadedRun, index: int = 0) -> ViewerCamera:
    camera = loaded.scene.test[index].camera
    return ViewerCamera(camera.cam_to_world, 0.7, 1.6)


def _composited(loaded: LoadedRun, camera) -> np.ndarray:
    rendering = loaded.render(camera, geometry=False)
    colour = rendering.rgb + (1 - rendering.alpha[..., None]) * loaded.scene.background
    return np.floor(colour.clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8)


@pytest.mark.parametrize("method", METHODS)
def test_free_pictures_grow_and_end_with_the_renderers_own(loaded_runs: dict[str, LoadedRun], method: str) -> None:
    loaded = loaded_runs[method]
    viewer_camera = _camera(loaded)
    pictures, pieces = _frames(RenderRequest(viewer_camera, (160, 100), max_size=120), loaded)
    sizes = [frame.size for frame in pictures]
    assert sizes == sorted(sizes) and len(sizes) > 1 and sizes[-1] == (120, 75)
    assert [frame.final for frame in pictures] == [False] * (len(sizes) - 1) + [True]
    assert sizes[0][0] * sizes[0][1] == pytest.approx(MIN_PIXELS, rel=0.1)
    assert pieces > len(sizes) if loaded.independent_pixels else pieces == len(sizes), "only pictures by rays come in strips"
    expected = _composited(loaded, viewer_camera.pinhole(120, 75))
    assert np.abs(pictures[-1].image.astype(int) - expected).max() <= 1
    assert expected.std() > 10


@pytest.mark.parametrize("method", METHODS)
def test_at_a_photograph_the_picture_is_the_one_that_was_scored(
    loaded_runs: dict[str, LoadedRun], runs: dict[str, Path], method: str
) -> None:
    loaded, run = loaded_runs[method], runs[method]
    for index in (0, 1):
        view = loaded.scene.test[index]
        request = RenderRequest(_camera(loaded, index), (160, 100), view=view)
        frame = _frames(request, loaded)[0][-1]
        letterbox = LetterboxedView.fit(view.camera, 1.6)
        rows, columns = slice(letterbox.top, letterbox.top + 32), slice(letterbox.left, letterbox.left + 32)
        saved = np.asarray(Image.open(run / "test" / f"{index:04d}.png"))
        assert np.abs(frame.image[rows, columns].astype(int) - saved).max() <= 1
        around = frame.image.copy()
        around[rows, columns] = EMPTY
        assert (around == EMPTY).all()
        assert np.abs(frame.picture.astype(int) - saved).max() <= 1, "what is saved has no bars"
        scores = json.loads((run / "scores.json").read_text())["quality"]["psnr"]["per_view"]
        assert frame.psnr == pytest.approx((scores[index],), abs=0.01)


def test_truth_is_the_photograph_and_error_its_difference(loaded_runs: dict[str, LoadedRun], runs: dict[str, Path]) -> None:
    loaded = loaded_runs["volumetric/hash"]
    view = loaded.scene.test[0]
    request = RenderRequest(replace(_camera(loaded), aspect=1.0), (100, 100), output="truth", view=view)
    (truth,), pieces = _frames(request, loaded)
    assert pieces == 0 and truth.final
    folder = runs["volumetric/hash"]
    saved = folder / json.loads((folder / "provenance.json").read_text())["truth"] / "0000.png"
    expected = np.asarray(Image.open(saved))
    np.testing.assert_array_equal(truth.image, expected)
    (wide,), _ = _frames(replace(request, camera=_camera(loaded)), loaded)
    assert wide.image.shape[1] > 32
    np.testing.assert_array_equal(wide.picture, expected)

    error = _frames(replace(request, output="error"), loaded)[0][-1]
    prediction = np.asarray(Image.open(folder / "test" / "0000.png"))
    difference = np.abs(prediction.astype(float) - expected).mean(axis=-1) / 255 / ERROR_LIMIT
    drawn = mpl.colormaps["magma"](difference.clip(0, 1))[..., :3] * 255
    assert np.abs(error.image - drawn).mean() < 1.5
    assert str(ERROR_LIMIT) in error.legend


@pytest.mark.parametrize("method", METHODS)
def test_depth_and_normals(loaded_runs: dict[str, LoadedRun], method: str) -> None:
    loaded = loaded_runs[method]
    request = RenderRequest(_camera(loaded), (64, 40), output="depth", max_size=64, skip_coarse=True)
    ((depth,), _), ((normal,), _) = _frames(request, loaded), _frames(replace(request, output="normal"), loaded)
    rendering = loaded.render(request.camera.pinhole(64, 40), geometry=True)
    solid = (rendering.alpha >= 0.5).numpy()
    assert solid.any() and not solid.all()
    assert (depth.image[~solid] == EMPTY).all() and (normal.image[~solid] == EMPTY).all()
    nearest, farthest = rendering.depth[torch.from_numpy(solid)].quantile(torch.tensor([0.01, 0.99])).tolist()
    assert f"{nearest:.3g} (bright) to {farthest:.3g} (dark)" in depth.legend
    at = rendering.depth.masked_fill(~torch.from_numpy(solid), torch.inf).argmin()
    assert depth.image.reshape(-1, 3)[at].tolist() == [253, 231, 37], "viridis ends in yellow"
    expected = (rendering.normal.numpy()[solid] + 1) / 2 * 255
    assert np.abs(normal.image[solid] - expected).max() <= 1


def test_split_shows_one_run_left_of_the_line_and_the_other_right(loaded_runs: dict[str, LoadedRun]) -> None:
    pair = loaded_runs["volumetric/hash"], loaded_runs["splatting/gaussians"]
    request = RenderRequest(_camera(pair[0]), (80, 50), max_size=80, layout="split", split=0.3)
    split = _frames(request, *pair)[0][-1].image
    left, right = (_frames(replace(request, layout=which), *pair)[0][-1].image for which in ("first", "second"))
    assert np.abs(split[:, :23].astype(int) - left[:, :23]).max() <= 1
    assert np.abs(split[:, 24:].astype(int) - right[:, 24:]).max() <= 1
    assert (split[:, 23] == EMPTY).all()
    for share, alone in ((0.0, right), (1.0, left)):
        whole = _frames(replace(request, split=share), *pair)[0][-1].image
        assert np.abs(whole.astype(int) - alone).max() <= 1
    assert (left != right).any()


def test_split_at_a_photograph_is_where_the_window_says(loaded_runs: dict[str, LoadedRun]) -> None:
    pair = loaded_runs["volumetric/hash"], loaded_runs["splatting/gaussians"]
    request = RenderRequest(_camera(pair[0]), (80, 50), view=pair[0].scene.test[0], layout="split", split=0.5)
    split = _frames(request, *pair)[0][-1]
    left, right = (_frames(replace(request, layout=which), *pair)[0][-1] for which in ("first", "second"))
    middle = split.image.shape[1] // 2
    assert np.abs(split.image[:, : middle - 1].astype(int) - left.image[:, : middle - 1]).max() <= 1
    assert np.abs(split.image[:, middle + 1 :].astype(int) - right.image[:, middle + 1 :]).max() <= 1
    assert split.psnr == () and len(left.psnr) == len(right.psnr) == 1


def test_side_by_side_shows_both_whole(loaded_runs: dict[str, LoadedRun]) -> None:
    pair = loaded_runs["volumetric/hash"], loaded_runs["splatting/gaussians"]
    request = RenderRequest(_camera(pair[0]), (80, 50), max_size=80, layout="side by side")
    both = _frames(request, *pair)[0][-1]
    assert both.image.shape == (50, 80, 3)
    half = replace(request.camera, aspect=0.8).pinhole(40, 50)
    for one, columns in zip(pair, (slice(0, 39), slice(40, 80)), strict=True):
        whole = slice(0, 39) if columns.start == 0 else slice(0, 40)
        assert np.abs(both.image[:, columns].astype(int) - _composited(one, half)[:, whole]).max() <= 1
    at_view = _frames(replace(request, view=pair[0].scene.test[0]), *pair)[0][-1]
    assert len(at_view.psnr) == 2
    first, second = (_frames(replace(request, view=pair[0].scene.test[0], layout=which), *pair)[0][-1] for which in LAYOUTS[2:])
    assert at_view.picture.shape == (32, 64, 3), "without bars"
    assert np.abs(at_view.picture[:, :31].astype(int) - first.picture[:, :31]).max() <= 1
    assert np.abs(at_view.picture[:, 32:].astype(int) - second.picture).max() <= 1


class Slow(LoadedRun):
    """A run whose every piece takes long."""

    def render(self, camera, geometry, crop=None):
        time.sleep(0.05)
        return super().render(camera, geometry, crop)


@pytest.mark.parametrize("layout", ["split", "side by side"])
def test_each_side_refines_by_itself(loaded_runs: dict[str, LoadedRun], layout) -> None:
    """The fast run is as fine as it gets before the slow one is; until then its half of the window does not change."""
    slow, fast = Slow(loaded_runs["volumetric/nerf"].fitted), loaded_runs["splatting/gaussians"]
    request = RenderRequest(_camera(slow), (160, 100), max_size=160, layout=layout)
    pictures, _ = _frames(request, slow, fast)
    right = [resize_image(frame.image, (160, 100))[:, 84:].astype(int) for frame in pictures]
    early = [index for index, seen in enumerate(right) if np.abs(seen - right[-1]).mean() < 1]
    assert not pictures[early[0]].final and early[0] < len(pictures) - 1
    assert early == list(range(early[0], len(pictures)))
    left = [resize_image(frame.image, (160, 100))[:, :76].astype(int) for frame in pictures]
    assert np.abs(left[early[0]] - left[-1]).mean() > 1, "the slow side is still coarse then"


def test_background_can_be_chosen(loaded_runs: dict[str, LoadedRun]) -> None:
    loaded = loaded_runs["splatting/gaussians"]
    request = RenderRequest(_camera(loaded), (64, 40), max_size=64, skip_coarse=True)
    (own,), (black,) = (_frames(each, loaded)[0] for each in (request, replace(request, background=(0.0, 0.0, 0.0))))
    rendering = loaded.render(request.camera.pinhole(64, 40), geometry=False)
    premultiplied, share = rendering.rgb.clamp(0, 1).numpy(), 1 - rendering.alpha[..., None].numpy()
    assert share.max() > 0.5, "the background shows"
    assert np.abs(black.image - premultiplied * 255).max() <= 1
    assert np.abs(own.image - (premultiplied + share).clip(0, 1) * 255).max() <= 1


def test_a_second_run_in_another_frame_shows_the_same_place(loaded_runs: dict[str, LoadedRun]) -> None:
    """The same fit in a frame that is turned, moved and three times as large."""
    first = loaded_runs["volumetric/hash"]
    similarity = torch.tensor([[0.0, -3, 0, 1], [3, 0, 0, 2], [0, 0, 3, -1], [0, 0, 0, 1.0]])
    other = LoadedRun(replace(first.fitted, scene=replace(first.scene, world_from_local=similarity)))
    camera = first.scene.test[0].camera
    placed = other.to_local(camera, first.scene)
    points = torch.rand(20, 3) - 0.5
    in_other = (points - similarity[:3, 3]) @ torch.linalg.inv(similarity[:3, :3]).T
    torch.testing.assert_close(placed.project(in_other)[0], camera.project(points)[0], atol=1e-3, rtol=0)
    assert first.to_local(camera, first.scene) is camera


def test_a_newer_checkpoint_is_noticed_and_shown(runs: dict[str, Path], tmp_path: Path) -> None:
    run = Path(shutil.copytree(runs["splatting/gaussians"], tmp_path / "run"))
    loaded = open_run(run, None, live=True, say=print)
    assert not loaded.has_update() and loaded.steps == 60 and "PSNR" in loaded.summary()["test views"]
    before = _composited(loaded, loaded.scene.test[0].camera)
    state = checkpoint.load(run / CHECKPOINT)
    keep = len(state["field"]["means"]) // 2  # density control changes the number
    for name, values in state["field"].items():
        state["field"][name] = values[:keep] if values.ndim else values
    checkpoint.save(run / CHECKPOINT, state)
    (run / "fit.json").write_text('{"steps": 120, "seconds": 9.5}')
    assert loaded.has_update()
    loaded.reload()
    assert not loaded.has_update() and loaded.summary()["fit"] == "step 120, 9.5 s"
    assert loaded.summary()["primitives"] == f"{keep:,}"
    assert (_composited(loaded, loaded.scene.test[0].camera) != before).any()
    (run / "scores.json").unlink()
    assert loaded.has_update()
    loaded.reload()
    assert loaded.summary()["test views"] == "not scored yet" and not loaded.has_update()
    (run / CHECKPOINT).unlink()
    assert not loaded.has_update(), "a fit that starts again removes the file first"


def test_cameras_follow_refined_poses(balls: Path, tmp_path: Path) -> None:
    """A live view of a fit that refines poses: each checkpoint brings the cameras of then, and frustums are drawn anew."""
    method = "splatting/gaussians"
    overrides = (*SMALL[method], "training.poses.optimise=true")
    run = fit_run(FitRequest(method=method, scene=str(balls), out=str(tmp_path / "run"), budget="3steps", overrides=overrides))
    loaded, drawn = LoadedRun(open_fitted(run)), []
    overlays = Overlays(_Drawn(drawn), loaded, CameraFrustums(loaded), lambda index: None)
    list(overlays.update(splats=None, frustums=True, hidden=None))
    assert len(drawn) == len(loaded.views())
    assert not overlays.remove_outdated()
    before = torch.stack([view.camera.position for view in loaded.scene.train])
    state = checkpoint.load(run / CHECKPOINT)
    state["poses"]["translation.0"] = state["poses"]["translation.0"] + 0.3
    checkpoint.save(run / CHECKPOINT, state)
    assert loaded.has_update()
    loaded.reload()
    after, fresh = (
        torch.stack([view.camera.position for view in one.scene.train]) for one in (loaded, open_run(run, None, False, print))
    )
    assert float((after - before).norm(dim=1).max()) > 0.1
    assert torch.equal(after, fresh)
    assert overlays.remove_outdated()
    list(overlays.update(splats=None, frustums=True, hidden=None))
    assert len(drawn) == 2 * len(loaded.views())
    assert sum(handle.gone for handle in drawn) == len(loaded.views())
    torch.testing.assert_close(torch.tensor(drawn[-1].position), after[-1])


class _Drawn:
    """A viser scene that keeps its frustums."""

    def __init__(self, drawn: list) -> None:
        self._drawn = drawn

    def add_camera_frustum(self, *_: object, **settings: object) -> "_Handle":
        self._drawn.append(_Handle(settings["position"]))
        return self._drawn[-1]


class _Handle:
    def __init__(self, position: object) -> None:
        self.position, self.gone, self.visible = position, False, True

    def remove(self) -> None:
        self.gone = True

    def on_click(self, _: object) -> None: ...
