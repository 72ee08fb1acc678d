"""A model: refused where its parts do not fit, and rendered as its renderer renders, without randomness or gradients."""

import doctest

import pytest
import torch
from other_device import other_device

from invgraphics.core import Context, Model, Scene, model
from invgraphics.errors import NotComposableError
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
