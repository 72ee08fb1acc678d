"""Signed distances in one pass against the network in float64, and where a field uses them."""

import pytest
import torch
from test_sphere_trace import ENCODINGS, case, exact

from invgraphics.core import Samples
from invgraphics.core.field import Quantity
from invgraphics.kernels import numba, reference, using


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize("count", [1, 31, 1000])
def test_equals_the_network_in_float64_inside_the_box_and_outside(encoding: str, layers: int, count: int) -> None:
    _, fused, bounds, _ = case(encoding, layers)
    position = bounds.from_unit(1.4 * torch.rand(count, 3) - 0.2)
    true = reference.sdf_values(position.double(), bounds.to(torch.float64), exact(fused))
    torch.testing.assert_close(numba.sdf_values(position, bounds, fused).double(), true, atol=5e-6, rtol=1e-5)


def test_no_positions_have_no_distances() -> None:
    _, fused, bounds, _ = case("hash")
    assert numba.sdf_values(torch.zeros(0, 3), bounds, fused).shape == (0,)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_field_has_the_same_distances_with_and_without_a_gradient(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    field, _, bounds, _ = case(encoding)
    samples = Samples.at(bounds.from_unit(torch.rand(257, 3)))
    with_gradient = field.query(samples, Quantity.SDF).sdf
    assert with_gradient is not None
    assert with_gradient.requires_grad
    calls = []
    original = numba.sdf_values
    monkeypatch.setattr(numba, "sdf_values", lambda *args: calls.append(args) or original(*args))
    without = field.query_no_grad(samples, Quantity.SDF).sdf
    assert len(calls) == 1, "the fused kernel was not used"
    torch.testing.assert_close(without, with_gradient.detach(), atol=5e-6, rtol=1e-5)
    with using("reference"):
        assert field.query_no_grad(samples, Quantity.SDF).sdf is not None
    assert len(calls) == 1, "the fused kernel was used although the reference is forced"
