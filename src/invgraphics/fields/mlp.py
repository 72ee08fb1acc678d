"""Fully connected networks, their activations, and the geometric initialisation as a sphere's signed distance."""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear, relu, softplus

from invgraphics.kernels.types import EXP_LIMIT

SPHERE_POINTS = 4096
"""Points on which `Mlp.initialise_as_sphere` corrects its output layer."""
SPHERE_RIDGE = 1e-4
"""Penalty on that correction, per point."""


class Mlp(nn.Module):
    """Hidden layers of equal width and a linear output layer.

    Args:
        inputs: features in.
        layers: hidden layers; 0 leaves a linear map.
        width: features of each hidden layer.
        outputs: features out.
        skip: index of the hidden layer after which the inputs are concatenated once more, -1 for none.
        sharpness: of a softplus in place of ReLU: 100 is IDR's and NeuS's, twice differentiable, 1 is EG3D's.
    """

    def __init__(
        self, *, inputs: int, layers: int, width: int, outputs: int, skip: int = -1, sharpness: float | None = None
    ) -> None:
        super().__init__()
        self.inputs = inputs
        self.skip = skip
        self.sharpness = sharpness
        widths = [inputs] + [width + (inputs if index == skip else 0) for index in range(layers)]
        self.hidden = nn.ModuleList(nn.Linear(before, width) for before in widths[:-1])
        self.output = nn.Linear(widths[-1], outputs)

    def forward(self, x: Float[Tensor, "m inputs"], outputs: int | None = None) -> Float[Tensor, "m outputs"]:
        """The network's first ``outputs`` output features (``None``: all); the others are not computed."""
        return linear(self._last_hidden(x), self.output.weight[:outputs], self.output.bias[:outputs])

    def layers(self) -> tuple[tuple[Tensor, Tensor], ...]:
        """Weights and biases of all layers, the output last, detached."""
        layers = [layer for layer in (*self.hidden, self.output) if isinstance(layer, nn.Linear)]
        return tuple((layer.weight.detach(), layer.bias.detach()) for layer in layers)

    def _last_hidden(self, x: Float[Tensor, "m inputs"]) -> Float[Tensor, "m width"]:
        h = x
        for index, layer in enumerate(self.hidden):
            h = relu(layer(h), inplace=True) if self.sharpness is None else softplus(layer(h), beta=self.sharpness)
            if index == self.skip:
                h = torch.cat([h, x], dim=1)
        return h

    @torch.no_grad()
    def initialise_as_sphere(self, radius: float, *, inside_out: bool = False) -> None:
        """Make the first output about ``|x| - radius`` of the first three inputs x in [-1, 1]; ``inside_out`` negates it.

        Atzmon and Lipman 2020 (SAL), theorem 1: wide layers with weights N(0, 2 / width) keep the norm, and the output layer
        averages. Inputs beyond the first three, and those that come in by the skip, start with weight zero (IDR keeps the three
        coordinates of the skip).
        Layers of a practical width are some 15% off, so the averaging weights are then corrected by ridge regression.
        """
        hidden = [layer for layer in self.hidden if isinstance(layer, nn.Linear)]
        for index, layer in enumerate(hidden):
            layer.weight.normal_(0.0, sqrt(2 / layer.out_features))
            layer.bias.zero_()
            layer.weight[:, 3 if index == 0 else layer.out_features :] = 0
        # Whatever the skip appends after the last layer must not count either.
        width = hidden[-1].out_features if hidden else 3
        x = torch.zeros(SPHERE_POINTS, self.inputs)
        x[:, :3].uniform_(-1, 1)
        h = self._last_hidden(x)[:, :width].double()
        average = torch.full((width,), sqrt(pi / width), dtype=h.dtype)
        error = x[:, :3].double().norm(dim=1) - h @ average
        normal = h.T @ h + SPHERE_RIDGE * len(h) * torch.eye(width, dtype=h.dtype)
        self.output.weight[0] = 0
        self.output.weight[0, :width] = average + torch.linalg.solve(normal, h.T @ error)
        self.output.bias[0] = -radius
        if inside_out:
            self.output.weight[0].neg_()
            self.output.bias[0].neg_()


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp_max(EXP_LIMIT).exp()

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return grad_outputs[0] * x.clamp_max(EXP_LIMIT).exp()


def truncated_exp(x: Float[Tensor, "*m"]) -> Float[Tensor, "*m"]:
    """``exp(min(x, 15))`` whose derivative beyond 15 stays exp(15) instead of vanishing, so that x can come back."""
    result = _TruncatedExp.apply(x)
    assert isinstance(result, Tensor)
    return result
