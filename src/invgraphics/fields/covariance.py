"""Covariances of samples in the unit cube in which encodings live."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds


def unit_covariance(
    bounds: Bounds, position: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"]
) -> Float[Tensor, "m 3 3"]:
    """Transform covariances to the unit cube by the linearised map J Σ J^T (mip-NeRF 360, equation 9)."""
    differentiable = torch.is_grad_enabled()
    with torch.enable_grad():
        if not (differentiable and position.requires_grad):
            position = position.detach().requires_grad_()
        unit = bounds.to_unit(position)
        rows = [
            torch.autograd.grad(u.sum(), position, create_graph=differentiable, retain_graph=True)[0] for u in unit.unbind(1)
        ]
    jacobian = torch.stack(rows, dim=1)
    return jacobian @ covariance @ jacobian.mT
