"""Muon (Jordan et al. 2024, kellerjordan.github.io/posts/muon): orthogonalised steps of networks' weight matrices.

A gradient's momentum G = U S V' is replaced by U V', so that directions with small gradients are learnt as fast as the others.
Not ``torch.optim.Muon``, for the reason in `adam`; and in float32, where that computes in bfloat16.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from invgraphics.training.optimisers.adam import GroupedOptimiser

MOMENTUM = "momentum_buffer"
"""Name of the momentum in a parameter's state, torch's own."""
MOMENTUM_DECAY = 0.95
LEAST_SIZE = 16
"""Fewest inputs and outputs of a layer that takes Muon's steps: narrower ones have too few directions to gain from it."""
LINES = ".lines."
"""Part of the names of factor lines (TensoRF), matrices of place by component."""
RMS = 0.2
"""Root mean square of a step over the learning rate, which is about Adam's (Liu et al. 2025, arXiv 2502.16982)."""
QUINTIC, ITERATIONS = (3.4445, -4.7750, 2.0315), 5
"""Coefficients of the odd polynomial that brings singular values from (0, 1] to about 1, between 0.7 and 1.2."""


def takes_muon(name: str, parameter: Tensor) -> bool:
    """Whether a parameter takes Muon's steps: the weight of a linear layer of some width, or lines of a factorisation.

    Muon's author leaves first and last layers to Adam; here they are as wide as the others, and take part. Orthogonal steps of
    factor lines keep components apart: with Adam for them 1,200 steps of `volumetric/tensorf-vm` end 0.7 dB lower on `bricks`,
    in a haze that makes rendering five times as slow. All other features, on grids, in tables and of points, are separate
    values rather than a map, and keep Adam whatever their shape.
    """
    if parameter.ndim != 2:
        return False
    return LINES in name or (name.endswith(".weight") and min(parameter.shape) >= LEAST_SIZE)


def orthogonalised(matrix: Float[Tensor, "r c"]) -> Float[Tensor, "r c"]:
    """``U V'`` of a matrix ``U S V'``, approximately, by Newton-Schulz iterations."""
    a, b, c = QUINTIC
    x = matrix.mT if matrix.shape[0] > matrix.shape[1] else matrix
    x = x / x.norm().clamp_min(1e-7)
    for _ in range(ITERATIONS):
        gram = x @ x.mT
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if matrix.shape[0] > matrix.shape[1] else x


@final
class Muon(GroupedOptimiser):
    """Muon with Nesterov's momentum; a parameter's state is its `MOMENTUM`."""

    def __init__(self, groups: Iterable[dict[str, Any]], factor: float = 1.0, weight_decay: float = 0.0) -> None:
        """Begin without momentum.

        Args:
            groups: of parameters.
            factor: multiplies all groups' rates.
            weight_decay: decoupled weight decay: a step first multiplies weights by 1 - rate * decay.
        """
        super().__init__(groups)
        self._factor, self._weight_decay = factor, weight_decay

    def _update(self, parameters: list[nn.Parameter], lr: float) -> None:
        for parameter in parameters:
            gradient, state = parameter.grad, self.state[parameter]
            assert gradient is not None
            if MOMENTUM not in state:
                state[MOMENTUM] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
            momentum = state[MOMENTUM].lerp_(gradient, 1 - MOMENTUM_DECAY)
            step, rate = orthogonalised(gradient.lerp(momentum, MOMENTUM_DECAY)), lr * self._factor
            if self._weight_decay > 0:
                parameter.mul_(1 - rate * self._weight_decay)
            parameter.add_(step, alpha=-rate * RMS * math.sqrt(max(parameter.shape)))
