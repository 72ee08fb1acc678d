"""Points inside silhouettes, against the two balls that the photographs show."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Points, Scene
from invgraphics.scenes.degrade import FEWEST_POINTS, TrainingData, degrade
from invgraphics.scenes.photos.triangulate import Triangulated
from invgraphics.scenes.silhouettes import CELLS_AROUND, GRID, inside_silhouettes, points_inside, tightened
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


def in_a_wide_box(scene: Scene, half: float = 2.0) -> Scene:
    corner = torch.full((3,), half)
    return replace(scene, bounds=Bounds(-corner, corner))


def boxes_of_balls() -> tuple[torch.Tensor, torch.Tensor]:
    balls = TwoBalls()
    return (balls.centres - balls.radii[:, None]).amin(dim=0), (balls.centres + balls.radii[:, None]).amax(dim=0)


def test_a_wide_box_shrinks_to_the_balls(scene: Scene) -> None:
    """Against their box: nothing of it is lost, and no more is left around it than the grid and a pixel explain."""
    wide = in_a_wide_box(scene)
    tight, (lo, hi) = tightened(wide), boxes_of_balls()
    slack = (CELLS_AROUND + 1) * 4 / GRID + 0.3  # pixels are 0.1 wide at the balls, and a hull bulges between views
    assert bool((tight.bounds.lo <= lo).all()) and bool((tight.bounds.hi >= hi).all())
    assert float(torch.cat([lo - tight.bounds.lo, tight.bounds.hi - hi]).max()) < slack
    share = float((tight.bounds.half / wide.bounds.half).prod())
    assert tight.notes["region"] == f"the box of the training views' silhouettes, {share:.0%} of the data set's"
    assert (tight.bounds.space, tight.bounds.near) == (wide.bounds.space, wide.bounds.near)


def test_one_wrong_alpha_in_fifty_photographs_carves_nothing(scene: Scene) -> None:
    many = in_a_wide_box(toy_scene(views=60, size=32))
    blank = replace(many.train[0], alpha=torch.zeros(32, 32, dtype=torch.uint8))
    wrong = tightened(many.with_views(train=(blank, *many.train[1:])))
    (lo, hi) = boxes_of_balls()
    assert bool((wrong.bounds.lo <= lo).all()) and bool((wrong.bounds.hi >= hi).all())
    assert wrong.bounds.radius < 0.8 * many.bounds.radius


@pytest.mark.parametrize("what", ["opaque", "empty", "endless", "class", "tight"])
def test_boxes_that_silhouettes_tell_nothing_of_stay(scene: Scene, what: str) -> None:
    wide, views = in_a_wide_box(scene), scene.train
    unchanged = {
        "opaque": wide.with_views(train=(replace(views[0], alpha=None), *views[1:])),
        "empty": wide.with_views(train=tuple(replace(view, alpha=torch.zeros(32, 32, dtype=torch.uint8)) for view in views)),
        "endless": replace(wide, bounds=replace(wide.bounds, space="contracted")),
        "class": wide.with_views(train=tuple(replace(view, subject=index) for index, view in enumerate(views))),
        "tight": replace(wide, bounds=tightened(wide).bounds),
    }[what]
    assert tightened(unchanged) is unchanged
