"""Adam that leaves entries without gradient alone, with learning rates per row (DVGO, Sun et al. 2022)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from invgraphics.kernels import adam_rows
from invgraphics.kernels.types import AdamStep

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Names of the moments in an optimiser's state, torch's own."""
ROW_RATES = "row_rates"
"""Name there of a parameter's factors of the learning rate, one per row."""


class MaskedAdam(torch.optim.Optimizer):
    """Adam by `kernels.adam_rows`: entries whose gradient is exactly 0 keep value and moments.

    Its state has the names of torch's Adam, and `ROW_RATES` where a parameter has such.
    """

    def __init__(self, groups: Iterable[dict[str, Any]], betas: tuple[float, float], eps: float) -> None:
        super().__init__(groups, {"lr": 0.0, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Update every parameter that has a gradient."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._update(parameter, parameter.grad, group)

    def _update(self, parameter: nn.Parameter, gradient: Tensor, group: dict[str, Any]) -> None:
        state = self.state[parameter]
        if "step" not in state:
            state["step"] = torch.tensor(0.0)
            state |= {name: torch.zeros_like(parameter) for name in MOMENTS}
        state["step"] += 1
        beta1, beta2 = group["betas"]
        settings = AdamStep(group["lr"], beta1, beta2, group["eps"], int(state["step"]))
        adam_rows(parameter.detach(), gradient, (state["exp_avg"], state["exp_avg_sq"]), settings, state.get(ROW_RATES))
