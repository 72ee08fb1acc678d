"""Gaussians as density control, relocation, smoothing and limits see them: parameters replaced row by row, rounds of growth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.training.checks import Requirement


class GaussianParameters(Protocol):
    """The part of a field of n Gaussians that hooks edit; parameters are stored before activation."""

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    opacity_logits: Float[Tensor, " n"]

    def filter_attenuation(self) -> Float[Tensor, " n"]:
        """Factor in (0, 1] by which a 3D filter lowers each opacity; 1 without one."""
        ...

    def replace(self, tensors: dict[str, Tensor]) -> None:
        """Replace all parameters by new ones, of any common number of rows."""
        ...


@dataclass(frozen=True, eq=False)
class GrowthRound:
    """What a round of growing and pruning did to each of the n Gaussians before it; all others were kept.

    Attributes:
        step: steps of the fit when it was over.
        cloned: those that got a copy.
        split: those that were replaced by smaller ones.
        pruned: those that were removed.
    """

    step: int
    cloned: Bool[Tensor, " n"]
    split: Bool[Tensor, " n"]
    pruned: Bool[Tensor, " n"]


GAUSSIANS = Requirement("Gaussians", GaussianParameters)
"""For hooks that edit Gaussians."""


def cap_at(first: int, most: int, passed: float, ramp: float) -> int:
    """Cap on the number of Gaussians: from ``first`` to ``most`` by equal factors over ``ramp`` of a fit.

    Args:
        first: number when growth began.
        most: number in the end.
        passed: progress since growth began.
        ramp: progress until the end; 0 for no cap but ``most``.
    """
    if not ramp or first >= most:
        return most
    return int(first * (most / first) ** min(1.0, max(0.0, passed) / ramp))
