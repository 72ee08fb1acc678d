"""Noise-free depth, normals and coverage against closed forms."""

from pathlib import Path

import numpy as np
import pytest
import torch

from invgraphics.core import Camera
from invgraphics.core.transforms import look_at
from invgraphics.scenes.mitsuba import gbuffer, stage
from invgraphics.scenes.mitsuba.build.mesh import polygon
from invgraphics.scenes.mitsuba.build.model import Ball, Fog, Model, Part
from invgraphics.scenes.mitsuba.build.surfaces import matte, studio
from invgraphics.scenes.mitsuba.gbuffer import sample_points

CENTRE, RADIUS, FLOOR = (0.1, -0.2, 0.3), 0.5, -0.4


@pytest.fixture
def camera() -> Camera:
    pose = look_at(*(torch.tensor(v, dtype=torch.float64) for v in ((2.0, 1.5, 1.4), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))))
    return Camera(pose, torch.tensor([60.0, 60.0]).double(), torch.tensor([21.0, 17.0]).double(), 40, 30)


@pytest.fixture
def mitsuba():
    module = pytest.importorskip("mitsuba")
    module.set_variant("scalar_rgb")
    return module


def test_depth_times_ray_lies_on_sphere_and_plane(camera, mitsuba, tmp_path: Path):
    corners = np.array([(-1.0, -1.0, FLOOR), (1.0, -1.0, FLOOR), (1.0, 1.0, FLOOR), (-1.0, 1.0, FLOOR)])
    model = Model([Part(polygon(corners), matte((0.5, 0.5, 0.5)))], [Ball(CENTRE, RADIUS, matte((0.5, 0.5, 0.5)))])
    truth = gbuffer.trace(stage.load(model, 2, True, tmp_path), camera)
    rays = camera.rays()
    origin, direction = rays.origins.numpy(), rays.directions.numpy()

    # By hand: nearest of the sphere's first root and the plane's, within the square.
    away = origin - np.array(CENTRE)
    b = (away * direction).sum(1)
    root = b**2 - (away**2).sum(1) + RADIUS**2
    sphere = np.where(root > 0, -b - np.sqrt(np.maximum(root, 0)), np.inf)
    plane = (FLOOR - origin[:, 2]) / direction[:, 2]
    on_floor = origin + plane[:, None] * direction
    plane = np.where((plane > 0) & (np.abs(on_floor[:, :2]) < 1).all(1), plane, np.inf)
    expected = np.minimum(sphere, plane)
    normal = np.where(
        (sphere < plane)[:, None], (away + np.where(root > 0, sphere, 0)[:, None] * direction) / RADIUS, [0.0, 0, 1]
    )

    depth = truth.depth.reshape(-1)
    hit = np.isfinite(expected)
    assert 0.2 < hit.mean() < 0.9
    assert np.isfinite(sphere).any()
    assert np.isfinite(plane).any()
    np.testing.assert_array_equal(np.isfinite(depth), hit)
    np.testing.assert_allclose(depth[hit], expected[hit], atol=2e-5)
    np.testing.assert_allclose(truth.normal.reshape(-1, 3)[hit], normal[hit], atol=1e-4)
    np.testing.assert_array_equal(truth.alpha.reshape(-1), hit)
    assert (truth.normal.reshape(-1, 3)[~hit] == 0).all()


def test_normals_face_the_camera(camera, mitsuba, tmp_path: Path):
    corners = np.array([(-1.0, -1.0, 0), (1.0, -1.0, 0), (1.0, 1.0, 0), (-1.0, 1.0, 0)])
    model = Model([Part(polygon(corners[::-1]), matte((0.5, 0.5, 0.5)))])  # its front looks down, away from the camera
    truth = gbuffer.trace(stage.load(model, 2, True, tmp_path), camera)
    assert truth.normal[..., 2].max() == pytest.approx(1.0)
    assert truth.normal[..., 2].min() >= 0


def test_fog_of_constant_extinction_has_the_coverage_of_a_slab(camera):
    fog = Fog(np.full((3, 4, 5), 1.7), (0.9, 0.9, 0.9), 0.0, (-0.5, -0.4, -0.3), (0.5, 0.4, 0.3))
    alpha = gbuffer.trace_fog(fog, camera).alpha.reshape(-1)
    rays = camera.rays()
    slabs = (torch.tensor([fog.lo, fog.hi]).double()[:, None] - rays.origins) / rays.directions
    length = (slabs.amax(0).amin(1) - slabs.amin(0).amax(1)).clamp_min(0)
    np.testing.assert_allclose(alpha, 1 - torch.exp(-1.7 * length).numpy(), atol=1e-6)
    assert alpha.max() > 0.5
    assert alpha.min() == 0


def test_rendered_fog_has_the_coverage_that_was_computed(camera, mitsuba, tmp_path: Path):
    """Two programs and two estimators (delta tracking, quadrature): also the order of the grid's axes must agree."""
    rng = np.random.default_rng(0)
    fog = Fog(12 * rng.random((4, 3, 2)) ** 3, (0.8, 0.8, 0.8), 0.3, (-0.7, -0.5, -0.3), (0.6, 0.5, 0.4))
    scene = stage.load(Model(fog=fog, lights={"studio": studio()}), 2, True, tmp_path)
    rendered = stage.render(scene, camera, 256, (0,))[..., 3]
    error = rendered - gbuffer.trace_fog(fog, camera).alpha
    inner = np.abs(error[2:-2, 2:-2])
    assert np.abs(error.mean()) < 2e-3
    assert inner.mean() < 0.02  # noise of 256 samples, at most 0.03 per pixel, and less where all or nothing is covered


def test_points_are_chosen_from_all_views_without_their_being_in_memory_together() -> None:
    """The same points, in the same order, as of one list of all."""
    generator = np.random.default_rng(0)
    views = [generator.normal(size=(count, 3)) for count in (50, 0, 700, 31)]
    chosen = sample_points([len(view) for view in views], 300, 5)
    together = np.concatenate(views)[np.random.default_rng(5).permutation(781)[:300]]
    apart = np.full((300, 3), np.nan)
    for view, (places, points) in zip(views, chosen, strict=True):
        apart[places] = view[points]
    assert np.array_equal(apart, together)
    assert sum(len(places) for places, _ in sample_points([3, 4], 300, 0)) == 7
