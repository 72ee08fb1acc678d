"""Nearest points within a radius equal those of scipy's k-d tree, in every implementation."""

import subprocess
import sys

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


CRASH = """
import torch
from invgraphics.kernels.near import near_points
generator = torch.Generator().manual_seed(0)
points, position = torch.rand(200, 3, generator=generator), torch.rand(50, 3, generator=generator)
for value in (torch.nan, torch.inf, -torch.inf, 1e30, -3e38):
    points[3, 0], position[7, 1] = value, value
    points[5] = position[5] = torch.full((3,), 2e38)
    index, squared = near_points(position, points, 4, 0.3)
    print(*index.flatten().tolist(), float(squared[squared.isfinite()].sum()))
"""


@pytest.mark.skipif("numba" not in IMPLEMENTATIONS, reason="Numba does not work here")
def test_points_that_are_not_finite_or_far_away_disturb_no_others() -> None:
    """In a process of its own: foreign memory was written. A point far beyond the others is near itself."""
    done = subprocess.run([sys.executable, "-c", CRASH], capture_output=True, text=True, check=False, timeout=400)
    assert done.returncode == 0, done.stderr[-2000:]
    lines = iter(done.stdout.splitlines())
    generator = torch.Generator().manual_seed(0)
    points, position = (torch.rand(n, 3, generator=generator).double().numpy() for n in (200, 50))
    for value in (np.nan, np.inf, -np.inf, 1e30, -3e38):
        points[3, 0], position[7, 1] = value, value
        points[5] = position[5] = np.float32(2e38)
        difference = position[:, None] - points
        squared = np.where(np.isfinite(difference).all(axis=2), (difference**2).sum(axis=2), np.inf)
        order = np.argsort(squared, axis=1, kind="stable")[:, :4]
        found = np.take_along_axis(squared, order, axis=1) <= 0.3**2
        *index, total = next(lines).split()
        np.testing.assert_array_equal(np.array(index, int).reshape(50, 4), np.where(found, order, -1))
        assert float(total) == pytest.approx(np.take_along_axis(squared, order, axis=1)[found].sum(), rel=1e-4)
