"""3D Gaussians as one density in space: pointwise density, mixed colour and normal at samples.

The density follows the ``physical`` convention for opacities (`kernels.extinction`), of which `gaussian-volume/exact` with
``opacity = "physical"`` has the line integrals: quadrature converges to it as its steps shrink.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core import harmonics
from invgraphics.core.field import Gaussians, Quantity
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.kernels.extinction import SMALLEST_DEPTH
from invgraphics.kernels.gaussians import gaussian_density
from invgraphics.kernels.reference.gaussian_sums import density_table, overlapping_pairs


def query_density(gaussians: Gaussians, samples: Samples, want: Quantity, smallest: float = SMALLEST_DEPTH) -> FieldValues:
    """Sum the densities of the Gaussians at samples, and mix their colours and normals in proportion.

    Differentiable in Gaussians and samples. Nothing is nearer than a Gaussian's reach at most samples of a ray: their density,
    radiance and normal are zero.

    Args:
        gaussians: activated primitives.
        samples: m of them; a Gaussian's colour is that towards the origin of the sample's ray, for a lone point the one along
            its direction.
        want: of density, radiance and normal.
        smallest: optical depth of a line below which a Gaussian is left out, as in the renderers of Gaussians.
    """
    lone = samples.mid == 0
    if Quantity.NORMAL not in want and not samples.position.requires_grad and (Quantity.RADIANCE not in want or not lone.any()):
        return _values(_sums(gaussians, samples, want, smallest), want)
    sample, gaussian = overlapping_pairs(gaussians, samples.position.detach(), smallest)
    means, axes, peaks = density_table(gaussians).index_select(0, gaussian).split([3, 9, 1], dim=1)
    offset = samples.position.index_select(0, sample) - means
    axes = axes.view(-1, 3, 3)
    x = (axes * offset[:, None, :]).sum(dim=-1)
    density = peaks[:, 0] * torch.exp(-0.5 * x.square().sum(dim=1))
    columns = [density[:, None]]
    if Quantity.RADIANCE in want:
        columns.append(density[:, None] * _colours(gaussians.sh.index_select(0, gaussian), means, samples, sample))
    if Quantity.NORMAL in want:
        columns.append(density[:, None] * (axes * x[:, :, None]).sum(dim=1))
    joined = torch.cat(columns, dim=1)
    return _values(joined.new_zeros(len(samples), joined.shape[1]).index_add(0, sample, joined), want)


def _sums(gaussians: Gaussians, samples: Samples, want: Quantity, smallest: float) -> Float[Tensor, "m c"]:
    """Sums of densities, and of densities times colours where radiance is wanted, by the fastest kernel."""
    eye = samples.position - samples.mid[:, None] * samples.direction if Quantity.RADIANCE in want else None
    return gaussian_density(gaussians, samples.position, eye, smallest)


def _values(sums: Float[Tensor, "m c"], want: Quantity) -> FieldValues:
    total, tiny = sums[:, 0], torch.finfo(sums.dtype).tiny
    # Where the density is zero so are all colours.
    radiance = sums[:, 1:4] / total.clamp_min(tiny)[:, None] if Quantity.RADIANCE in want else None
    normal = normalize(sums[:, -3:], dim=1, eps=tiny) if Quantity.NORMAL in want else None
    return FieldValues(density=total if Quantity.DENSITY in want else None, radiance=radiance, normal=normal)


def _colours(
    sh: Float[Tensor, "p c 3"], means: Float[Tensor, "p 3"], samples: Samples, sample: Int[Tensor, " p"]
) -> Float[Tensor, "p 3"]:
    """Colours of Gaussians towards the origins of the samples' rays, as `gaussian-volume/exact` takes them."""
    if sh.shape[1] == 1:
        return harmonics.colour(sh, means)  # the constant band has no direction
    origins = samples.position - samples.mid[:, None] * samples.direction
    lone = (samples.mid == 0)[:, None].index_select(0, sample)
    towards = torch.where(lone, samples.direction.index_select(0, sample), means - origins.index_select(0, sample))
    return harmonics.colour(sh, normalize(towards, dim=1))
