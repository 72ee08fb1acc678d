"""Radiance of a signed distance's field in one pass against the networks in float64, and where a field uses it."""

from dataclasses import replace
from typing import Any, Literal

import pytest
import torch
from torch.nn.functional import normalize

from invgraphics.core import Bounds, Samples
from invgraphics.core.field import Quantity
from invgraphics.core.ngp import FusedSDF
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.neural import NeuralField, NeuralFieldConfig
from invgraphics.kernels import numba, reference, using
from invgraphics.testing import perturb

GRID = HashConfig(levels=4, log2_size=10, base=4, finest=24)
OWN = HashConfig(levels=3, log2_size=9, base=5, finest=17)
BOUNDS = Bounds(torch.tensor([-1.0, -0.9, -1.2]), torch.tensor([1.0, 1.1, 1.0]))
PLAIN: dict[str, Any] = {"layers": 2, "width": 19, "skip": -1, "geometry_features": 3, "colour_width": 9, "direction": "sh"}
CASES: dict[str, tuple[dict[str, Any], Literal["srgb", "linear"]]] = {
    "own grid": ({"encoding": GRID, "appearance": OWN, "direction_degree": 3, "colour_layers": 2}, "srgb"),
    "one grid, linear": ({"encoding": GRID}, "linear"),
    "octaves, no direction": ({"encoding": FrequencyConfig(4), "direction": "none"}, "srgb"),
    "no geometry features": ({"encoding": GRID, "appearance": OWN, "geometry_features": 0}, "srgb"),
    "linear map": ({"encoding": GRID, "colour_layers": 0, "layers": 1}, "srgb"),
}
OTHERS: dict[str, dict[str, Any]] = {
    "normals": {"colour_inputs": ("normal",)},
    "octaves of directions": {"direction": "frequency"},
    "octaves of features": {"feature_octaves": 1},
    "a linear map of its grid": {"appearance": OWN, "appearance_basis": 4},
    "another grid": {"appearance": FrequencyConfig(2)},
    "wider entries": {"appearance": replace(OWN, features=4)},
    "a padded sigmoid": {"colour_padding": 0.001},
}


def case(name: str) -> tuple[NeuralField, FusedSDF]:
    settings, colour = CASES[name]
    torch.manual_seed(5)
    field = NeuralField(NeuralFieldConfig(geometry="sdf", **(PLAIN | settings)), BOUNDS, colour)
    perturb(field, 0.2)
    fused = field.fused_sdf(BOUNDS)
    assert fused is not None
    assert fused.colour is not None
    return field, fused


def views(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions in the box and a little outside, and directions."""
    torch.manual_seed(7)
    return BOUNDS.from_unit(1.2 * torch.rand(count, 3) - 0.1), normalize(torch.randn(count, 3), dim=1)


def exact(fused: FusedSDF) -> FusedSDF:
    def doubled(net: tuple[tuple[torch.Tensor, torch.Tensor], ...]) -> tuple[tuple[torch.Tensor, torch.Tensor], ...]:
        return tuple((weight.double(), bias.double()) for weight, bias in net)

    assert fused.colour is not None
    nets = {"geometry_net": doubled(fused.colour.geometry_net), "net": doubled(fused.colour.net)}
    colour = replace(fused.colour, table=fused.colour.table.double(), **nets)
    scale = fused.coordinate_scale.double()
    return replace(fused, table=fused.table.double(), net=doubled(fused.net), coordinate_scale=scale, colour=colour)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("count", [1, 31, 1000])
def test_equals_the_networks_in_float64(name: str, count: int) -> None:
    _, fused = case(name)
    position, direction = views(count)
    true = reference.sdf_radiance(position.double(), direction.double(), BOUNDS.to(torch.float64), exact(fused))
    torch.testing.assert_close(numba.sdf_radiance(position, direction, BOUNDS, fused).double(), true, atol=1e-5, rtol=1e-5)
    assert numba.sdf_radiance(position[:0], direction[:0], BOUNDS, fused).shape == (0, 3)


@pytest.mark.parametrize("name", CASES)
def test_a_field_has_the_same_radiance_with_and_without_a_graph(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    field, _ = case(name)
    samples = Samples.at(*views(300))
    calls: list[Any] = []
    original = numba.sdf_radiance
    monkeypatch.setattr(numba, "sdf_radiance", lambda *args: calls.append(args) or original(*args))
    in_graph = field.query(samples, Quantity.RADIANCE).radiance
    assert in_graph is not None
    assert in_graph.requires_grad
    assert not calls
    without = field.query_no_grad(samples, Quantity.RADIANCE).radiance
    assert len(calls) == 1, "the fused kernel was not used"
    torch.testing.assert_close(without, in_graph.detach(), atol=1e-5, rtol=1e-5)
    with using("reference"):
        assert field.query_no_grad(samples, Quantity.RADIANCE).radiance is not None
    assert len(calls) == 1, "the fused kernel was used although the reference is forced"
    assert float(in_graph.detach().std(dim=0).amin()) > 1e-3, "colours hardly differ"


@pytest.mark.parametrize("name", OTHERS)
def test_colours_that_see_more_are_left_to_the_networks(name: str) -> None:
    torch.manual_seed(5)
    field = NeuralField(NeuralFieldConfig(geometry="sdf", **(PLAIN | {"encoding": GRID} | OTHERS[name])), BOUNDS)
    fused = field.fused_sdf(BOUNDS)
    assert fused is not None
    assert fused.colour is None
    samples = Samples.at(*views(40))
    expected = field.query(samples, Quantity.RADIANCE).radiance
    assert expected is not None
    torch.testing.assert_close(field.query_no_grad(samples, Quantity.RADIANCE).radiance, expected.detach())


def test_known_features_are_not_evaluated_again(monkeypatch: pytest.MonkeyPatch) -> None:
    field, _ = case("one grid, linear")
    samples = Samples.at(*views(20))
    features = field.query_no_grad(samples, Quantity.FEATURES).features
    assert features is not None
    monkeypatch.setattr(numba, "sdf_radiance", lambda *_: pytest.fail("features were known"))
    known = field.query_no_grad(replace(samples, features=2 * features), Quantity.RADIANCE).radiance
    assert known is not None
    assert (
        float((known - field.query_no_grad(replace(samples, features=features), Quantity.RADIANCE).radiance).abs().amax())
        > 1e-3
    )
