"""Adam (Kingma and Ba 2015), and a form of it that leaves entries without gradient alone (DVGO, Sun et al. 2022).

Not ``torch.optim.Adam``: making any of torch's optimisers imports its compiler, two seconds of every process that fits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Iterable
from typing import Any, final

import torch
from jaxtyping import Int
from torch import Tensor, nn
from torch.optim.adam import adam

from invgraphics.kernels import adam_rows
from invgraphics.kernels.types import AdamStep

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Names of the moments in a parameter's state, torch's own."""
ROW_RATES = "row_rates"
"""Name there of a parameter's factors of the learning rate, one per row."""


class GroupedOptimiser(ABC):
    """Groups of parameters with a learning rate each, and a state per parameter.

    Attributes:
        param_groups: dictionaries with ``params``, ``lr`` and whatever else the caller put there.
        state: by parameter, empty before its first step.
    """

    def __init__(self, groups: Iterable[dict[str, Any]]) -> None:
        self.param_groups: list[dict[str, Any]] = [{"lr": 0.0, **group} for group in groups]
        self.state: defaultdict[nn.Parameter, dict[str, Tensor]] = defaultdict(dict)

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update every parameter that has a gradient."""
        for group in self.param_groups:
            if parameters := [parameter for parameter in group["params"] if parameter.grad is not None]:
                self._update(parameters, group["lr"])

    @abstractmethod
    def _update(self, parameters: list[nn.Parameter], lr: float) -> None:
        """Step the parameters of one group; all have gradients."""


class Adam(GroupedOptimiser):
    """Adam's moments and counts of steps: a parameter's state is ``step`` and `MOMENTS`, as in torch's Adam."""

    def __init__(self, groups: Iterable[dict[str, Any]], betas: tuple[float, float], eps: float) -> None:
        super().__init__(groups)
        self._betas, self._eps = betas, eps

    _steps_beside_parameters: bool
    """Whether counts of steps are on their parameters' device, and not on the CPU."""

    def _update(self, parameters: list[nn.Parameter], lr: float) -> None:
        for parameter in parameters:
            state = self.state[parameter]
            if "step" not in state:
                state["step"] = torch.zeros((), device=parameter.device if self._steps_beside_parameters else None)
                state |= {name: torch.zeros_like(parameter, memory_format=torch.preserve_format) for name in MOMENTS}
        self._adam_step(parameters, lr)

    @abstractmethod
    def _adam_step(self, parameters: list[nn.Parameter], lr: float) -> None:
        """Step the parameters of one group; all have gradients and state."""


@final
class DenseAdam(Adam):
    """Adam by torch's fused kernel."""

    _steps_beside_parameters = True

    def _adam_step(self, parameters: list[nn.Parameter], lr: float) -> None:
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        first, second, steps = ([self.state[parameter][key] for parameter in parameters] for key in (*MOMENTS, "step"))
        beta1, beta2 = self._betas
        adam(
            [*parameters],
            gradients,
            first,
            second,
            [],
            steps,
            fused=True,
            amsgrad=False,
            maximize=False,
            beta1=beta1,
            beta2=beta2,
            lr=lr,
            weight_decay=0.0,
            eps=self._eps,
        )


@final
class MaskedAdam(Adam):
    """Adam by `kernels.adam_rows`: entries whose gradient is exactly 0 keep value and moments. Gradients may be sparse.

    A parameter's state has `ROW_RATES` too, where it has such.
    """

    _steps_beside_parameters = False

    def _adam_step(self, parameters: list[nn.Parameter], lr: float) -> None:
        for parameter in parameters:
            state = self.state[parameter]
            state["step"] += 1
            settings = AdamStep(lr, *self._betas, self._eps, int(state["step"]))
            assert parameter.grad is not None
            moments = state["exp_avg"], state["exp_avg_sq"]
            rows, gradient = _rows_of(parameter.grad)
            adam_rows(parameter.detach(), gradient, moments, settings, state.get(ROW_RATES), rows)


def _rows_of(gradient: Tensor) -> tuple[Int[Tensor, " k"] | None, Tensor]:
    """Rows that a sparse gradient of shape (*rows, c) has, each once and in the order of memory, and their values.

    ``None`` for the rows of a dense one.
    """
    if not gradient.is_sparse:
        return None, gradient
    # Autograd forgets that a gradient which it keeps is coalesced; to find that out costs less than to sort it again.
    rows = _flat(gradient._indices(), gradient.shape)
    if bool((rows[1:] <= rows[:-1]).any()):
        gradient = gradient.coalesce()
        rows = _flat(gradient._indices(), gradient.shape)
    return rows, gradient._values()


def _flat(indices: Int[Tensor, "d k"], shape: torch.Size) -> Int[Tensor, " k"]:
    """Indices of rows of an array of this shape, last axis excepted, in the order of memory."""
    flat = indices[0]
    for axis, size in zip(indices[1:], shape[1:-1], strict=True):
        flat = flat * size + axis
    return flat
