"""Densities made from a signed distance: Laplace's distribution (VolSDF), the logistic one (NeuS).

Both rise across the surface over a width, and both have closed-form integrals along a line on which the distance is linear.
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

Slopes = Literal["gradient", "neighbours", "steepest"]
"""Where the derivative of the distance along a ray comes from."""

_SHORT = 1e-3
"""Change of the distance over an interval, over β, below which the density at its middle is as good as its mean."""


def laplace_density(sdf: Float[Tensor, "*m"], beta: Float[Tensor, "*#m"]) -> Float[Tensor, "*m"]:
    """Density Ψ(-sdf) / β with the CDF Ψ of Laplace's distribution of zero mean and scale β (VolSDF, equations 2 and 3).

    Per unit of length of ``sdf``: 1 / (2 β) on the surface, 1 / β deep inside.
    """
    tail = 0.5 * torch.exp(-sdf.abs() / beta)
    return torch.where(sdf > 0, tail, 1 - tail) / beta


def laplace_optical_depth(
    sdf: Float[Tensor, "*m"], slope: Float[Tensor, "*m"], delta: Float[Tensor, "*m"], beta: Float[Tensor, ""]
) -> Float[Tensor, "*m"]:
    """Integral of `laplace_density` over intervals, along which the distance is taken as linear.

    A density at one point of an interval much longer than β says nothing of the rest: the surface would move back to the
    first point inside, by half an interval in the mean.

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
    """Integral of `laplace_density` from a distance to infinity."""
    return 0.5 * torch.exp(-sdf.abs() / beta) + (-sdf).clamp_min(0) / beta


def logistic_density(sdf: Float[Tensor, "*m"], slope: Float[Tensor, "*m"], sharpness: Float[Tensor, ""]) -> Float[Tensor, "*m"]:
    """Opaque density max(-d/dt Φ(sdf) / Φ(sdf), 0) with the sigmoid Φ of ``sharpness`` times sdf (NeuS, equation 10).

    Args:
        sdf: signed distance.
        slope: its derivative along the ray, in [-1, 1] for a distance; where it rises the density is 0.
        sharpness: s of the logistic distribution, per length.
    """
    return -slope.clamp_max(0) * sharpness * torch.sigmoid(-sharpness * sdf)


def section_optical_depth(
    sdf: Float[Tensor, "*m"], slope: Float[Tensor, "*m"], delta: Float[Tensor, "*m"], sharpness: Float[Tensor, ""]
) -> Float[Tensor, "*m"]:
    """Integral of `logistic_density` over intervals, along which the distance is taken as linear.

    It is -log(1 - α) of α = (Φ(f_i) - Φ(f_i+1)) / Φ(f_i) between an interval's section points (NeuS, equation 13), whose
    distances are extrapolated from its middle: f ∓ slope δ / 2. log Φ(f) = -softplus(-s f), so that nothing is divided.

    Args:
        sdf: in the middle of each interval.
        slope: its derivative along the ray there.
        delta: length of each interval.
        sharpness: s of the logistic distribution, per length.
    """
    drop = slope.clamp_max(0) * delta / 2
    return (softplus(-sharpness * (sdf + drop)) - softplus(-sharpness * (sdf - drop))).clamp_min(0)


class DistanceDensity(Field):
    """A field of signed distances seen as one of densities, for samplers and for quadrature; it lives as long as a rendering.

    Args:
        field: with a signed distance.
        beta: width of the density, local units: β of Laplace's distribution, 1 / s of the logistic one.
        slopes: how the distance changes along a ray: by the field's ``gradient``; outside the graph by differences of
            ``neighbours``, which cost no gradient, for searches in training; for points on no rays the ``steepest`` there is.
    """

    def __init__(self, field: Field, beta: Float[Tensor, ""], slopes: Slopes = "gradient") -> None:
        super().__init__()
        self.field = field
        self.beta = beta
        self._slopes: Slopes = slopes
        self.provides = field.provides | Quantity.DENSITY

    @property
    def slopes(self) -> Slopes:
        """Where slopes come from now: in the graph from the gradient."""
        return "gradient" if self._slopes == "neighbours" and torch.is_grad_enabled() else self._slopes

    @property
    def needs(self) -> Quantity:
        """What the density is made from."""
        return Quantity.SDF | Quantity.GRADIENT if self.slopes == "gradient" else Quantity.SDF

    @abstractmethod
    def density_of(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        """Density from the values of `needs`, per local length unit."""

    def slope(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        """Derivative of the distance along the ray at each sample, from the values of `needs`."""
        assert values.sdf is not None
        if self.slopes == "neighbours":
            return neighbour_slopes(values.sdf, samples)
        assert values.gradient is not None
        return (values.gradient * samples.direction).sum(dim=1)

    @override
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`; the distance is handed on where a density is wanted."""
        if Quantity.DENSITY not in want:
            return self.field.query(samples, want)
        values = self.field.query(samples, (want & ~Quantity.DENSITY) | self.needs)
        return replace(values, density=self.density_of(values, samples))


class LaplaceDensity(DistanceDensity):
    """VolSDF's density.

    Args:
        field: with a signed distance.
        beta: β, local units.
        slopes: as of `DistanceDensity`; ``None``: the density at the samples.
    """

    def __init__(self, field: Field, beta: Float[Tensor, ""], slopes: Slopes | None = None) -> None:
        super().__init__(field, beta, slopes or "steepest")

    @override
    def density_of(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        assert values.sdf is not None
        if self.slopes == "steepest":
            return laplace_density(values.sdf, self.beta)
        delta = samples.delta
        there = delta > 0
        mean = laplace_optical_depth(values.sdf, self.slope(values, samples), delta, self.beta) / torch.where(there, delta, 1.0)
        return torch.where(there, mean, laplace_density(values.sdf, self.beta))


class LogisticDensity(DistanceDensity):
    """NeuS's density: the mean over each sample's interval, so that its alpha is the one between section points.

    Args:
        field: with a signed distance.
        beta: 1 / s, local units.
        slopes: as of `DistanceDensity`.
        anneal: from 1 on the slope is that along the ray; at 0 it is halved towards -1, so that a ray sees surfaces that it
            leaves, too (NeuS's ``cos_anneal_ratio``).
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
        there = delta > 0
        mean = section_optical_depth(values.sdf, slope, delta, sharpness) / torch.where(there, delta, 1.0)
        return torch.where(there, mean, logistic_density(values.sdf, slope, sharpness))


def neighbour_slopes(sdf: Float[Tensor, " m"], samples: Samples) -> Float[Tensor, " m"]:
    """Differences of the distance to the next sample of the same ray, of its last sample to the one before it, over length.

    A sample alone on its ray gets the steepest descent, -1.
    """
    if len(sdf) < 2:
        return sdf.new_full(sdf.shape, -1.0)
    middle = samples.mid
    step = (sdf.diff() / middle.diff().clamp_min(torch.finfo(sdf.dtype).tiny)).clamp(-1, 1)
    joined = samples.ray.diff() == 0
    after, before = (torch.nn.functional.pad(step, ends) for ends in ((0, 1), (1, 0)))
    has_after, has_before = (torch.nn.functional.pad(joined, ends) for ends in ((0, 1), (1, 0)))
    return torch.where(has_after, after, torch.where(has_before, before, -1.0))
