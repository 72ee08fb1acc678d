"""Raw geometry of a neural field at points and its gradient in their positions, evaluated chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.kernels.differentiation import gradients_of_positions

CPU_CHUNK = 8192
"""Samples that go through the networks at once on a CPU: larger activations cost more in page faults than in arithmetic."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Raw geometry at m points.

    Attributes:
        raw: density before its activation, or signed distance in half-extents of the box.
        features: geometry features, which colour takes; ``None`` where they were not wanted.
        gradient: of ``raw`` in the positions; ``None`` where it was not wanted.
    """

    raw: Float[Tensor, " m"]
    features: Float[Tensor, "m h"] | None
    gradient: Float[Tensor, "m 3"] | None


def query_geometry(
    encode: Callable[[Tensor], Tensor],
    network: Callable[[Tensor, bool], Tensor],
    position: Float[Tensor, "m 3"],
    *,
    with_features: bool,
    with_gradient: bool,
) -> Geometry:
    """Evaluate raw geometry at ``position``; the gradient can be had inside ``no_grad``, and is in the graph outside.

    Args:
        encode: features of positions, all at once: the backward pass makes one gradient of the encoding's size.
        network: from features to raw geometry, followed by the geometry features if the flag is set.
        position: of m points, local frame.
        with_features: whether the geometry features are wanted.
        with_gradient: whether the gradient is wanted.
    """
    training = torch.is_grad_enabled()
    raws, geometry_features, slopes, gradient = [], [], [], None
    with torch.set_grad_enabled(training or with_gradient):
        moving = position
        if with_gradient and not (training and position.requires_grad):
            moving = position.detach().requires_grad_()
        # Positions that a loss may move need second derivatives; of others the first ones alone are asked for.
        with nullcontext() if moving is position else gradients_of_positions():
            features = followed = encode(moving)
        if training and moving is not position:
            # Encoded again: backward would spend more on a gradient in these positions, which is not needed.
            again = encode(position)
            features = again if again.requires_grad else followed
        for (part,) in chunks(features):
            # Outside the graph, one that starts here keeps it from growing over all chunks.
            chunk = part if training or not with_gradient else part.detach().requires_grad_()
            outputs = network(chunk, with_features)
            if with_gradient:
                slopes += torch.autograd.grad(outputs[:, 0].sum(), chunk, create_graph=training)
            outputs = outputs if training else outputs.detach()
            raws.append(outputs[:, 0])
            geometry_features.append(outputs[:, 1:])
        if with_gradient:
            (gradient,) = torch.autograd.grad(followed, moving, torch.cat(slopes), create_graph=training)
    return Geometry(torch.cat(raws), torch.cat(geometry_features) if with_features else None, gradient)


def chunks(first: Tensor, *others: Tensor | None) -> Iterator[tuple[Any, ...]]:
    """Split tensors of one length alike into chunks for networks; a tensor that is ``None`` stays so in each."""
    size = CPU_CHUNK if first.device.type == "cpu" else max(len(first), 1)
    parts = [first.split(size)]
    parts += [(None,) * len(parts[0]) if other is None else other.split(size) for other in others]
    return zip(*parts, strict=True)
