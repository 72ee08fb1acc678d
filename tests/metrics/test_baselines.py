"""The trivial predictions on toy scenes whose answer is known."""

import math
from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Camera, Scene, View
from invgraphics.errors import InputError
from invgraphics.metrics import baselines
from invgraphics.metrics.conventions import PROTOCOLS
from invgraphics.metrics.protocols import prepare


def view_at(angle: float, value: float, size: tuple[int, int] = (12, 16), alpha: float | None = None) -> View:
    """A camera on a circle of radius 3 around z that looks at the centre; a flat picture."""
    position = 3 * torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    forward, down = -position / 3, torch.tensor([0.0, 0.0, -1.0])
    pose = torch.eye(4)
    pose[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward], dim=1)
    pose[:3, 3] = position
    height, width = size
    camera = Camera(pose, torch.full((2,), 20.0), torch.tensor([width / 2, height / 2]), width, height)
    image = torch.full((height, width, 3), round(value * 255), dtype=torch.uint8)
    cover = None if alpha is None else torch.full((height, width), round(alpha * 255), dtype=torch.uint8)
    return View(camera, image, f"{angle:.2f}", alpha=cover)


def scene_of(train: tuple[View, ...], test: tuple[View, ...]) -> Scene:
    return Scene("ring", train, test, torch.ones(3), Bounds(-torch.ones(3), torch.ones(3)))


def test_mean_image_over_the_background() -> None:
    train = (view_at(0.0, 0.2, alpha=1.0), view_at(1.0, 0.8, alpha=0.0))
    scene = scene_of(train, (view_at(2.0, 0.6, alpha=1.0),))
    (picture,) = baselines.mean_image(scene)
    expected = (0.2 + 1.0) / 2  # the transparent view shows the white background
    torch.testing.assert_close(picture.over(scene.background), torch.full((12, 16, 3), expected))
    pair = prepare(picture, scene.test[0], scene, PROTOCOLS["default"])
    assert float((pair.image - pair.truth).abs().max()) < 0.5 / 255


def test_nearest_view_goes_round_the_ring() -> None:
    angles = [0.0, 1.5, 3.0, 4.5]
    scene = scene_of(tuple(view_at(a, a / 5) for a in angles), tuple(view_at(a + 0.3, 0.5) for a in angles))
    for angle, picture in zip(angles, baselines.nearest_view(scene), strict=True):
        assert float(picture.rgb[0, 0, 0]) == pytest.approx(round(angle / 5 * 255) / 255)
        assert picture.alpha.eq(1).all()


def test_nearest_view_minds_the_direction_too() -> None:
    here, turned = view_at(0.0, 0.1), view_at(math.pi, 0.9)
    there = View(turned.camera.moved(turned.camera.cam_to_world.clone()), turned.image, "turned")
    there.camera.cam_to_world[:3, 3] = here.camera.position + 0.01
    nearly = view_at(0.05, 0.5)
    scene = scene_of((there, nearly), (here,))
    (picture,) = baselines.nearest_view(scene)
    assert float(picture.rgb[0, 0, 0]) == pytest.approx(128 / 255, abs=1e-6)


def test_pictures_are_resized_to_the_test_view() -> None:
    scene = scene_of((view_at(0.0, 0.4, (24, 32)), view_at(1.0, 0.4, (9, 11))), (view_at(0.1, 0.4), view_at(0.9, 0.4, (6, 8))))
    for predict in baselines.BASELINES.values():
        for picture, view in zip(predict(scene), scene.test, strict=True):
            torch.testing.assert_close(picture.rgb, view.colour())


def test_scores_of_both_baselines() -> None:
    train = (view_at(0.0, 0.2), view_at(2.0, 0.6))
    scene = scene_of(train, (view_at(0.1, 0.2), view_at(1.9, 0.6)))
    scores = baselines.baseline_scores(scene, PROTOCOLS["default"])
    assert scores["nearest view"]["psnr"].per_view == (100.0, 100.0)
    assert scores["mean image"]["psnr"].mean == pytest.approx(20 * math.log10(1 / 0.2), abs=1e-4)
    assert set(scores["mean image"]) == {"psnr", "psnr_exposed", "ssim", "flip"}  # nothing about geometry


def test_no_training_views_is_said() -> None:
    scene = scene_of((), (view_at(0.0, 0.5),))
    with pytest.raises(InputError, match="no training views"):
        baselines.baseline_scores(scene, PROTOCOLS["default"])


def test_the_mean_is_over_pixels_that_masks_leave() -> None:
    half = torch.zeros(12, 16, dtype=torch.bool)
    half[:, :8] = True
    train = (replace(view_at(0.0, 0.2), mask=half), view_at(1.0, 0.8))
    (picture,) = baselines.mean_image(scene_of(train, (view_at(2.0, 0.6),)))
    torch.testing.assert_close(picture.rgb[:, :8], torch.full((12, 8, 3), 0.5), atol=2e-3, rtol=0)
    torch.testing.assert_close(picture.rgb[:, 8:], torch.full((12, 8, 3), 0.8), atol=2e-3, rtol=0)
    (large,) = baselines.mean_image(scene_of(train, (view_at(2.0, 0.6, size=(24, 32)),)))
    assert [float(large.rgb[0, x, 0]) for x in (0, -1)] == pytest.approx([0.5, 0.8], abs=2e-3)
