"""Densities derived from a signed distance: Laplace's distribution (VolSDF), the logistic one (NeuS).

Both rise across the surface over a width, and both have closed-form integrals along a line on which the SDF is linear.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus
from typing_extensions import override

from invgraphics.core import Field, FieldValues, Quantity, Samples

Slopes = Literal["gradient", "neighbours", "steepest", "pointwise"]
"""Where the derivative of the signed distance along a ray comes from; see `DistanceDensity`."""

_SHORT = 1e-3
"""Change of the signed distance over an interval, relative to β, below which the density at its middle stands for its mean."""


def laplace_density(sdf: Float[Tensor, "*m"], beta: Float[Tensor, "*#m"]) -> Float[Tensor, "*m"]:
    """Density Ψ(-sdf) / β with the CDF Ψ of Laplace's distribution of zero mean and scale β (VolSDF, equations 2 and 3).

    Per unit of length of ``sdf``: 1 / (2 β) on the surface, 1 / β deep inside.
    """
    tail = 0.5 * torch.exp(-sdf.abs() / beta)
    return torch.where(sdf > 0, tail, 1 - tail) / beta


def laplace_optical_depth(
    sdf: Float[Tensor, "*m"], slope: Float[Tensor, "*m"], delta: Float[Tensor, "*m"], beta: Float[Tensor, ""]
) -> Float[Tensor, "*m"]:
    """Integral of `laplace_density` over intervals along which the SDF is assumed linear.

    The density at one point of an interval much longer than β does not represent the interval: the surface would move back
    to the first sample inside, by half an interval on average.

    Args:
        sdf: in the middle of each interval.
        slope: its derivative along the ray there.
        delta: length of each interval.
        beta: β of Laplace's distribution.
    """
    change = slope * delta
    short = change.abs() < _SHORT * beta
    drop = torch.where(short, 1.0, change) / 2
    mean = (_laplace_tail(sdf - drop, beta) - _laplace_tail(sdf + drop, beta)) / (2 * drop)
    return delta * torch.where(short, laplace_density(sdf, beta), mean)


def _laplace_tail(sdf: Float[Tensor, "*m"], beta: Float[Tensor, ""]) -> Float[Tensor, "*m"]:
    """Integral of `laplace_density` from a signed distance to infinity."""
    return 0.5 * torch.exp(-sdf.abs() / beta) + (-sdf).clamp_min(0) / beta


def logistic_density(sdf: Float[Tensor, "*m"], slope: Float[Tensor, "*m"], sharpness: Float[Tensor, ""]) -> Float[Tensor, "*m"]:
    """Opaque density max(-d/dt Φ(sdf) / Φ(sdf), 0) with the sigmoid Φ of ``sharpness`` times sdf (NeuS, equation 10).

    Args:
        sdf: signed distance.
        slope: its derivative along the ray, in [-1, 1] for a signed distance; where it is positive the density is 0.
        sharpness: s of the logistic distribution, per length.
    """
    return -slope.clamp_max(0) * sharpness * torch.sigmoid(-sharpness * sdf)


def section_optical_depth(
    sdf: Float[Tensor, "*m"], slope: Float[Tensor, "*m"], delta: Float[Tensor, "*m"], sharpness: Float[Tensor, ""]
) -> Float[Tensor, "*m"]:
    """Integral of `logistic_density` over intervals along which the SDF is assumed linear.

    It is -log(1 - α) of α = (Φ(f_i) - Φ(f_i+1)) / Φ(f_i) between an interval's section points (NeuS, equation 13), whose
    distances are extrapolated from its middle: f ∓ slope δ / 2. log Φ(f) = -softplus(-s f), which needs no division.

    Args:
        sdf: in the middle of each interval.
        slope: its derivative along the ray there.
        delta: length of each interval.
        sharpness: s of the logistic distribution, per length.
    """
    drop = slope.clamp_max(0) * delta / 2
    return (softplus(-sharpness * (sdf + drop)) - softplus(-sharpness * (sdf - drop))).clamp_min(0)


class DistanceDensity(Field):
    """View of a field of signed distances as one of densities, for samplers and for quadrature; made anew for each rendering.

    Args:
        field: with a signed distance.
        beta: width of the density, local units: β of Laplace's distribution, 1 / s of the logistic one.
        slopes: derivative of the signed distance along a ray, for the density's mean over an interval. ``gradient``: from the
            field's gradient. ``neighbours``: without gradients, from differences between neighbouring samples, which are
            cheaper, for searches in training; with gradients as ``gradient``. For points that lie on no ray: ``steepest``
            assumes -1, ``pointwise`` takes the density at the point, which needs no slope (Laplace's only).
    """

    def __init__(self, field: Field, beta: Float[Tensor, ""], slopes: Slopes = "gradient") -> None:
        super().__init__()
        self.field = field
        self.beta = beta
        self._slopes: Slopes = slopes
        self.provides = field.provides | Quantity.DENSITY

    @property
    def slopes(self) -> Slopes:
        """Where slopes come from now: with gradients enabled, ``neighbours`` is ``gradient``."""
        return "gradient" if self._slopes == "neighbours" and torch.is_grad_enabled() else self._slopes

    @property
    def needs(self) -> Quantity:
        """Quantities of the field from which the density is computed."""
        return Quantity.SDF | Quantity.GRADIENT if self.slopes == "gradient" else Quantity.SDF

    @abstractmethod
    def density_of(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        """Density from the values of `needs`, per local length unit."""

    def slope(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        """Derivative of the signed distance along the ray at each sample, from the values of `needs`."""
        assert values.sdf is not None
        if self.slopes == "neighbours":
            return neighbour_slopes(values.sdf, samples)
        assert values.gradient is not None
        return (values.gradient * samples.direction).sum(dim=1)

    @override
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`; with a density, the signed distance is returned too."""
        if Quantity.DENSITY not in want:
            return self.field.query(samples, want)
        values = self.field.query(samples, (want & ~Quantity.DENSITY) | self.needs)
        return replace(values, density=self.density_of(values, samples))


class LaplaceDensity(DistanceDensity):
    """VolSDF's density.

    Args:
        field: with a signed distance.
        beta: β, local units.
        slopes: as of `DistanceDensity`, but not ``steepest``; ``pointwise``: the density at the samples (VolSDF).
    """

    def __init__(self, field: Field, beta: Float[Tensor, ""], slopes: Slopes = "pointwise") -> None:
        super().__init__(field, beta, slopes)

    @override
    def density_of(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        assert values.sdf is not None
        if self.slopes == "pointwise":
            return laplace_density(values.sdf, self.beta)
        delta = samples.delta
        extended = delta > 0
        optical_depth = laplace_optical_depth(values.sdf, self.slope(values, samples), delta, self.beta)
        mean = optical_depth / torch.where(extended, delta, 1.0)
        return torch.where(extended, mean, laplace_density(values.sdf, self.beta))


class LogisticDensity(DistanceDensity):
    """NeuS's density: the mean over each sample's interval, so that its alpha is the one between section points.

    Args:
        field: with a signed distance.
        beta: 1 / s, local units.
        slopes: as of `DistanceDensity`, but not ``pointwise``.
        anneal: at 1 the slope is the one along the ray; at 0 it is moved halfway to -1, so that surfaces seen from inside
            are rendered too (NeuS's ``cos_anneal_ratio``).
    """

    def __init__(self, field: Field, beta: Float[Tensor, ""], slopes: Slopes = "gradient", anneal: float = 1.0) -> None:
        super().__init__(field, beta, slopes)
        self.anneal = anneal

    @override
    def density_of(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        assert values.sdf is not None
        sharpness = 1 / self.beta
        if self.slopes == "steepest":
            return logistic_density(values.sdf, values.sdf.new_full((), -1.0), sharpness)
        slope = self.slope(values, samples)
        if self.anneal < 1:
            slope = torch.lerp(-(0.5 - slope / 2).clamp_min(0), slope.clamp_max(0), self.anneal)
        delta = samples.delta
        extended = delta > 0
        mean = section_optical_depth(values.sdf, slope, delta, sharpness) / torch.where(extended, delta, 1.0)
        return torch.where(extended, mean, logistic_density(values.sdf, slope, sharpness))


def neighbour_slopes(sdf: Float[Tensor, " m"], samples: Samples) -> Float[Tensor, " m"]:
    """Slopes of the signed distance to the next sample of the same ray; of the ray's last sample, from the one before it.

    A sample alone on its ray gets the steepest slope, -1.
    """
    if len(sdf) < 2:
        return sdf.new_full(sdf.shape, -1.0)
    middle = samples.mid
    step = (sdf.diff() / middle.diff().clamp_min(torch.finfo(sdf.dtype).tiny)).clamp(-1, 1)
    joined = samples.ray.diff() == 0
    after, before = (torch.nn.functional.pad(step, ends) for ends in ((0, 1), (1, 0)))
    has_after, has_before = (torch.nn.functional.pad(joined, ends) for ends in ((0, 1), (1, 0)))
    return torch.where(has_after, after, torch.where(has_before, before, -1.0))
