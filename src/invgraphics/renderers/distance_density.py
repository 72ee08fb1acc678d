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


def laplace_density(sdf: Float[Tensor, "*m"], beta: Float[Tensor, "*#m"]) -> Float[Tensor, "*m"]:
    """Density Ψ(-sdf) / β with the CDF Ψ of Laplace's distribution of zero mean and scale β (VolSDF, equations 2 and 3).

    Per unit of length of ``sdf``: 1 / (2 β) on the surface, 1 / β deep inside.
    """
    tail = 0.5 * torch.exp(-sdf.abs() / beta)
    return torch.where(sdf > 0, tail, 1 - tail) / beta


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

    Attributes:
        field: with a signed distance.
        beta: width of the density, local units: β of Laplace's distribution, 1 / s of the logistic one.
    """

    def __init__(self, field: Field, beta: Float[Tensor, ""]) -> None:
        super().__init__()
        self.field = field
        self.beta = beta
        self.provides = field.provides | Quantity.DENSITY

    @property
    @abstractmethod
    def needs(self) -> Quantity:
        """What the density is made from."""

    @abstractmethod
    def density_of(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        """Density from the values of `needs`, per local length unit."""

    @override
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`; the distance is handed on where a density is wanted."""
        if Quantity.DENSITY not in want:
            return self.field.query(samples, want)
        values = self.field.query(samples, (want & ~Quantity.DENSITY) | self.needs)
        return replace(values, density=self.density_of(values, samples))


class LaplaceDensity(DistanceDensity):
    """VolSDF's density."""

    @property
    @override
    def needs(self) -> Quantity:
        return Quantity.SDF

    @override
    def density_of(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        assert values.sdf is not None
        return laplace_density(values.sdf, self.beta)


class LogisticDensity(DistanceDensity):
    """NeuS's density: the mean over each sample's interval, so that its alpha is the one between section points.

    Args:
        field: with a signed distance.
        beta: 1 / s, local units.
        slopes: how the distance changes along a ray: by the field's ``gradient``; outside the graph by differences of
            ``neighbours``, which cost no gradient, for searches in training; for points on no rays the ``steepest`` there is.
        anneal: from 1 on the slope is that along the ray; at 0 it is halved towards -1, so that a ray sees surfaces that it
            leaves, too (NeuS's ``cos_anneal_ratio``).
    """

    def __init__(self, field: Field, beta: Float[Tensor, ""], slopes: Slopes = "gradient", anneal: float = 1.0) -> None:
        super().__init__(field, beta)
        self.slopes: Slopes = slopes
        self.anneal = anneal

    @property
    @override
    def needs(self) -> Quantity:
        return Quantity.SDF | Quantity.GRADIENT if self._slopes == "gradient" else Quantity.SDF

    @property
    def _slopes(self) -> Slopes:
        return "gradient" if self.slopes == "neighbours" and torch.is_grad_enabled() else self.slopes

    @override
    def density_of(self, values: FieldValues, samples: Samples) -> Float[Tensor, " m"]:
        assert values.sdf is not None
        sharpness = 1 / self.beta
        if self._slopes == "steepest":
            return logistic_density(values.sdf, values.sdf.new_full((), -1.0), sharpness)
        if self._slopes == "neighbours":
            slope = neighbour_slopes(values.sdf, samples)
        else:
            assert values.gradient is not None
            slope = (values.gradient * samples.direction).sum(dim=1)
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
