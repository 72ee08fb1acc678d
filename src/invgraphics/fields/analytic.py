"""Analytic fields with closed-form line integrals: ground truth for samplers, renderers and tests."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from math import pi

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from invgraphics.core import harmonics
from invgraphics.core.field import Field, Quantity
from invgraphics.core.rays import Rays
from invgraphics.core.samples import FieldValues, Samples

Vector = Sequence[float] | Float[Tensor, " 3"]
Colour = Sequence[float] | Float[Tensor, " 3"] | Float[Tensor, "k 3"]
"""One colour, or spherical-harmonics coefficients of a direction-dependent one (less 0.5, as in 3DGS)."""


class AnalyticField(Field):
    """Base of fields with a closed-form density and line integral, and a colour that depends on direction only.

    Args:
        colour: radiance everywhere; see `Colour`.
    """

    provides = Quantity.DENSITY | Quantity.RADIANCE

    def __init__(self, colour: Colour) -> None:
        super().__init__()
        values = torch.as_tensor(colour, dtype=torch.get_default_dtype())
        self.directional = values.ndim == 2
        self.colour = nn.Parameter(values.clone())

    @abstractmethod
    def density_at(self, position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        """Density at points, per local unit of length."""

    @abstractmethod
    def optical_depth(self, rays: Rays) -> Float[Tensor, " n"]:
        """Integral of the density along each ray from near to far; alpha is ``1 - exp(-optical_depth)``."""

    def radiance_along(self, direction: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """Colour seen along directions."""
        if not self.directional:
            return self.colour.expand(len(direction), 3)
        return (harmonics.evaluate(self.colour.expand(len(direction), -1, 3), direction) + 0.5).clamp_min(0)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`."""
        return FieldValues(
            density=self.density_at(samples.position) if Quantity.DENSITY in want else None,
            radiance=self.radiance_along(samples.direction) if Quantity.RADIANCE in want else None,
        )


class Slab(AnalyticField):
    """Constant density between two parallel planes: ``lo <= axis . x <= hi``."""

    axis: Tensor

    def __init__(self, density: float, lo: float, hi: float, axis: Vector = (0, 0, 1), colour: Colour = (1, 1, 1)) -> None:
        super().__init__(colour)
        self.lo, self.hi = lo, hi
        self.density = nn.Parameter(torch.tensor(float(density)))
        self.register_buffer("axis", normalize(_vector(axis), dim=0))

    def density_at(self, position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        """Density: the constant inside, zero outside."""
        height = position @ self.axis
        return self.density * ((height >= self.lo) & (height <= self.hi))

    def optical_depth(self, rays: Rays) -> Float[Tensor, " n"]:
        """Optical depth: density times the ray's length between the planes."""
        height, slope = rays.origins @ self.axis, rays.directions @ self.axis
        # A ray along the planes is inside all the way or never: the infinities of the division say which.
        slope = torch.where(slope == 0, torch.full_like(slope, 1e-30), slope)
        a, b = (self.lo - height) / slope, (self.hi - height) / slope
        return self.density * _overlap(rays, torch.minimum(a, b), torch.maximum(a, b))


class Sphere(AnalyticField):
    """Constant density inside a sphere, with its signed distance and normals."""

    provides = AnalyticField.provides | Quantity.SDF | Quantity.GRADIENT | Quantity.NORMAL
    centre: Tensor

    def __init__(self, density: float, radius: float, centre: Vector = (0, 0, 0), colour: Colour = (1, 1, 1)) -> None:
        super().__init__(colour)
        self.radius = radius
        self.density = nn.Parameter(torch.tensor(float(density)))
        self.register_buffer("centre", _vector(centre))

    def density_at(self, position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        """Density: the constant inside, zero outside."""
        return self.density * (self.sdf_at(position) <= 0)

    def sdf_at(self, position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        """Signed distance to the sphere, negative inside."""
        return (position - self.centre).norm(dim=1) - self.radius

    def optical_depth(self, rays: Rays) -> Float[Tensor, " n"]:
        """Optical depth: density times the length of the chord."""
        offset = self.centre - rays.origins
        middle = (offset * rays.directions).sum(dim=1)
        squared = self.radius**2 - (offset - middle[:, None] * rays.directions).square().sum(dim=1)
        half = torch.where(squared > 0, squared, torch.zeros_like(squared)).sqrt()
        return self.density * _overlap(rays, middle - half, middle + half)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`."""
        values, outward = super().query(samples, want), normalize(samples.position - self.centre, dim=1)
        return FieldValues(
            density=values.density,
            radiance=values.radiance,
            sdf=self.sdf_at(samples.position) if Quantity.SDF in want else None,
            gradient=outward if Quantity.GRADIENT in want else None,
            normal=outward if Quantity.NORMAL in want else None,
        )


class Box(AnalyticField):
    """Constant density inside an axis-aligned box, with its exact signed distance, that distance's gradient, and normals.

    Args:
        density: inside.
        half_edges: half of each edge.
        centre: of the box.
        colour: see `Colour`.
    """

    provides = AnalyticField.provides | Quantity.SDF | Quantity.GRADIENT | Quantity.NORMAL
    half_edges: Tensor
    centre: Tensor

    def __init__(self, density: float, half_edges: Vector, centre: Vector = (0, 0, 0), colour: Colour = (1, 1, 1)) -> None:
        super().__init__(colour)
        self.density = nn.Parameter(torch.tensor(float(density)))
        self.register_buffer("half_edges", _vector(half_edges))
        self.register_buffer("centre", _vector(centre))

    def density_at(self, position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        """Density: the constant inside, zero outside."""
        return self.density * (self.sdf_at(position) <= 0)

    def sdf_at(self, position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        """Signed distance to the box, negative inside."""
        beyond = (position - self.centre).abs() - self.half_edges
        return beyond.clamp_min(0).norm(dim=1) + beyond.amax(dim=1).clamp_max(0)

    def gradient_at(self, position: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """Gradient of the signed distance: towards the point from the nearest one of the box, or to the nearest face inside."""
        offset = position - self.centre
        beyond = offset.abs() - self.half_edges
        nearest = torch.nn.functional.one_hot(beyond.argmax(dim=1), 3).to(position)
        outside = (beyond > 0).any(dim=1, keepdim=True)
        return offset.sign() * torch.where(outside, normalize(beyond.clamp_min(0), dim=1), nearest)

    def optical_depth(self, rays: Rays) -> Float[Tensor, " n"]:
        """Optical depth: density times the ray's length inside."""
        slope = torch.where(rays.directions == 0, torch.full_like(rays.directions, 1e-30), rays.directions)
        a, b = (self.centre + sign * self.half_edges - rays.origins for sign in (-1, 1))
        enter, leave = torch.minimum(a / slope, b / slope).amax(dim=1), torch.maximum(a / slope, b / slope).amin(dim=1)
        return self.density * _overlap(rays, enter, leave.maximum(enter))

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`."""
        values, gradient = super().query(samples, want), self.gradient_at(samples.position)
        return FieldValues(
            density=values.density,
            radiance=values.radiance,
            sdf=self.sdf_at(samples.position) if Quantity.SDF in want else None,
            gradient=gradient if Quantity.GRADIENT in want else None,
            normal=gradient if Quantity.NORMAL in want else None,
        )


class GaussianBlob(AnalyticField):
    """Density ``peak * exp(-(x - centre)^T covariance^-1 (x - centre) / 2)``.

    Args:
        peak: density at the centre.
        covariance: covariance matrix, or one variance for all directions.
        centre: position of the peak.
        colour: see `Colour`.
    """

    def __init__(
        self,
        peak: float,
        covariance: float | Float[Tensor, "3 3"],
        centre: Vector = (0, 0, 0),
        colour: Colour = (1, 1, 1),
    ) -> None:
        super().__init__(colour)
        matrix = covariance if isinstance(covariance, Tensor) else covariance * torch.eye(3)
        self.peak = nn.Parameter(torch.tensor(float(peak)))
        self.covariance = nn.Parameter(matrix.to(torch.get_default_dtype()).clone())
        self.centre = nn.Parameter(_vector(centre))

    def density_at(self, position: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        """Density of the Gaussian at points."""
        offset = position - self.centre
        return self.peak * torch.exp(-self._product(offset, offset) / 2)

    def optical_depth(self, rays: Rays) -> Float[Tensor, " n"]:
        """Optical depth by the error function: a Gaussian restricted to a line is a Gaussian.

        With the exponent ``-(a t^2 + 2 b t + c) / 2`` along the ray, completed to ``-(a (t + b/a)^2 + c - b^2/a) / 2``.
        """
        offset = rays.origins - self.centre
        a = self._product(rays.directions, rays.directions)
        b = self._product(rays.directions, offset)
        c = self._product(offset, offset)
        along = torch.erf((a / 2).sqrt() * (rays.far + b / a)) - torch.erf((a / 2).sqrt() * (rays.near + b / a))
        return self.peak * torch.exp(-(c - b * b / a) / 2) * (pi / (2 * a)).sqrt() * along

    def _product(self, u: Float[Tensor, "m 3"], v: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
        """``u^T covariance^-1 v``, row by row."""
        return (u * torch.linalg.solve(self.covariance, v.T).T).sum(dim=1)


def _vector(values: Vector) -> Float[Tensor, " 3"]:
    return torch.as_tensor(values, dtype=torch.get_default_dtype()).clone()


def _overlap(rays: Rays, enter: Float[Tensor, " n"], leave: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Length of the part of [near, far] that lies in [enter, leave]."""
    return (torch.minimum(leave, rays.far) - torch.maximum(enter, rays.near)).clamp_min(0)
