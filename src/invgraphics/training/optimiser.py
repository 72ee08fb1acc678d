"""Adam, and Muon if configured, with named parameter groups whose learning rates follow the fit's progress."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from invgraphics.core.lattice import SparseGradientModule
from invgraphics.errors import InputError
from invgraphics.training.optimisers.adam import MOMENTS, ROW_RATES, DenseAdam, GroupedOptimiser, MaskedAdam
from invgraphics.training.optimisers.muon import MOMENTUM, Muon, takes_muon

_MOMENTS = {*MOMENTS, MOMENTUM}
"""Names of the optimisers' running moments of a parameter's gradients, entry by entry."""
RESTARTED = "restarted"
"""Name in an optimiser's state of the progress at which rates were restarted last."""
LATEST_RESTART = 0.999


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
        skip_zero: leave entries whose gradient is exactly 0 as they are, moments included (DVGO's masked Adam), where a step
            touches few rows of a large grid.
    """

    match: str
    lr: float
    final: float | None = None
    schedule: Literal["exponential", "cosine"] = "exponential"
    warmup: float = 0.0
    per_extent: bool = False
    skip_zero: bool = False

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
    """Adam (Kingma and Ba 2015), and Muon (Jordan et al. 2024) for the matrices of `takes_muon` where ``muon`` is above 0.

    Attributes:
        groups: named parameter groups; every trainable parameter must match one.
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        eps: added to the root of the second moment.
        muon: learning rate of weights of layers and of factor lines, over their group's; 0 leaves them to Adam.
        muon_weight_decay: decoupled weight decay of these matrices: a step first multiplies them by 1 - rate * decay. Steps of
            Muon do not shrink with the gradients, so that without it weights grow all through a fit (Liu et al. 2025, arXiv
            2502.16982).
    """

    groups: dict[str, GroupConfig] = field(default_factory=dict)
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    muon: float = 0.0
    muon_weight_decay: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.beta1 < 1 and 0 <= self.beta2 < 1):
            raise ValueError(f"'beta1' and 'beta2' must be in [0, 1), not {self.beta1} and {self.beta2}.")
        if not self.eps > 0:
            raise ValueError(f"'eps' must be above 0, not {self.eps}.")
        if not self.muon >= 0:
            raise ValueError(f"'muon' must be at least 0, not {self.muon}.")
        if not self.muon_weight_decay >= 0:
            raise ValueError(f"'muon_weight_decay' must be at least 0, not {self.muon_weight_decay}.")


class Optimiser:
    """Steps of the parameters of a field, a renderer and poses; follows changes of a parameter's shape."""

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
            known = ", ".join(sorted(parameters)) or "none: field and renderer learn nothing"
            raise InputError(f"'optimiser.groups.{unused[0]}' matches no parameter ('{first}').", f"Parameters: {known}.")
        betas = (config.beta1, config.beta2)
        dense = [group for group in groups if not config.groups[str(group["name"])].skip_zero]
        masked = [group for group in groups if config.groups[str(group["name"])].skip_zero]
        hidden = []
        if config.muon > 0:
            hidden, dense = _split_params(dense, [one for name, one in parameters.items() if takes_muon(name, one)])
        self._optimisers: list[GroupedOptimiser] = []
        if dense:
            self._optimisers.append(DenseAdam(dense, betas, config.eps))
        if masked:
            self._optimisers.append(MaskedAdam(masked, betas, config.eps))
        if hidden:
            self._optimisers.append(Muon(hidden, config.muon, config.muon_weight_decay))
        self._restart_progress = 0.0
        self.set_progress(0.0)

    def _group_of(self, name: str) -> str:
        fits = [key for key, group in self._config.groups.items() if f"{name}.".startswith(f"{group.match}.")]
        if not fits:
            raise InputError(f"No optimiser group matches the parameter '{name}'.", "Add it under [optimiser.groups].")
        return max(fits, key=lambda key: len(self._config.groups[key].match))

    def _groups(self) -> list[dict[str, Any]]:
        return [group for one in self._optimisers for group in one.param_groups]

    def _optimiser_of(self, name: str) -> GroupedOptimiser:
        """The optimiser that holds a parameter."""
        parameter = self._names[name]
        return next(
            one for one in self._optimisers for group in one.param_groups if any(parameter is p for p in group["params"])
        )

    def set_progress(self, progress: float) -> None:
        """Set every group's learning rate; after `restart(p)`, schedules run over the remaining interval [p, 1]."""
        if self._restart_progress:
            progress = (progress - self._restart_progress) / (1 - self._restart_progress)
        for group in self._groups():
            config = self._config.groups[group["name"]]
            group["lr"] = config.rate(progress) * (self._extent if config.per_extent else 1.0)

    def restart(self, progress: float) -> None:
        """Begin all learning rates' schedules anew at this point of the fit, stretched over the rest of it."""
        self._restart_progress = min(progress, LATEST_RESTART)
        self.set_progress(progress)

    def move_restart(self, factor: float) -> None:
        """Multiply the progress of the last `restart`, whose step is at another progress of another budget."""
        self._restart_progress = min(self._restart_progress * factor, LATEST_RESTART)

    def rates(self) -> dict[str, float]:
        """Current learning rate of each group."""
        return {group["name"]: group["lr"] for group in self._groups()}

    def rate_of(self, name: str) -> float:
        """Current learning rate of one parameter."""
        return self.rates()[self._group_of(name)]

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for one in self._optimisers:
            one.zero_grad()

    def step(self) -> None:
        """One step of all parameters that have a gradient."""
        for one in self._optimisers:
            one.step()

    def skips_zero(self, name: str) -> bool:
        """Whether entries of a parameter without gradient stay as they are, so that its gradient may be a sparse tensor."""
        return isinstance(self._optimiser_of(name), MaskedAdam)

    def row_rates(self, name: str) -> Float[Tensor, "*rows"] | None:
        """Factors of the learning rate of a parameter's rows; ``None`` for 1."""
        return self._optimiser_of(name).state.get(self._names[name], {}).get(ROW_RATES)

    def set_row_rates(self, name: str, rates: Float[Tensor, "*rows"] | None) -> None:
        """Set a factor of the learning rate for every row of a parameter of shape (*rows, c), in place of earlier ones.

        Args:
            name: of the parameter.
            rates: the factors; ``None`` for 1.

        Raises:
            InputError: the parameter's group does not have ``skip_zero``, or the shapes do not fit.
        """
        adam, parameter = self._optimiser_of(name), self._names[name]
        if rates is None:
            adam.state.get(parameter, {}).pop(ROW_RATES, None)
            return
        if not isinstance(adam, MaskedAdam):
            group = self._group_of(name)
            raise InputError(f"Rates per row of '{name}' need 'skip_zero = true' in 'optimiser.groups.{group}'.")
        if rates.shape != parameter.shape[:-1]:
            raise InputError(f"'{name}' has rows {tuple(parameter.shape[:-1])}, but the rates have {tuple(rates.shape)}.")
        adam.state[parameter][ROW_RATES] = rates.to(parameter)

    def reindex_rows(self, name: str, parameter: nn.Parameter, rows: Int[Tensor, " k"], new: int) -> None:
        """Replace a parameter by one of other rows: moments of the old one's ``rows``, then zeros for ``new`` rows.

        Rates per row follow; those of new rows are 1.
        """
        state = self._exchange(name, parameter)
        if state:
            for key in {*_MOMENTS, ROW_RATES} & set(state):
                kept = state[key][rows]
                state[key] = torch.cat([kept, kept.new_full((new, *kept.shape[1:]), float(key == ROW_RATES))])
            self._optimiser_of(name).state[parameter] = state

    def replace(self, name: str, parameter: nn.Parameter, moments: Callable[[Tensor], Tensor] | None = None) -> None:
        """Replace a parameter by one of another shape.

        Args:
            name: of the parameter.
            parameter: the new one.
            moments: makes moments of the new shape of the old ones; ``None``: the new parameter begins without any. Rates per
                row are dropped.
        """
        state = self._exchange(name, parameter)
        if state and moments is not None:
            kept = {key: moments(value) if key in _MOMENTS else value for key, value in state.items() if key != ROW_RATES}
            self._optimiser_of(name).state[parameter] = kept

    def _exchange(self, name: str, parameter: nn.Parameter) -> dict[str, Any] | None:
        """Put a parameter in another's place; returns the other's state."""
        old, adam = self._names[name], self._optimiser_of(name)
        for group in adam.param_groups:
            group["params"] = [parameter if other is old else other for other in group["params"]]
        self._names[name] = parameter
        return adam.state.pop(old, None)

    def drop_moments(self) -> None:
        """Forget all parameters' moments, step counts and rates per row, as a new optimiser has none."""
        for one in self._optimisers:
            one.state.clear()

    def reset_moments(self, name: str, rows: Int[Tensor, " k"] | None = None) -> None:
        """Zero the moments of a parameter (after an opacity reset), or of some of its rows."""
        for key, value in self._optimiser_of(name).state.get(self._names[name], {}).items():
            if key in _MOMENTS:
                value[slice(None) if rows is None else rows] = 0.0

    def state(self) -> dict[str, Tensor]:
        """Moments, step counts and rates per row by parameter name, and when rates were restarted, if they were."""
        restarted = {RESTARTED: torch.tensor(self._restart_progress, dtype=torch.float64)} if self._restart_progress else {}
        return restarted | {
            f"{name}/{key}": value
            for name, parameter in self._names.items()
            for key, value in self._optimiser_of(name).state.get(parameter, {}).items()
        }

    def load(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        for path, value in state.items():
            if path == RESTARTED:
                self._restart_progress = float(value)
                continue
            name, _, key = path.rpartition("/")
            self._optimiser_of(name).state[self._names[name]][key] = value.clone()


def allow_sparse_gradients(module: nn.Module, name: str, optimiser: Optimiser) -> None:
    """Let all parts of a module have sparse gradients of whose parameters the optimiser skips entries without gradient.

    Args:
        module: whose parameters the optimiser has.
        name: of the module; its parameters' names begin with it and a dot.
        optimiser: of these parameters.
    """
    for path, part in module.named_modules(prefix=name):
        names = [f"{path}.{key}" for key, parameter in part.named_parameters() if parameter.requires_grad]
        if isinstance(part, SparseGradientModule):
            part.sparse_gradients = bool(names) and all(optimiser.skips_zero(key) for key in names)


def _split_params(
    groups: list[dict[str, Any]], chosen: list[nn.Parameter]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Split each group into the parameters that are among ``chosen`` and the others; returns both lists of groups."""
    ids = {id(parameter) for parameter in chosen}
    within = [{**group, "params": [one for one in group["params"] if id(one) in ids]} for group in groups]
    others = [{**group, "params": [one for one in group["params"] if id(one) not in ids]} for group in groups]
    return within, others
