"""Frequency and hash encodings against closed forms and finite differences."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from invgraphics import kernels
from invgraphics.config import fill, to_table
from invgraphics.core import Camera
from invgraphics.errors import InputError
from invgraphics.fields.density_field import DensityFieldConfig
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.testing import toy_scene


@pytest.mark.parametrize("include", [True, False])
def test_frequency_closed_form(include):
    encoding = FrequencyConfig(octaves=3, include_input=include).build()
    unit = torch.rand(4, 3, dtype=torch.float64)
    features = encoding(unit)
    assert features.shape == (4, encoding.width)
    for row, point in zip(features.tolist(), unit.tolist(), strict=True):
        x = [2 * u - 1 for u in point]
        expected = list(x) if include else []
        expected += [math.sin(2**k * math.pi * value) for k in range(3) for value in x]
        expected += [math.cos(2**k * math.pi * value) for k in range(3) for value in x]
        assert row == pytest.approx(expected, abs=1e-12)


def test_frequency_without_octaves_is_the_input():
    unit = torch.rand(4, 3)
    torch.testing.assert_close(FrequencyConfig(octaves=0).build()(unit), 2 * unit - 1)


def test_hash_starts_small_and_reads_the_table():
    encoding = HashConfig(levels=2, log2_size=8, base=2, finest=16).build()
    assert encoding.width == 4
    assert dict(encoding.named_parameters()).keys() == {"table"}
    assert 0.9e-4 < float(encoding.table.detach().abs().max()) <= 1e-4
    unit = torch.rand(10, 3)
    torch.testing.assert_close(encoding(unit), kernels.hash_encode(unit, encoding.table, encoding.grid)[0])


def test_hash_gradients_of_both_orders():
    """Table and position gradients, and the table gradient of the position gradient, as an eikonal loss needs it."""
    encoding = HashConfig(levels=2, features=2, log2_size=5, base=2, finest=5).build().double()
    torch.nn.init.normal_(encoding.table)
    unit = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    swapped = lambda u, t: torch.func.functional_call(encoding, {"table": t}, (u,))  # noqa: E731
    assert torch.autograd.gradcheck(swapped, (unit, encoding.table))

    def steepness(table: torch.Tensor) -> torch.Tensor:
        features = swapped(unit, table)
        (slope,) = torch.autograd.grad(features.square().sum(), unit, create_graph=True)
        return slope.norm(dim=1)

    assert torch.autograd.gradcheck(steepness, (encoding.table,))


def test_a_hash_grid_ends_at_the_pixels():
    """Never finer than asked for nor than pixels, never coarser than its base, and as gradual as before."""
    grid = HashConfig(levels=10, base=16, finest=1024)
    assert grid.resolved(115.0) == grid
    for spacing, pixels in ((1.0, 115.0), (2.0, 115.0), (0.5, 301.7), (1.0, 1023.0), (1.0, 17.0)):
        limited = replace(grid, min_spacing=spacing).resolved(pixels)
        assert limited.resolutions[0] == 16 and limited.resolutions[-1] == limited.finest == int(pixels / spacing)
        growths = [fine / coarse for coarse, fine in pairwise(limited.resolutions)]
        assert max(growths) <= 64 ** (1 / 9) + 1 / 16 and limited.levels < 11
    assert replace(grid, min_spacing=1.0).resolved(10.0).resolutions == (16,)
    assert replace(grid, min_spacing=1.0).resolved(1024.0).resolutions == grid.resolutions
    one = HashConfig(levels=1, base=16, finest=16, min_spacing=1.0)
    assert one.resolved(10.0) == one


@pytest.mark.parametrize("slot", ["field", "renderer.sampler.fields"])
def test_grids_of_fields_have_cells_of_a_pixel(slot):
    """A camera at distance d with focal length f sees a box of edge e as e f / d pixels; without views there is no limit."""
    scene = toy_scene(views=1, size=4)
    pose = torch.eye(4)
    pose[2, 3] = -400.0
    far = Camera(pose, torch.tensor([8000.0, 8000.0]), torch.tensor([2.0, 2.0]), 4, 4)
    scene = replace(scene, train=(replace(scene.train[0], camera=far),))
    grid = HashConfig(levels=4, log2_size=10, base=8, finest=512, min_spacing=0.5)
    config = NeuralFieldConfig(grid, appearance=grid) if slot == "field" else DensityFieldConfig(grid)
    field = config.build(scene)
    for encoding in (field.encoding, getattr(field, "appearance", None)):
        assert encoding is None or encoding.grid.finest == pytest.approx(2 * 8000 / 400 / 0.5, rel=0.01)
    assert config.build(replace(scene, train=())).encoding.grid.finest == 512


def test_same_seed_same_table():
    tables = []
    for _ in range(2):
        torch.manual_seed(5)
        tables.append(HashConfig(levels=1).build().table)
    assert torch.equal(*tables)


def test_configs_survive_a_round_trip_and_refuse_nonsense():
    for config in (FrequencyConfig(octaves=4), HashConfig(log2_size=12)):
        assert fill(type(config), to_table(config)) == config
    for schema, table in (
        (FrequencyConfig, {"octaves": -1}),
        (HashConfig, {"base": 64, "finest": 32}),
        (HashConfig, {"levels": 0}),
    ):
        with pytest.raises(InputError) as caught:
            fill(schema, table)
        assert "Unknown key" not in caught.value.sentence
