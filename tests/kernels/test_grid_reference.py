"""Dense trilinear interpolation against SciPy, torch's own sampler and finite differences."""

import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator

from invgraphics.kernels.reference import grid_sample


def test_equals_scipy():
    grid = torch.randn(4, 5, 6, 2, dtype=torch.float64)
    unit = torch.cat([torch.rand(50, 3), torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5]])]).double()
    axes = [np.linspace(0, 1, size) for size in grid.shape[:3]]
    expected = RegularGridInterpolator(axes, grid.numpy())(unit.numpy())
    np.testing.assert_allclose(grid_sample(unit, grid).numpy(), expected, atol=1e-12)


def test_equals_torch_with_corners_aligned_and_border_padding():
    grid = torch.randn(3, 4, 5, 2, dtype=torch.float64)
    unit = torch.rand(50, 3, dtype=torch.float64) * 1.6 - 0.3
    # torch wants channels first, z-y-x axes and coordinates in [-1, 1].
    volume = grid.permute(3, 2, 1, 0)[None]
    where = (2 * unit - 1)[None, None, None]
    expected = torch.nn.functional.grid_sample(volume, where, align_corners=True, padding_mode="border")
    torch.testing.assert_close(grid_sample(unit, grid), expected[0, :, 0, 0].T)


def test_gradients():
    grid = torch.randn(3, 2, 4, 2, dtype=torch.float64, requires_grad=True)
    unit = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(grid_sample, (unit, grid))
    assert torch.autograd.gradgradcheck(grid_sample, (unit, grid))


def test_a_single_vertex_along_an_axis_is_constant_along_it():
    grid = torch.randn(1, 2, 2, 1)
    low, high = torch.tensor([[0.0, 0.3, 0.6]]), torch.tensor([[1.0, 0.3, 0.6]])
    torch.testing.assert_close(grid_sample(low, grid), grid_sample(high, grid))
