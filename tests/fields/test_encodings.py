"""Frequency and hash encodings against closed forms and finite differences."""

import math

import pytest
import torch

from invgraphics import kernels
from invgraphics.config import fill, to_table
from invgraphics.errors import InputError
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.encodings.hash import HashConfig


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
        with pytest.raises(InputError):
            fill(schema, table)
