"""Nearest points within a radius equal those of scipy's k-d tree, in every implementation."""

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from invgraphics import kernels
from invgraphics.kernels.near import near_points

IMPLEMENTATIONS = kernels.dispatch.cpu_implementations()


def expected(position: torch.Tensor, points: torch.Tensor, count: int, radius: float) -> tuple[np.ndarray, np.ndarray]:
    distance, index = KDTree(points.double().numpy()).query(
        position.double().numpy(), k=list(range(1, count + 1)), distance_upper_bound=radius
    )
    return np.where(np.isinf(distance), -1, index), distance**2


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize(("n", "radius", "count"), [(2000, 0.08, 8), (2000, 0.4, 3), (5, 0.9, 8), (300, 1e-3, 2)])
def test_neighbours_are_the_k_d_trees(implementation: str, n: int, radius: float, count: int) -> None:
    generator = torch.Generator().manual_seed(n)
    points = torch.rand(n, 3, generator=generator) * torch.tensor([1.0, 2.0, 0.3]) - 0.4
    # Inside the points' box, beyond it, and on a point.
    position = torch.cat([torch.rand(500, 3, generator=generator) * 3 - 1, points[:7]])
    with kernels.using(implementation):
        index, squared = near_points(position, points, count, radius)
    index_tree, squared_tree = expected(position, points, count, radius)
    # float32 may decide otherwise at the very radius, and between distances that agree to rounding.
    certain = np.abs(squared_tree - radius**2) > 1e-5 * radius**2
    assert certain.mean() > 0.99
    np.testing.assert_array_equal((index.numpy() >= 0)[certain], (index_tree >= 0)[certain])
    both = (index.numpy() >= 0) & (index_tree >= 0)
    np.testing.assert_allclose(squared.numpy()[both], squared_tree[both], rtol=1e-4, atol=1e-9)
    assert (index.numpy()[both] == index_tree[both]).mean() > 0.999
    assert np.isinf(squared.numpy()[index.numpy() < 0]).all()


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_ties_go_to_the_lower_index_and_nothing_gives_nothing(implementation: str) -> None:
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    with kernels.using(implementation):
        index, squared = near_points(torch.zeros(1, 3), corners, 3, 2.0)
        none, far = near_points(torch.zeros(2, 3), corners[:0], 3, 2.0)
        empty, _ = near_points(corners[:0], corners, 3, 2.0)
    assert index.tolist() == [[0, 1, 2]]
    assert squared.tolist() == [[3.0, 3.0, 3.0]]
    assert bool((none == -1).all())
    assert bool(far.isinf().all())
    assert empty.shape == (0, 3)
