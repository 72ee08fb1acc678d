"""A model: refused where its parts do not fit, and rendered as its renderer renders, without randomness or gradients."""

import doctest
from dataclasses import replace

import pytest
import torch
from other_device import other_device

from invgraphics.core import Context, Model, Scene, model
from invgraphics.errors import InputError, NotComposableError
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.splatting import SplattingConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import TwoBalls, toy_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return toy_scene(views=2, size=8)


@pytest.fixture
def small(scene: Scene) -> Model:
    """A network, and a sampler with state."""
    field = NeuralFieldConfig(layers=1, width=8, skip=-1, geometry_features=4, colour_width=8)
    sampler = OccupancyConfig(resolution=8, steps_per_diagonal=32)
    return Model(field.build(scene), VolumetricConfig(sampler).build(scene), scene.bounds)


def test_the_example_runs() -> None:
    found = doctest.testmod(model)
    assert found.attempted > 0
    assert found.failed == 0


def test_parts_that_do_not_fit_are_refused(scene: Scene) -> None:
    with pytest.raises(NotComposableError, match="Splatting needs gaussians, which TwoBalls does not provide"):
        Model(TwoBalls(), SplattingConfig().build(scene), scene.bounds)


@pytest.mark.parametrize("normals", [True, False])
def test_it_renders_as_its_renderer_does(small: Model, scene: Scene, normals: bool) -> None:
    picture, camera = small.render(scene.test[0].camera, normals=normals), scene.test[0].camera
    expected, _ = small.renderer.render_image(small.field, camera, Context(scene.bounds, geometry=normals))
    torch.testing.assert_close(picture.rgb, expected.rgb)
    torch.testing.assert_close(picture.depth, expected.depth)
    assert (picture.normal is not None) == normals
    assert expected.rgb.requires_grad
    assert not picture.rgb.requires_grad
    assert torch.equal(picture.rgb, small.render(camera, normals=normals).rgb)


def test_its_state_is_that_of_both_parts(small: Model, scene: Scene) -> None:
    other = Model(small.field, VolumetricConfig(OccupancyConfig(resolution=8)).build(scene), scene.bounds)
    other.renderer.sampler.step.fill_(7)  # type: ignore[union-attr]
    small.load_state_dict({**other.state_dict(), "optimiser": {}})
    assert int(small.renderer.sampler.step) == 7  # type: ignore[union-attr]
    with pytest.raises(RuntimeError, match="step"):
        small.load_state_dict({"field": small.field.state_dict()})


def test_it_moves_and_its_pictures_stay_with_the_camera(scene: Scene) -> None:
    config = VolumetricConfig(StratifiedConfig(16))
    here = Model(TwoBalls(), config.build(scene), scene.bounds).render(scene.test[0].camera)
    with other_device() as device:
        away = Model(TwoBalls(), config.build(scene), scene.bounds).to(device)
        assert away.device == device
        picture = away.render(scene.test[0].camera)
    assert picture.rgb.device.type == "cpu"
    torch.testing.assert_close(picture.rgb, here.rgb)


def test_cameras_may_be_of_another_precision(small: Model, scene: Scene) -> None:
    """NumPy's poses are float64."""
    camera = scene.test[0].camera
    picture = small.render(camera.to(torch.float64))
    assert torch.equal(picture.rgb, small.render(camera).rgb)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"width": 16.5}, "size of the camera is 16.5x"),
        ({"height": 0}, "x0 pixels"),
        ({"focal": torch.tensor(20.0)}, "shapes of the camera"),
        ({"cam_to_world": torch.eye(4) * 2}, "pose of the camera is not rigid"),
        ({"cam_to_world": torch.full((4, 4), torch.nan)}, "pose of the camera is not rigid"),
        ({"cam_to_world": torch.tensor([[1.0, 0, 0, torch.inf], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])}, "not finite"),
    ],
)
def test_cameras_that_are_none_are_refused(small: Model, scene: Scene, change: dict, sentence: str) -> None:
    camera = replace(scene.test[0].camera, **change)
    for use in (small.render, lambda one: small.contributions(one, (0, 0))):
        with pytest.raises(InputError, match=sentence):
            use(camera)
