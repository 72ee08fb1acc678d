"""Points that multi-view stereo finds in photographs, against the depth that these photographs truly have."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial import KDTree

from invgraphics.core import Camera, Scene, View
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.fields.points.field import PointField, PointFieldConfig
from invgraphics.fields.points.stereo import stereo_points
from invgraphics.fields.starting import LEAST_MATCHED, depth_points, initial_points
from invgraphics.testing import toy_cameras, toy_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return toy_scene(views=12, size=48)


def distances(scene: Scene, found: torch.Tensor) -> torch.Tensor:
    """Of points to the true surface, as densely as all pixels show it."""
    surface = depth_points(scene, 1 << 20).position
    return torch.from_numpy(KDTree(surface.numpy()).query(found.detach().numpy())[0])


def test_points_lie_on_the_surface_and_have_its_colours(scene: Scene) -> None:
    torch.manual_seed(0)
    points = stereo_points(scene, 4000)
    assert len(points) > 1000
    off = distances(scene, points.position)
    pixel = scene.bounds.radius / 48
    assert off.median() < 1.5 * pixel
    assert off.quantile(0.9) < 4 * pixel
    surface = depth_points(scene, 1 << 20)
    nearest = torch.from_numpy(KDTree(surface.position.numpy()).query(points.position.numpy())[1])
    assert (points.rgb - surface.rgb[nearest]).abs().mean() < 0.1


def test_wrong_poses_agree_on_nothing(scene: Scene) -> None:
    """The check between depth maps is what separates a surface from chance."""
    right = len(stereo_points(scene, 1 << 20))
    cameras = [view.camera for view in scene.train]
    turned = cameras[5:] + cameras[:5]
    wrong = [replace(view, camera=camera) for view, camera in zip(scene.train, turned, strict=True)]
    assert len(stereo_points(scene.with_views(train=tuple(wrong)), 1 << 20)) < 0.3 * right


def test_masked_pixels_give_no_points(scene: Scene) -> None:
    mask = torch.zeros(48, 48, dtype=torch.bool)
    masked = scene.with_views(train=tuple(replace(view, mask=mask) for view in scene.train))
    assert len(stereo_points(masked, 100)) == 0


def test_one_view_has_nothing_to_match_and_random_points_stand_in(scene: Scene) -> None:
    alone = replace(scene.with_views(train=scene.train[:1]), points=None)
    assert len(stereo_points(alone, 100)) == 0
    assert len(initial_points(alone, "stereo", count=77, most=LEAST_MATCHED)) == 77


def test_large_pictures_are_matched_smaller(scene: Scene) -> None:
    """Areas are averaged, and cameras with them: a doubled picture finds the same surface."""
    double = [
        replace(
            view,
            camera=view.camera.resized(384, 384),
            image=view.image.repeat_interleave(8, 0).repeat_interleave(8, 1),
            alpha=None if view.alpha is None else view.alpha.repeat_interleave(8, 0).repeat_interleave(8, 1),
        )
        for view in scene.train
    ]
    points = stereo_points(scene.with_views(train=tuple(double)), 4000)
    assert len(points) > 1000
    assert distances(scene, points.position).median() < 1.5 * scene.bounds.radius / 48


def test_splats_and_neural_points_start_from_them(scene: Scene) -> None:
    for config in (PointFieldConfig(init="stereo", max_init=600), GaussianFieldConfig(init="stereo", max_init=600)):
        field = config.build(replace(scene, points=None))
        assert field.primitive_count() == 600
        assert distances(scene, field.positions if isinstance(field, PointField) else field.means).median() < 0.1


def test_depths_lie_between_the_planes_of_the_sweep(scene: Scene) -> None:
    """A wall y = 0 with a smooth pattern: points are nearer to it than the sweep's planes, 0.08 apart there, to each other."""

    def photograph(camera: Camera, name: str) -> View:
        pixels = torch.stack(torch.meshgrid(torch.arange(96), torch.arange(96), indexing="xy"), dim=-1).view(-1, 2) + 0.5
        rays = camera.rays(pixels)
        hit = rays.origins - (rays.origins[:, 1:2] / rays.directions[:, 1:2]) * rays.directions
        waves = torch.tensor([[7.0, 2.0], [-3.0, 8.0], [5.0, -6.0]])
        return View(camera, (0.5 + 0.4 * (hit[:, ::2] @ waves.T).sin()).view(96, 96, 3), name)

    cameras = toy_cameras(24, 96, facing="forward")
    wall = scene.with_views(train=tuple(photograph(camera, str(index)) for index, camera in enumerate(cameras)))
    off = stereo_points(wall, 1 << 20).position[:, 1].abs()
    assert len(off) > 5000
    assert off.median() < 0.01


def test_a_camera_may_stand_in_the_middle_of_the_box(scene: Scene) -> None:
    pose = torch.eye(4)
    pose[:3, 3] = scene.bounds.centre
    first, *others = scene.train
    moved = replace(first, camera=first.camera.moved(pose))
    assert len(stereo_points(scene.with_views(train=(moved, *others)), 50)) > 0
