"""Layers that depend on a code, three ways: by a hypernetwork, by concatenation, by modulation of features (FiLM).

All take the inputs of s instances, (s, m, i), and their codes, (s, c), and end in layer normalisation and ReLU:
``relu(norm(W x + b))``. They differ in which of W, b and norm the code decides.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import layer_norm

Conditioning = Literal["hypernetwork", "concatenation", "film"]

HYPER_SCALE = 0.1
"""Of the starting weights by which a hypernetwork's output depends on the code (SRN: 0.1): instances start alike."""


class HyperLayer(nn.Module):
    """Layer whose weights and biases are outputs of a network of the code (SRN, Sitzmann et al. 2019, §3.3).

    Attributes:
        hyper: code to the flattened weights (outputs, inputs), then the biases. Its own bias is the layer at code 0.
    """

    def __init__(self, inputs: int, outputs: int, code: int, hidden: int) -> None:
        super().__init__()
        self.inputs, self.outputs = inputs, outputs
        last = nn.Linear(hidden, outputs * (inputs + 1))
        plain = nn.Linear(inputs, outputs)
        with torch.no_grad():
            last.weight.mul_(HYPER_SCALE / math.sqrt(inputs))
            last.bias.copy_(torch.cat([plain.weight.flatten(), plain.bias]))
        self.hyper = nn.Sequential(nn.Linear(code, hidden), nn.ReLU(), last)

    def parameters_at(self, codes: Float[Tensor, "s c"]) -> tuple[Float[Tensor, "s o i"], Float[Tensor, "s o"]]:
        """Weights and biases of each instance."""
        flat = self.hyper(codes)
        split = self.outputs * self.inputs
        return flat[:, :split].unflatten(1, (self.outputs, self.inputs)), flat[:, split:]

    def forward(self, x: Float[Tensor, "s m i"], codes: Float[Tensor, "s c"]) -> Float[Tensor, "s m o"]:
        """Features of the instances' inputs."""
        weight, bias = self.parameters_at(codes)
        return layer_norm(torch.baddbmm(bias[:, None], x, weight.mT), (self.outputs,)).relu()


class ConcatenatedLayer(nn.Module):
    """Layer that sees the code beside its inputs (DeepSDF): the code adds a bias of its own.

    Attributes:
        linear: of the inputs.
        code: of the code.
    """

    def __init__(self, inputs: int, outputs: int, code: int) -> None:
        super().__init__()
        self.linear, self.code = nn.Linear(inputs, outputs), nn.Linear(code, outputs, bias=False)
        self.norm = nn.LayerNorm(outputs)

    def forward(self, x: Float[Tensor, "s m i"], codes: Float[Tensor, "s c"]) -> Float[Tensor, "s m o"]:
        """Features of the instances' inputs."""
        return self.norm(self.linear(x) + self.code(codes)[:, None]).relu()


class FilmLayer(nn.Module):
    """Layer whose normalised features the code scales and shifts (FiLM, Perez et al. 2018; pi-GAN, Chan et al. 2021).

    Attributes:
        linear: of the inputs.
        film: code to the scales minus 1, then the shifts.
    """

    def __init__(self, inputs: int, outputs: int, code: int, hidden: int) -> None:
        super().__init__()
        self.outputs = outputs
        self.linear = nn.Linear(inputs, outputs)
        self.film = nn.Sequential(nn.Linear(code, hidden), nn.ReLU(), nn.Linear(hidden, 2 * outputs))

    def forward(self, x: Float[Tensor, "s m i"], codes: Float[Tensor, "s c"]) -> Float[Tensor, "s m o"]:
        """Features of the instances' inputs."""
        scale, shift = self.film(codes)[:, None].chunk(2, dim=-1)
        return (layer_norm(self.linear(x), (self.outputs,)) * (1 + scale) + shift).relu()


def make_layer(conditioning: Conditioning, inputs: int, outputs: int, code: int, hidden: int) -> nn.Module:
    """Make a layer; ``hidden`` is the width of the network of the code, where there is one."""
    if conditioning == "hypernetwork":
        return HyperLayer(inputs, outputs, code, hidden)
    return (
        ConcatenatedLayer(inputs, outputs, code)
        if conditioning == "concatenation"
        else FilmLayer(inputs, outputs, code, hidden)
    )
