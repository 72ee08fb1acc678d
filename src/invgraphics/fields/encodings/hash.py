"""Multi-resolution hash encoding (Instant-NGP, Müller et al. 2022, §3)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from invgraphics import kernels
from invgraphics.core.ngp import MAX_LEVELS, HashGrid
from invgraphics.fields.encodings.window import Windowed

INITIAL_RANGE = 1e-4
"""Table entries start uniformly within +- this (Instant-NGP, §4)."""

COARSE_LEVELS = 2
"""Levels that a coarse-to-fine window never holds back: without any there would be nothing to see."""


@dataclass(frozen=True)
class HashConfig(HashGrid):
    """A hash grid as a recipe's encoding: `HashGrid` with its limits.

    Attributes:
        min_spacing: smallest cell, in pixels of the nearest training camera (`pixel_limit`): levels that pictures do not
            resolve overfit, and cost time. 0: no limit.
    """

    title: ClassVar[str] = "multi-resolution hash grid"

    min_spacing: float = 0.0

    def __post_init__(self) -> None:
        if self.min_spacing < 0:
            raise ValueError(f"min_spacing must not be negative, not {self.min_spacing}.")
        if not 1 <= self.levels <= MAX_LEVELS or self.features < 1:
            raise ValueError(f"levels must be from 1 to {MAX_LEVELS}, features at least 1.")
        if not 1 <= self.log2_size <= 30:
            raise ValueError(f"log2_size must be from 1 to 30, not {self.log2_size}.")
        if not 1 <= self.base <= self.finest < 2**20:
            raise ValueError(f"1 <= base <= finest < 2^20 must hold, not base = {self.base} and finest = {self.finest}.")

    def resolved(self, pixels: float) -> HashConfig:
        """The grid with no cells smaller than ``min_spacing``, where ``pixels`` along an edge are resolved.

        Its finest level is at that limit, the others grow by about the same factor as before.
        """
        if self.base == self.finest or self.finest * self.min_spacing <= pixels:
            return self
        finest = max(self.base, int(pixels / self.min_spacing))
        steps = (self.levels - 1) * math.log(finest / self.base) / math.log(self.finest / self.base)
        return replace(self, levels=1 + math.ceil(steps), finest=finest)

    def build(self) -> HashEncoding:
        """The encoding, its table drawn from torch's global generator."""
        return HashEncoding(self)


class HashEncoding(Windowed):
    """Trilinear look-ups on all levels.

    Attributes:
        width: levels * features.
        table: features of all levels, one row per entry.
    """

    def __init__(self, grid: HashGrid) -> None:
        super().__init__(levels=grid.levels, always=COARSE_LEVELS)
        self.grid = grid
        self.width = grid.levels * grid.features
        self.table = nn.Parameter(torch.empty(grid.entries, grid.features).uniform_(-INITIAL_RANGE, INITIAL_RANGE))

    def forward(self, unit: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"] | None = None) -> Float[Tensor, "m f"]:
        """Features at ``unit``; ``covariance`` is not used.

        The gradient with respect to ``unit`` is itself differentiable (a loss on normals needs it in the table); within a cell
        only the mixed second derivatives of a trilinear function are not zero.
        """
        features, _ = kernels.hash_encode(unit, self.table, self.grid)
        weights = self.level_weights()
        return features if weights is None else features * weights.repeat_interleave(self.grid.features)
