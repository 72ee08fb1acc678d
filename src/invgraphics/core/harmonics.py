"""Real spherical harmonics of bands 0 to 3, in the order and with the signs of 3D Gaussian Splatting.

Within band l the orders run m = -l .. l. The signs are those of the Condon-Shortley phase (band 1 is -y, +z, -x), so that the
coefficients in 3DGS files can be exchanged with ours. The functions are orthonormal over the sphere.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 3
"""Highest band there is: 16 functions."""

BAND_0 = sqrt(1 / (4 * pi))
"""The constant function's value."""
_FIBONACCI_POINTS = 64


def count(degree: int) -> int:
    """Number of functions in bands 0 to ``degree``."""
    return (degree + 1) ** 2


def basis(directions: Float[Tensor, "n 3"], degree: int) -> Float[Tensor, "n k"]:
    """All functions of bands 0 to ``degree`` at unit directions, k = (degree + 1)^2.

    Raises:
        ValueError: ``degree`` is not in 0 to 3.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"Spherical harmonics have degree 0 to {MAX_DEGREE} here, not {degree}.")
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    columns = [torch.full_like(x, BAND_0)]
    if degree >= 1:
        c = sqrt(3 / (4 * pi))
        columns += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = sqrt(15 / (4 * pi))
        columns += [
            c * x * y,
            -c * y * z,
            sqrt(5 / (16 * pi)) * (2 * zz - xx - yy),
            -c * x * z,
            c / 2 * (xx - yy),
        ]
    if degree >= 3:
        c1, c2, c3 = sqrt(21 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(35 / (32 * pi))
        columns += [
            -c3 * y * (3 * xx - yy),
            c2 * x * y * z,
            -c1 * y * (4 * zz - xx - yy),
            sqrt(7 / (16 * pi)) * z * (2 * zz - 3 * xx - 3 * yy),
            -c1 * x * (4 * zz - xx - yy),
            c2 / 2 * z * (xx - yy),
            -c3 * x * (xx - 3 * yy),
        ]
    return torch.stack(columns, dim=-1)


def degree_of(coefficients: int) -> int:
    """The degree whose number of functions is ``coefficients``.

    Raises:
        ValueError: it is not 1, 4, 9 or 16.
    """
    degree = round(sqrt(coefficients)) - 1
    if count(degree) != coefficients or not 0 <= degree <= MAX_DEGREE:
        raise ValueError(
            f"{coefficients} spherical-harmonics coefficients are no whole number of bands: expected 1, 4, 9 or 16."
        )
    return degree


def constant(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Coefficients of degree 0 whose `colour` is ``rgb`` in every direction."""
    return ((rgb - 0.5) / BAND_0)[:, None, :]


def evaluate(sh: Float[Tensor, "n k 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """The functions with coefficients ``sh`` at one unit direction each. `colour` makes radiance of it."""
    return torch.einsum("nk,nkc->nc", basis(directions, degree_of(sh.shape[1])), sh)


def colour(sh: Float[Tensor, "n k 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Radiance max(0, 0.5 + Σ c Y) at one unit direction each (3DGS), with the gradient of a projection onto [0, ∞).

    Where a channel is cut off, a gradient that would raise it passes unchanged and one that would lower it further is zero, so
    that gradient descent can bring a black primitive back.
    """
    return non_negative(evaluate(sh, directions) + 0.5)


def non_negative(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """``max(0, x)`` with the gradient of a projection: below zero only what would raise x passes."""
    return _NonNegative.apply(x)  # type: ignore[no-any-return]


class _NonNegative(torch.autograd.Function):
    """``max(0, x)``; its backward pass drops only the descent steps that lead further below zero."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return x.clamp_min(0.0)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0])

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        (x,), (gradient,) = ctx.saved_tensors, grad_outputs
        return torch.where((x > 0) | (gradient < 0), gradient, 0.0)


def rotate(sh: Float[Tensor, "n k 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """Coefficients of the rotated functions: ``evaluate(rotate(sh, R), R d) == evaluate(sh, d)``.

    Bands are closed under rotation, so the linear map between coefficients is exact; it is found by least squares on
    directions spread over the sphere, in float64.
    """
    degree = degree_of(sh.shape[1])
    directions = _fibonacci_sphere(_FIBONACCI_POINTS).to(rotation.device)
    turned = directions @ rotation.double().T
    matrix = torch.linalg.lstsq(basis(turned, degree), basis(directions, degree)).solution
    return torch.einsum("jk,nkc->njc", matrix.to(sh.dtype), sh)


def _fibonacci_sphere(points: int) -> Float[Tensor, "points 3"]:
    """Evenly spread unit directions (golden-angle spiral), float64."""
    index = torch.arange(points, dtype=torch.float64) + 0.5
    z = 1 - 2 * index / points
    angle = index * (pi * (3 - sqrt(5)))
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=1)
