"""Adam with named parameter groups whose learning rates follow the fit's progress."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor, nn

from invgraphics.errors import InputError


@dataclass(frozen=True)
class GroupConfig:
    """One parameter group.

    Attributes:
        match: prefix of the parameters' dotted names, beginning with ``field`` or ``renderer``; the longest match wins.
        lr: learning rate at the start.
        final: learning rate at the end; ``None`` keeps ``lr``.
        schedule: how to get there: ``exponential`` (log-linear) or ``cosine``.
        warmup: part of the fit over which the rate rises from 1% to its value.
        per_extent: whether rates are per scene extent (3DGS multiplies position rates by it).
    """

    match: str
    lr: float
    final: float | None = None
    schedule: Literal["exponential", "cosine"] = "exponential"
    warmup: float = 0.0
    per_extent: bool = False

    def __post_init__(self) -> None:
        if self.lr < 0 or (self.final is not None and self.final <= 0):
            raise ValueError("'lr' must be at least 0 and 'final' above 0.")

    def rate(self, progress: float) -> float:
        """The learning rate at a point of the fit, before any extent."""
        final = self.lr if self.final is None else self.final
        if self.schedule == "cosine":
            rate = final + (self.lr - final) * 0.5 * (1 + math.cos(math.pi * progress))
        else:
            rate = self.lr * (final / self.lr) ** progress if self.lr > 0 else 0.0
        rising = min(1.0, progress / self.warmup) if self.warmup > 0 else 1.0
        return rate * (0.01 + 0.99 * rising)


@dataclass(frozen=True)
class OptimiserConfig:
    """Adam (Kingma and Ba 2015).

    Attributes:
        groups: named parameter groups; every trainable parameter must match one.
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        eps: added to the root of the second moment.
    """

    groups: dict[str, GroupConfig] = field(default_factory=dict)
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15


class Optimiser:
    """Adam over the parameters of a field, a renderer and poses; follows changes of a parameter's rows (density control)."""

    def __init__(self, config: OptimiserConfig, parameters: dict[str, nn.Parameter], extent: float) -> None:
        self._config = config
        self._names: dict[str, nn.Parameter] = dict(parameters)
        self._extent = extent
        groups = [
            {"params": [parameter for name, parameter in parameters.items() if self._group_of(name) == key], "name": key}
            for key in config.groups
        ]
        for name in parameters:
            self._group_of(name)
        unused = [str(group["name"]) for group in groups if not group["params"]]
        if unused:
            first = config.groups[unused[0]].match
            known = ", ".join(sorted(parameters))
            raise InputError(f"'optimiser.groups.{unused[0]}' matches no parameter ('{first}').", f"Parameters: {known}.")
        self._adam = torch.optim.Adam(groups, lr=0.0, betas=(config.beta1, config.beta2), eps=config.eps, fused=True)
        self.set_progress(0.0)

    def _group_of(self, name: str) -> str:
        fits = [key for key, group in self._config.groups.items() if f"{name}.".startswith(f"{group.match}.")]
        if not fits:
            raise InputError(f"No optimiser group matches the parameter '{name}'.", "Add it under [optimiser.groups].")
        return max(fits, key=lambda key: len(self._config.groups[key].match))

    def set_progress(self, progress: float) -> None:
        """Set every group's learning rate for this point of the fit."""
        for group in self._adam.param_groups:
            config = self._config.groups[group["name"]]
            group["lr"] = config.rate(progress) * (self._extent if config.per_extent else 1.0)

    def rates(self) -> dict[str, float]:
        """Current learning rate of each group."""
        return {group["name"]: group["lr"] for group in self._adam.param_groups}

    def rate_of(self, name: str) -> float:
        """Current learning rate of one parameter."""
        return self.rates()[self._group_of(name)]

    def zero_grad(self) -> None:
        """Drop all gradients."""
        self._adam.zero_grad(set_to_none=True)

    def step(self) -> None:
        """One Adam step."""
        self._adam.step()

    def reindex_rows(self, name: str, parameter: nn.Parameter, rows: Int[Tensor, " k"], new: int) -> None:
        """Replace a parameter by one of other rows: moments of the old one's ``rows``, then zeros for ``new`` rows."""
        old = self._names[name]
        for group in self._adam.param_groups:
            group["params"] = [parameter if other is old else other for other in group["params"]]
        state = self._adam.state.pop(old, None)
        self._names[name] = parameter
        if state:
            for key in ("exp_avg", "exp_avg_sq"):
                kept = state[key][rows]
                state[key] = torch.cat([kept, kept.new_zeros(new, *kept.shape[1:])])
            self._adam.state[parameter] = state

    def reset_moments(self, name: str, rows: Int[Tensor, " k"] | None = None) -> None:
        """Zero the moments of a parameter (after an opacity reset), or of some of its rows."""
        for key, value in self._adam.state.get(self._names[name], {}).items():
            if key != "step":
                value[slice(None) if rows is None else rows] = 0.0

    def state(self) -> dict[str, Tensor]:
        """Moments and step counts by parameter name."""
        return {
            f"{name}/{key}": value
            for name, parameter in self._names.items()
            for key, value in self._adam.state.get(parameter, {}).items()
        }

    def load(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        for path, value in state.items():
            name, _, key = path.rpartition("/")
            self._adam.state[self._names[name]][key] = value.clone()
