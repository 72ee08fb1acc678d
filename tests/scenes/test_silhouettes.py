"""Points inside silhouettes, against the two balls that the photographs show."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Points, Scene, View
from invgraphics.scenes.degrade import FEWEST_POINTS, TrainingData, degrade
from invgraphics.scenes.photos.triangulate import Triangulated
from invgraphics.scenes.silhouettes import GRID, inside_silhouettes, points_inside, tightened
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


def photographed(scene: Scene, half: float = 2.0) -> Scene:
    """As photographs show it: without known depth, in a box of which nothing is known."""
    corner = torch.full((3,), half)
    views = {split: tuple(replace(view, depth=None) for view in getattr(scene, split)) for split in ("train", "val", "test")}
    return replace(scene, bounds=Bounds(-corner, corner), **views)


def box_of_balls() -> tuple[torch.Tensor, torch.Tensor]:
    balls = TwoBalls()
    return (balls.centres - balls.radii[:, None]).amin(dim=0), (balls.centres + balls.radii[:, None]).amax(dim=0)


def without_alpha(view: View, size: int = 32) -> View:
    return replace(view, alpha=torch.zeros(size, size, dtype=torch.uint8))


def test_a_wide_box_shrinks_to_the_balls() -> None:
    """Against their own box: nothing of it is lost, and no more is left around it than cells and pixels explain."""
    wide = photographed(toy_scene(views=40, size=64))
    tight, (lo, hi) = tightened(wide), box_of_balls()
    assert bool((tight.bounds.lo <= lo).all()) and bool((tight.bounds.hi >= hi).all())
    pixel = 3.0 / 83.2  # its width at the balls; silhouettes are looked up to three of them away, and hulls bulge between views
    assert (
        float(torch.cat([lo - tight.bounds.lo, tight.bounds.hi - hi]).max()) < 4 * pixel + 2 * float(wide.bounds.half[0]) / GRID
    )
    share = float((tight.bounds.half / wide.bounds.half).prod())
    assert tight.notes["region"] == f"the box of the training views' silhouettes, {share:.0%} of the data set's"
    assert (tight.bounds.space, tight.bounds.near) == (wide.bounds.space, wide.bounds.near)


def test_what_is_thinner_than_a_cell_is_not_cut_off() -> None:
    """A needle of a pixel's width, a fiftieth of a cell's, that sticks out of a ball along x."""
    cameras = [view.camera.resized(400, 400) for view in toy_scene(views=30, size=32).train]
    needle = torch.cat([torch.linspace(0.3, 1.2, 4000)[:, None], torch.full((4000, 2), 0.013)], dim=1)
    ball = torch.nn.functional.normalize(torch.randn(40_000, 3), dim=1) * 0.3
    views = []
    for index, camera in enumerate(cameras):
        alpha = torch.zeros(400 * 400, dtype=torch.uint8)
        seen, pixel = camera.pixel_of(torch.cat([needle, ball]))
        alpha[pixel[seen]] = 255
        views.append(View(camera, torch.zeros(400, 400, 3, dtype=torch.uint8), str(index), alpha=alpha.view(400, 400)))
    shown = photographed(toy_scene(views=30, size=32), half=3.0).with_views(train=tuple(views))
    box = tightened(shown).bounds
    assert float(box.hi[0]) >= 1.2 and float(box.hi[0]) < 1.5
    assert float(box.lo.min()) < -0.3 and float(box.radius) < 1.8


def test_one_wrong_alpha_in_sixty_photographs_carves_nothing() -> None:
    many = photographed(toy_scene(views=60, size=32))
    tight = tightened(many.with_views(train=(without_alpha(many.train[0]), *many.train[1:])))
    lo, hi = box_of_balls()
    assert bool((tight.bounds.lo <= lo).all()) and bool((tight.bounds.hi >= hi).all())
    assert tight.bounds.radius < 0.8 * many.bounds.radius


@pytest.mark.parametrize("what", ["opaque", "empty", "endless", "class", "rendered", "tight"])
def test_boxes_that_silhouettes_tell_nothing_of_stay(scene: Scene, what: str) -> None:
    wide = photographed(scene)
    views = wide.train
    unchanged = {
        "opaque": wide.with_views(train=(replace(views[0], alpha=None), *views[1:])),
        "empty": wide.with_views(train=tuple(map(without_alpha, views))),
        "endless": replace(wide, bounds=replace(wide.bounds, space="contracted")),
        "class": wide.with_views(train=tuple(replace(view, subject=index) for index, view in enumerate(views))),
        "rendered": wide.with_views(test=scene.test),
        "tight": replace(wide, bounds=tightened(wide).bounds),
    }[what]
    assert tightened(unchanged) is unchanged
