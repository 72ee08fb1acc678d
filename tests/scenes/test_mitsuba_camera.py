"""Mitsuba sees things where our camera says they are: the one test that ties both programs' conventions together."""

import numpy as np
import pytest
import torch

from invgraphics.core import Camera
from invgraphics.core.transforms import look_at
from invgraphics.scenes.mitsuba import stage

WIDTH, HEIGHT = 96, 64
CAMERAS = (
    # eye, target, focal, principal point: both far from the middle, to different sides
    ((2.4, -1.1, 1.3), (0.1, 0.05, -0.1), 110.0, (41.3, 38.9)),
    ((-1.7, 1.9, -0.6), (-0.05, 0.1, 0.05), 95.0, (55.6, 25.2)),
)
BALLS = ((-0.25, 0.2, 0.15), (0.3, -0.15, -0.2), (0.1, 0.3, 0.05))
RADIUS = 0.02


def _camera(eye, target, focal, centre) -> Camera:
    pose = look_at(*(torch.tensor(v, dtype=torch.float64) for v in (eye, target, (0.0, 0.0, 1.0))))
    return Camera(pose, torch.tensor([focal, focal]).double(), torch.tensor(centre).double(), WIDTH, HEIGHT)


def _scene(mitsuba):
    """Balls that glow in pure red, green and blue, so that each has a channel of its own."""
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 2}}
    for channel, place in enumerate(BALLS):
        radiance = [0.0, 0.0, 0.0]
        radiance[channel] = 1.0
        glow = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
        scene[f"ball{channel}"] = {"type": "sphere", "center": list(place), "radius": RADIUS, "emitter": glow}
    return mitsuba.load_dict(scene)


@pytest.mark.parametrize("number", range(len(CAMERAS)))
def test_balls_appear_where_the_camera_projects_them(number):
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    camera = _camera(*CAMERAS[number])
    image = stage.render(_scene(mitsuba), camera, 256, (0,))[..., :3].astype(np.float64)
    expected, _ = camera.project(torch.tensor(BALLS).double())
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for channel in range(3):
        weight = image[..., channel]
        assert weight.sum() > 1  # in the picture
        found = np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()
        np.testing.assert_allclose(found, expected[channel].numpy(), atol=0.1)


def test_coverage_of_a_ball_is_its_exact_area():
    """Box filter and hidden lights: the sum of alpha is the area of the projected disc (an ellipse, by its cone)."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    camera = _camera((2.0, 0.0, 0.0), (0.0, 0.0, 0.0), 100.0, (WIDTH / 2, HEIGHT / 2))
    ball = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse"}}
    integrator = {"type": "path", "max_depth": 2, "hide_emitters": True}
    scene = mitsuba.load_dict({"type": "scene", "integrator": integrator, "sky": {"type": "constant"}, "ball": ball})
    alpha = stage.render(scene, camera, 256, (0,))[..., 3].astype(np.float64)
    radius = 100.0 * np.tan(np.arcsin(0.4 / 2.0))
    assert alpha.sum() == pytest.approx(np.pi * radius**2, rel=2e-3)
    assert alpha[0, 0] == 0


def test_pixels_that_are_not_square_are_refused():
    camera = _camera(*CAMERAS[0])
    stretched = Camera(camera.cam_to_world, torch.tensor([100.0, 90.0]), camera.principal_point, WIDTH, HEIGHT)
    with pytest.raises(ValueError, match="square"):
        stage.sensor(stretched)
