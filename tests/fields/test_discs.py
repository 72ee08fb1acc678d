"""Gaussians as discs: reordered axes describe the same Gaussian."""

import torch

from invgraphics.core import Bounds, Context, Gaussians, Quantity
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.experiments.variants import as_shown
from invgraphics.fields.gaussian import FixedGaussians
from invgraphics.fields.similarity import with_shortest_third
from invgraphics.renderers.splatting import SplattingConfig
from invgraphics.testing import toy_scene

F64 = torch.float64


def _some(n: int) -> Gaussians:
    scales = torch.rand(n, 3, dtype=F64) + 0.1
    scales[0] = 0.5
    return Gaussians(
        torch.randn(n, 3, dtype=F64),
        torch.nn.functional.normalize(torch.randn(n, 4, dtype=F64), dim=1),
        scales,
        torch.rand(n, dtype=F64),
        torch.randn(n, 4, 3, dtype=F64),
    )


def _covariances(gaussians: Gaussians) -> torch.Tensor:
    axes = quaternion_to_matrix(gaussians.quaternions) * gaussians.scales[:, None, :]
    return axes @ axes.transpose(1, 2)


def test_the_shortest_axis_becomes_the_third_of_the_same_gaussian() -> None:
    torch.manual_seed(0)
    given = _some(40)
    assert set(given.scales.argmin(dim=1).tolist()) == {0, 1, 2}
    found = with_shortest_third(given)
    torch.testing.assert_close(_covariances(found), _covariances(given))
    assert torch.equal(found.scales[:, 2], given.scales.amin(dim=1))
    assert torch.equal(found.quaternions[0], given.quaternions[0])  # a ball's axes stay
    torch.testing.assert_close(torch.linalg.det(quaternion_to_matrix(found.quaternions)), torch.ones(40, dtype=F64))


def test_a_field_fitted_otherwise_is_shown_as_discs_without_its_shortest_axes() -> None:
    torch.manual_seed(0)
    given, scene = _some(9), toy_scene(2, 8)
    field, ctx = FixedGaussians(given), Context(Bounds(-torch.ones(3), torch.ones(3)))
    shown = as_shown(field, SplattingConfig(shape="disc").build(scene)).primitives(Quantity.GAUSSIANS, ctx)
    assert torch.equal(shown.scales[:, 2], given.scales.amin(dim=1))
    assert as_shown(field, SplattingConfig().build(scene)) is field
