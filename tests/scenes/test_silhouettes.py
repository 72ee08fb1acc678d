"""Points inside silhouettes, against the two balls that the photographs show."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Points, Scene
from invgraphics.scenes.degrade import FEWEST_POINTS, TrainingData, degrade
from invgraphics.scenes.photos.triangulate import Triangulated
from invgraphics.scenes.silhouettes import inside_silhouettes, points_inside
from invgraphics.testing import TwoBalls, toy_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return toy_scene(views=12, size=32)


def depth_in_balls(points: torch.Tensor) -> torch.Tensor:
    """Signed distance from the balls, negative inside."""
    balls = TwoBalls()
    return ((points[:, None] - balls.centres).norm(dim=-1) - balls.radii).amin(dim=1)


def test_what_the_object_fills_is_kept_and_what_is_far_from_it_is_not(scene: Scene) -> None:
    points = 2 * torch.rand(20_000, 3) - 1
    inside, distance = inside_silhouettes(points, scene.train), depth_in_balls(points)
    assert bool(inside[distance < 0].all())
    assert not bool(inside[distance > 0.3].any())
    # The hull of twelve silhouettes, each wider by a pixel, is not much larger than the balls; the box is 15 times as large.
    volume = float(inside.float().mean() / (distance < 0).float().mean())
    assert 1.0 < volume < 2.0


def test_as_many_as_asked_for(scene: Scene) -> None:
    draw = lambda views, count: points_inside(scene.bounds, views, count, torch.Generator().manual_seed(1))  # noqa: E731
    found = draw(scene.train, 500)
    assert found.shape == (500, 3)
    assert float((depth_in_balls(found) < 0.15).float().mean()) > 0.9
    opaque = tuple(replace(view, alpha=None) for view in scene.train)
    assert float((depth_in_balls(draw(opaque, 500)) < 0.15).float().mean()) < 0.4
    nothing = tuple(replace(view, alpha=torch.zeros_like(view.alpha)) for view in scene.train)
    assert draw(nothing, 500).shape == (0, 3)


def test_what_a_mask_leaves_out_says_nothing(scene: Scene) -> None:
    blind = tuple(
        replace(view, alpha=torch.zeros_like(view.alpha), mask=torch.zeros(view.image.shape[:2], dtype=torch.bool))
        for view in scene.train
    )
    assert bool(inside_silhouettes(2 * torch.rand(100, 3) - 1, blind).all())


def test_a_view_says_nothing_of_what_is_behind_its_camera(scene: Scene) -> None:
    """Mirrored at the camera's centre, a point falls on the same pixel."""
    view = scene.train[0]
    outside = 2 * torch.rand(2000, 3) - 1
    outside = outside[~inside_silhouettes(outside, (view,))]
    assert len(outside) > 100
    assert bool(inside_silhouettes(2 * view.camera.cam_to_world[:3, 3] - outside, (view,)).all())


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_they_join_few_points_unless_poses_are_disturbed(scene: Scene, monkeypatch: pytest.MonkeyPatch, noise: float) -> None:
    few = Points(torch.zeros(FEWEST_POINTS, 3), torch.zeros(FEWEST_POINTS, 3))
    nowhere = Triangulated.of(few, torch.zeros(2, 0, dtype=torch.int64), len(scene.train))
    monkeypatch.setattr("invgraphics.scenes.photos.triangulate.triangulated", lambda scene: nowhere)
    found = degrade(scene, TrainingData(init="sfm", pose_noise=noise), 0)
    assert found.points is not None
    share = float(inside_silhouettes(found.points.position[FEWEST_POINTS:], scene.train).float().mean())
    assert (share == 1.0) == (noise == 0.0)
    assert ("silhouettes" in found.notes["points"]) == (noise == 0.0)
