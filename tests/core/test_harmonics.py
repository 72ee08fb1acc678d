"""Spherical harmonics against SciPy's complex ones, quadrature, the constants printed in 3DGS, and rotations."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from invgraphics.core import harmonics


def _directions(n: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64), dim=1)


def _scipy_real(directions: np.ndarray) -> np.ndarray:
    """Real functions from SciPy's complex ones, which carry the Condon-Shortley phase."""
    x, y, z = directions.T
    theta, phi = np.arccos(z), np.arctan2(y, x)
    columns = []
    for band in range(4):
        for order in range(-band, band + 1):
            value = sph_harm_y(band, abs(order), theta, phi)
            part = value.imag if order < 0 else value.real
            columns.append(part * (1 if order == 0 else np.sqrt(2)))
    return np.stack(columns, axis=1)


def test_every_function_equals_scipys():
    directions = _directions(200)
    np.testing.assert_allclose(harmonics.basis(directions, 3).numpy(), _scipy_real(directions.numpy()), atol=1e-12)


def test_constants_are_those_of_3dgs_files():
    # graphdeco-inria/gaussian-splatting, utils/sh_utils.py: result = C0 sh0 - C1 y sh1 + C1 z sh2 - C1 x sh3
    along = harmonics.basis(torch.eye(3, dtype=torch.float64), 1)
    c0, c1 = 0.28209479177387814, 0.4886025119029199
    expected = torch.tensor([[c0, 0, 0, -c1], [c0, -c1, 0, 0], [c0, 0, c1, 0]], dtype=torch.float64)
    torch.testing.assert_close(along, expected)


def test_orthonormal_by_quadrature():
    # Gauss-Legendre in cos(theta) times equal steps in phi is exact for products of two bands up to 3.
    z, weight = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * (2 * np.pi / 16)
    ring = np.sqrt(1 - z**2)
    grid = np.stack([np.outer(ring, np.cos(phi)), np.outer(ring, np.sin(phi)), np.outer(z, np.ones(16))], axis=-1)
    values = harmonics.basis(torch.from_numpy(grid.reshape(-1, 3)), 3).numpy()
    weights = np.repeat(weight, 16) * (2 * np.pi / 16)
    np.testing.assert_allclose(values.T @ (weights[:, None] * values), np.eye(16), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_coefficients_seen_from_rotated_directions(degree):
    sh = torch.randn(20, (degree + 1) ** 2, 3, dtype=torch.float64)
    directions = _directions(20)
    rotation = torch.from_numpy(Rotation.random(random_state=3).as_matrix())
    rotated = harmonics.rotate(sh, rotation)
    torch.testing.assert_close(harmonics.evaluate(rotated, directions @ rotation.T), harmonics.evaluate(sh, directions))
    torch.testing.assert_close(harmonics.rotate(rotated, rotation.T), sh)


def test_basis_is_differentiable_in_the_direction():
    assert torch.autograd.gradcheck(lambda d: harmonics.basis(d, 3), (_directions(3).requires_grad_(),))


def test_odd_sizes_are_refused():
    with pytest.raises(ValueError, match="0 to 3"):
        harmonics.basis(torch.zeros(1, 3), 4)
    with pytest.raises(ValueError, match="1, 4, 9 or 16"):
        harmonics.evaluate(torch.zeros(1, 5, 3), torch.zeros(1, 3))
