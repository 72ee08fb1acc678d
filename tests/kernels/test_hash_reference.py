"""The reference hash encoding against an independent slow one, finite differences and the dense grid."""

import itertools

import numpy as np
import pytest
import torch

from invgraphics.core.lattice import Lattice
from invgraphics.core.ngp import HashGrid
from invgraphics.kernels.reference import hash_encode, lattice_encode
from invgraphics.kernels.reference.hash import entry_index

TINY = HashGrid(levels=3, features=2, log2_size=6, base=2, finest=9)
"""One dense level (27 vertices) and two hashed ones."""


def _slow_encode(unit: np.ndarray, table: np.ndarray, grid: HashGrid) -> np.ndarray:
    """Point by point, level by level, corner by corner, in NumPy's own 32-bit arithmetic."""
    primes = np.array([1, 2654435761, 805459861], dtype=np.uint32)
    out = np.zeros((len(unit), grid.levels * grid.features))
    offset = 0
    for level, r in enumerate(grid.resolutions):
        dense = (r + 1) ** 3 <= 2**grid.log2_size
        for i, point in enumerate(unit):
            position = np.clip(point, 0, 1) * r
            lower = np.minimum(np.floor(position), r - 1).astype(int)
            total = np.zeros(grid.features)
            for corner in itertools.product((0, 1), repeat=3):
                vertex = lower + np.array(corner)
                weight = np.prod([f if c else 1 - f for c, f in zip(corner, position - lower, strict=True)])
                if dense:
                    index = vertex[0] + (r + 1) * (vertex[1] + (r + 1) * vertex[2])
                else:
                    with np.errstate(over="ignore"):
                        x, y, z = vertex.astype(np.uint32) * primes
                    index = int(x ^ y ^ z) % 2**grid.log2_size
                total += weight * table[offset + index]
            out[i, level * grid.features : (level + 1) * grid.features] = total
        offset += (r + 1) ** 3 if dense else 2**grid.log2_size
    return out


def _inputs(points: int = 40, grid: HashGrid = TINY) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.rand(points, 3, dtype=torch.float64), torch.randn(grid.entries, grid.features, dtype=torch.float64)


@pytest.mark.parametrize("grid", [TINY, HashGrid(4, 3, 10, 16, 300), HashGrid(1, 1, 4, 5, 5)])
def test_equals_the_slow_one(grid):
    unit, table = _inputs(grid=grid)
    edges = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5], [-0.3, 0.2, 1.7]], dtype=torch.float64)
    unit = torch.cat([unit, edges])
    features, jacobian = hash_encode(unit, table, grid)
    assert jacobian is None
    np.testing.assert_allclose(features.numpy(), _slow_encode(unit.numpy(), table.numpy(), grid), atol=1e-12)


def test_hash_wraps_at_32_bits():
    vertices = torch.tensor([[3, 1_000_003, 999_983], [0, 2, 0], [524_287, 524_287, 524_287]])
    with np.errstate(over="ignore"):
        words = vertices.numpy().astype(np.uint32) * np.array([1, 2654435761, 805459861], dtype=np.uint32)
    expected = (words[:, 0] ^ words[:, 1] ^ words[:, 2]).astype(np.int64)
    # A table of 2^32 entries would show every bit of the word; the edge is too long for a dense level.
    np.testing.assert_array_equal(entry_index(vertices, 2**20, 32).numpy(), expected)


def test_dense_indices_fill_the_level():
    r = 4
    axis = torch.arange(r + 1)
    vertices = torch.cartesian_prod(axis, axis, axis)
    assert sorted(entry_index(vertices, r, 7).tolist()) == list(range((r + 1) ** 3))


def test_gradients_in_table_and_position():
    unit, table = _inputs(4)
    encode = lambda u, t: hash_encode(u, t, TINY)[0]  # noqa: E731
    assert torch.autograd.gradcheck(encode, (unit.requires_grad_(), table.requires_grad_()))


def test_jacobian_is_the_derivative_and_differentiable_in_the_table():
    unit, table = _inputs(5)
    step = 1e-6
    _, jacobian = hash_encode(unit, table, TINY, jacobian=True)
    assert jacobian is not None
    for axis in range(3):
        shift = step * torch.eye(3, dtype=torch.float64)[axis]
        ahead, behind = (hash_encode(unit + sign * shift, table, TINY)[0] for sign in (1, -1))
        torch.testing.assert_close(jacobian[..., axis], (ahead - behind) / (2 * step), atol=1e-6, rtol=1e-6)
    of_table = lambda t: hash_encode(unit, t, TINY, jacobian=True)[1]  # noqa: E731
    assert torch.autograd.gradcheck(of_table, (table.requires_grad_(),))


def test_clamped_positions_do_not_move_features():
    _, table = _inputs()
    unit = torch.tensor([[1.5, 0.3, 0.4], [0.2, -2.0, 0.9]], dtype=torch.float64, requires_grad=True)
    features, jacobian = hash_encode(unit, table, TINY, jacobian=True)
    assert jacobian is not None
    (gradient,) = torch.autograd.grad(features.sum(), unit)
    assert gradient[0, 0] == 0
    assert gradient[1, 1] == 0
    torch.testing.assert_close(jacobian.sum(dim=1), gradient)


def test_slopes_on_the_far_faces_are_those_of_the_last_cell():
    _, table = _inputs()
    faces, step = torch.ones(1, 3, dtype=torch.float64), 1e-6
    _, jacobian = hash_encode(faces, table, TINY, jacobian=True)
    assert jacobian is not None
    for axis in range(3):
        behind = faces - step * torch.eye(3, dtype=torch.float64)[axis]
        difference = (hash_encode(faces, table, TINY)[0] - hash_encode(behind, table, TINY)[0]) / step
        torch.testing.assert_close(jacobian[..., axis], difference, atol=1e-6, rtol=1e-6)


def test_a_dense_level_is_a_grid():
    r = 6
    grid = HashGrid(levels=1, features=4, log2_size=10, base=r, finest=r)
    unit, table = _inputs(100, grid)
    # The table runs x fastest, the grid z fastest.
    dense = table.reshape(r + 1, r + 1, r + 1, 4).permute(2, 1, 0, 3)
    torch.testing.assert_close(hash_encode(unit, table, grid)[0], lattice_encode(unit, [Lattice(dense)]))


def test_no_points():
    features, jacobian = hash_encode(torch.zeros(0, 3), torch.zeros(TINY.entries, 2), TINY, jacobian=True)
    assert features.shape == (0, 6)
    assert jacobian is not None
    assert jacobian.shape == (0, 6, 3)
