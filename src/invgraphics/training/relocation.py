"""Relocation of dead Gaussians, growth under a cap, and Langevin noise (3DGS-MCMC, Kheradmand et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.training.gaussians import GAUSSIANS, GaussianParameters, cap_at
from invgraphics.training.hooks import FitState, Hook
from invgraphics.training.rows import replace_rows

MOST_COPIES = 51
"""Most Gaussians that take the place of one at once (gsplat's; the authors' code has 50)."""
LARGEST_OPACITY = 1 - 1e-6
GATE_SLOPE = 100.0
"""Steepness of the sigmoid in opacity that keeps noise to transparent Gaussians."""
NEGLIGIBLE = 1e-4
"""Value of that sigmoid below which no noise is drawn."""


@dataclass(frozen=True)
class RelocationConfig:
    """Relocation under a cap, on a schedule of progress; needs the losses ``opacity`` and ``scale`` beside it.

    Attributes:
        start: progress at which relocating and growing begins (paper: 500 of 30,000 steps).
        stop: progress at which it ends (paper: 25,000 of 30,000).
        every: steps between two rounds.
        dead: opacity up to which a Gaussian is dead.
        growth: most new Gaussians of a round, as a share of those there are, until there are ``max_primitives``.
        max_primitives: cap.
        cap_ramp: progress, from ``start`` on, over which the cap rises from the first number, by equal factors; 0 for at once.
        noise: standard deviation of the noise on means, per learning rate and covariance; 0 for none.
        gate: opacity at which a Gaussian gets half of the noise, more opaque ones less (the authors' constant).
    """

    start: float = 1 / 60
    stop: float = 5 / 6
    every: int = 100
    dead: float = 0.005
    growth: float = 0.05
    max_primitives: int = 1_000_000
    cap_ramp: float = 0.0
    noise: float = 5e5
    gate: float = 0.005

    def __post_init__(self) -> None:
        if self.every < 1 or self.max_primitives < 1:
            raise ValueError("'every' and 'max_primitives' must be at least 1.")
        if not (0 < self.dead < 1 and 0 < self.gate < 1) or min(self.growth, self.noise, self.cap_ramp) < 0:
            raise ValueError("'dead' and 'gate' must lie between 0 and 1, 'growth', 'noise' and 'cap_ramp' at 0 or above.")

    def capped(self, most: int) -> RelocationConfig:
        """The same, growing to at most ``most`` Gaussians."""
        return replace(self, max_primitives=most)

    def build(self) -> Relocation:
        """The hook."""
        return Relocation(self)


class Relocation(Hook):
    """Relocates dead Gaussians, adds new ones up to the cap, and perturbs the means."""

    name = "relocation"
    requires = GAUSSIANS

    def __init__(self, config: RelocationConfig) -> None:
        self._config = config
        self._first = 0

    @override
    @torch.no_grad()
    def after_step(self, state: FitState) -> None:
        config = self._config
        if (state.step + 1) % config.every == 0 and config.start <= state.ctx.progress < config.stop:
            self._relocate(state)
            self._grow(state)
        if config.noise:
            _perturb(state, config.noise * state.optimiser.rate_of("field.means"), config.gate)

    def _relocate(self, state: FitState) -> None:
        """Move dead Gaussians to living ones, drawn by opacity."""
        opacities = torch.sigmoid(cast(GaussianParameters, state.field).opacity_logits)
        dead = (opacities <= self._config.dead).nonzero()[:, 0]
        if 0 < len(dead) < len(opacities):
            probabilities = torch.where(opacities <= self._config.dead, 0.0, opacities)
            self._copy(state, _draw(probabilities, len(dead), state), dead)

    def _grow(self, state: FitState) -> None:
        opacities = torch.sigmoid(cast(GaussianParameters, state.field).opacity_logits)
        config, n = self._config, len(opacities)
        self._first = self._first or n
        limit = cap_at(self._first, config.max_primitives, state.ctx.progress - config.start, config.cap_ramp)
        added = min(limit, int(n * (1 + config.growth))) - n
        if added > 0:
            self._copy(state, _draw(opacities, added, state), torch.arange(n, n + added, device=opacities.device))

    @override
    def state_dict(self) -> dict[str, Tensor]:
        return {"first": torch.tensor(self._first)}

    @override
    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._first = int(state["first"])

    def _copy(self, state: FitState, source: Int[Tensor, " k"], target: Int[Tensor, " k"]) -> None:
        """Copy rows ``source`` to rows ``target``, which may lie behind the last, with opacities and scales by equation 9."""
        old = {name: parameter.detach() for name, parameter in state.field.named_parameters()}
        n, total = len(old["means"]), max(len(old["means"]), int(target.max()) + 1)
        new = {name: torch.cat([values, values.new_zeros(total - n, *values.shape[1:])]) for name, values in old.items()}
        parents, copies = torch.unique(source, return_counts=True)
        opacity, shrink = relocated_opacity(torch.sigmoid(old["opacity_logits"][parents]), copies + 1)
        new["opacity_logits"][parents] = torch.logit(opacity.clamp(self._config.dead, LARGEST_OPACITY))
        new["log_scales"][parents] += shrink.log()[:, None]
        for values in new.values():
            values[target] = values[source]
        replace_rows(state, new, torch.arange(n, device=source.device), total - n)
        for name in new:
            state.optimiser.reset_moments(f"field.{name}", torch.cat([parents, target]))


def _draw(probabilities: Float[Tensor, " n"], count: int, state: FitState) -> Int[Tensor, " k"]:
    """Multinomial sample of rows with replacement; on the CPU, where the fit's generator lives."""
    cumulated = probabilities.double().cpu().cumsum(0)
    draws = torch.rand(count, generator=state.ctx.generator, dtype=torch.float64) * cumulated[-1]
    return torch.searchsorted(cumulated, draws, right=True).clamp_max(len(probabilities) - 1).to(probabilities.device)


def relocated_opacity(
    opacity: Float[Tensor, " n"], copies: Int[Tensor, " n"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Opacity of each of N coinciding Gaussians that render like one of ``opacity``, and the factor on their scales.

    ``(1 - o')^N = 1 - o`` at the centre, and the scale keeps the integral of alpha over a line through it. The paper's double
    sum over i and k is written as one, over j with the binomials of N.

    Args:
        opacity: of the one, in [0, 1].
        copies: N, at least 1; clamped to `MOST_COPIES`.
    """
    wide, n = opacity.double().clamp_max(LARGEST_OPACITY), copies.double().clamp_max(MOST_COPIES)
    each = 1 - (1 - wide) ** (1 / n)
    total, binomial = torch.zeros_like(wide), torch.ones_like(wide)
    for j in range(1, int(n.max()) + 1 if len(n) else 1):
        binomial = binomial * (n - j + 1).clamp_min(0.0) / j
        total += (1 if j % 2 else -1) * binomial * each**j / j**0.5
    return each.to(opacity), (wide / total).to(opacity)


def _perturb(state: FitState, strength: float, middle: float) -> None:
    """Add Langevin noise with each Gaussian's covariance to the means of nearly transparent Gaussians (equation 8)."""
    field = cast(GaussianParameters, state.field)
    gate = torch.sigmoid(GATE_SLOPE * (middle - torch.sigmoid(field.opacity_logits)))
    rows = (gate > NEGLIGIBLE).nonzero()[:, 0]
    if len(rows) == 0:
        return
    axes = quaternion_to_matrix(field.quaternions[rows]) * field.log_scales[rows].exp()[:, None, :]
    draws = torch.randn(len(rows), 3, generator=state.ctx.generator).to(axes)
    noise = (axes @ (axes.transpose(1, 2) @ (draws * gate[rows, None])[:, :, None]))[:, :, 0]
    field.means[rows] += strength * noise
