"""Networks as fog of known density: alpha = 1 - exp(-sigma L) through an anisotropic box, in local length units."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from invgraphics.core import Bounds, Context
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.samplers import HierarchicalConfig, StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import toy_scene

SIGMA = 0.8
ENCODINGS = [FrequencyConfig(octaves=3), HashConfig(levels=3, log2_size=8, base=4, finest=16)]
SAMPLERS = [
    StratifiedConfig(count=7),
    HierarchicalConfig(coarse=5, fine=6),
    OccupancyConfig(resolution=8, steps_per_diagonal=50),
]


@pytest.mark.parametrize("encoding", ENCODINGS, ids=["frequency", "hash"])
@pytest.mark.parametrize("sampler", SAMPLERS, ids=["stratified", "hierarchical", "occupancy"])
@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_even_fog_has_alpha_one_minus_exp(encoding: Any, sampler: Any, activation: Any) -> None:
    bounds = Bounds(torch.tensor([-0.5, -1.0, -0.8]), torch.tensor([0.7, 0.4, 1.1]))
    scene = replace(toy_scene(views=2, size=8), bounds=bounds)
    settings = {
        "layers": 1,
        "width": 8,
        "skip": -1,
        "geometry_features": 4,
        "density_activation": activation,
        "density_bias": -1.0,
    }
    field = NeuralFieldConfig(encoding=encoding, **settings).build(scene)
    before = math.log(SIGMA) if activation == "exp" else math.log(math.expm1(SIGMA))
    with torch.no_grad():
        field.geometry_net.output.weight.zero_()
        field.geometry_net.output.bias[0] = before + 1.0  # the bias of -1 is added to it
    camera = scene.test[0].camera.resized(9, 7)
    rays = bounds.clip(camera.rays())
    length = (rays.far - rays.near).reshape(7, 9)
    with torch.no_grad():
        picture, _ = VolumetricConfig(sampler).build(scene).render_image(field, camera, Context(bounds))
    expected = 1 - torch.exp(-SIGMA * length)
    assert float(expected.max()) > 0.5
    assert float(expected.min()) == 0
    assert torch.allclose(picture.alpha, expected, atol=2e-5)
