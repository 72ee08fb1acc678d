"""Gaussians that start from depth maps and from fitted density fields."""

import math
from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Camera, Context, Quantity
from invgraphics.core.transforms import look_at
from invgraphics.errors import InputError
from invgraphics.fields.analytic import Sphere
from invgraphics.fields.convert import visible_points
from invgraphics.fields.depth_maps import field_depth
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.fields.starting import depth_points
from invgraphics.testing import TwoBalls, toy_scene


@pytest.fixture(scope="module")
def scene():
    return toy_scene(views=6, size=32)


def surface_distance(points: torch.Tensor) -> torch.Tensor:
    """Distance to the surface of the nearer ball."""
    balls = TwoBalls()
    return ((points[:, None] - balls.centres).norm(dim=-1) - balls.radii).amin(dim=1)


def test_points_of_depth_maps_lie_on_the_surface(scene) -> None:
    points = depth_points(scene, 500)
    assert len(points) == 500
    # The balls are fog of mean free path 1/30, and a pixel on the silhouette sees both edges.
    assert float((surface_distance(points.position).abs() < 0.1).float().mean()) > 0.9
    field = GaussianFieldConfig(init="depth", max_init=400).build(scene)
    assert field.primitive_count() == 400


def test_scenes_without_depth_are_refused(scene) -> None:
    bare = scene.with_views(train=tuple(replace(view, depth=None) for view in scene.train))
    with pytest.raises(InputError, match="no depth maps"):
        GaussianFieldConfig(init="depth").build(bare)


@pytest.mark.parametrize("space", ["box", "contracted"])
def test_points_are_drawn_where_light_ends(space: str) -> None:
    """In fog of density 30 the depth behind the surface is exponential, with mean 1/30, along rays through the middle."""
    scene, field = toy_scene(views=6, size=32, space=space), TwoBalls()
    points = visible_points(field, scene, 4000)
    assert len(points) == 4000
    depth = -surface_distance(points.position)
    step = 0.01 if space == "box" else 3 * math.log(2e4) / 512  # intervals grow with distance where space is unbounded
    assert float((depth > -step).float().mean()) > 0.99
    # Slanted rays enter less deeply: the mean lies below 1/30, and well above 0.
    assert 0.25 / 30 < float(depth.mean()) < 1.1 / 30
    balls = TwoBalls()
    red = (points.position - balls.centres[0]).norm(dim=1) < balls.radii[0] + 0.02
    assert bool((points.rgb[red, 0] > points.rgb[red, 2]).all())
    assert 0.4 < float(red.float().mean()) < 0.9  # it is the larger one


def test_converted_gaussians_stand_for_the_field(scene) -> None:
    field = GaussianFieldConfig(init="field", source="somewhere", max_init=300, sh_degree=1).converted(TwoBalls(), scene)
    gaussians = field.primitives(Quantity.GAUSSIANS, Context(scene.bounds))
    assert len(gaussians) == 300
    assert float((surface_distance(gaussians.means).abs() < 0.15).float().mean()) > 0.95


def test_empty_and_other_fields_are_refused(scene) -> None:
    class Nothing(TwoBalls):
        def query(self, samples, want):
            values = super().query(samples, want)
            return values if values.density is None else replace(values, density=0 * values.density)

    with pytest.raises(InputError, match="shows nothing"):
        visible_points(Nothing(), scene, 1)
    with pytest.raises(InputError, match="not density and radiance"):
        visible_points(NeuralFieldConfig(geometry="sdf", layers=1, width=8, skip=-1).build(scene), scene, 1)
    for wrong in ({"init": "field"}, {"source": "somewhere"}):
        with pytest.raises(ValueError, match="source"):
            GaussianFieldConfig(**wrong)


def test_depth_is_found_where_the_near_plane_is_the_camera() -> None:
    pose = look_at(torch.tensor([0.0, -3.0, 0.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    camera = Camera(pose, torch.tensor([8.0, 8.0]), torch.tensor([4.0, 4.0]), 8, 8)
    bounds = Bounds(-torch.ones(3), torch.ones(3), "contracted", near=0.0)
    assert float(field_depth(Sphere(50.0, 0.5), camera, bounds)[4, 4]) == pytest.approx(2.55, abs=0.15)


def test_what_a_depth_camera_has_not_measured_is_no_surface(scene) -> None:
    """It writes 0 there, which would be a point at the camera."""
    zeros = [replace(view, depth=torch.where(view.depth.isfinite(), view.depth, 0.0)) for view in scene.train]
    points = depth_points(scene.with_views(train=tuple(zeros)), 500)
    assert float((surface_distance(points.position).abs() < 0.1).float().mean()) > 0.9
    nothing = [replace(view, depth=torch.zeros_like(view.depth)) for view in scene.train]
    with pytest.raises(InputError, match="no depth maps"):
        depth_points(scene.with_views(train=tuple(nothing)), 500)


def test_no_point_is_seen_through_masked_pixels(scene) -> None:
    """All cameras but one are masked out, and that shows its left half only: all points are there."""
    left = torch.zeros(32, 32, dtype=torch.bool)
    left[:, :16] = True
    shown = scene.with_views(train=(replace(scene.train[0], mask=left),))
    points = visible_points(TwoBalls(), shown, 500)
    pixels, _ = shown.train[0].camera.project(points.position)
    assert bool((pixels[:, 0] < 16).all())
