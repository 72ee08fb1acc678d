"""Bounds on opacities and scales that keep gradients of Gaussians alive, and a count of the dead ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Camera, Field
from invgraphics.core.camera import pixel_sizes
from invgraphics.kernels.types import ALPHA_MIN
from invgraphics.training.gaussians import GAUSSIANS, GaussianParameters
from invgraphics.training.hooks import FitState, Hook

VANISHING_SLOPE = 2.0**-23
"""Slope of the sigmoid, in float32, below which an opacity is saturated: the rounding of 1."""
COLLAPSED = 1e-4
"""Largest standard deviation, in pixels of the nearest training camera, below which a scale no longer changes a footprint: its
square is lost beside the low-pass filter's 0.3 px² in float32."""
SMALLEST = 1e-12
"""Scale limit, local units, of a Gaussian at a camera's very position."""


@dataclass(frozen=True)
class LimitsConfig:
    """Clamps opacities and scales, after every step, to intervals in which they have gradients.

    Without it, long fits drive logits to where the float32 sigmoid has no slope, and scales to where the rasteriser's low-pass
    filter hides them; density control then copies what can no longer change.

    Attributes:
        min_opacity: lowest opacity before any 3D filter; the default lies between what the rasteriser still draws (1/255) and
            what density control and relocation take for transparent (0.005).
        max_opacity: highest opacity. The rasteriser clamps alpha at 0.99.
        min_scale: lowest standard deviation along any axis, in pixels of the nearest training camera.
        every: steps between two computations of the scale limits; there is one more after each replacement of rows.
    """

    min_opacity: float = 0.0045
    max_opacity: float = 0.99
    min_scale: float = 0.1
    every: int = 100

    def __post_init__(self) -> None:
        if not 0 < self.min_opacity < self.max_opacity < 1 or self.min_scale < 0 or self.every < 1:
            raise ValueError(
                "'min_opacity' and 'max_opacity' must ascend between 0 and 1, 'min_scale' at 0 or above, 'every' at 1 or above."
            )

    def build(self) -> Limits:
        """The hook."""
        return Limits(self)


class Limits(Hook):
    """Clamps opacities and scales after each step; the scale limits are kept for fits that are resumed."""

    name = "limits"
    requires = GAUSSIANS

    def __init__(self, config: LimitsConfig) -> None:
        self._config = config
        self._log_limit = torch.zeros(0)
        self._field: GaussianParameters | None = None
        self._means: Tensor | None = (
            None  # those that the limits are of: density control may replace rows, yet keep their number
        )

    @override
    def before_step(self, state: FitState) -> None:
        """Note which rows loaded limits are of, before another hook may replace them in this step."""
        field = cast(GaussianParameters, state.field)
        if self._means is None and len(self._log_limit) == len(field.means):
            self._field, self._means = field, field.means

    @override
    @torch.no_grad()
    def after_step(self, state: FitState) -> None:
        config, field = self._config, cast(GaussianParameters, state.field)
        field.opacity_logits.clamp_(_logit(config.min_opacity), _logit(config.max_opacity))
        if not config.min_scale:
            return
        replaced = self._means is not None and self._means is not field.means
        if replaced or len(self._log_limit) != len(field.means) or state.step % config.every == 0:
            sizes = pixel_sizes(field.means, state.cameras())
            self._log_limit = (config.min_scale * sizes).clamp_min(SMALLEST).log()
        self._field, self._means = field, field.means
        torch.maximum(field.log_scales, self._log_limit[:, None], out=field.log_scales)

    @override
    def state_dict(self) -> dict[str, Tensor]:
        """The limits; none where a later hook has replaced the rows that they are of."""
        replaced = self._field is not None and self._means is not self._field.means
        return {"log_limit": self._log_limit.new_zeros(0) if replaced else self._log_limit}

    @override
    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._log_limit, self._field, self._means = state["log_limit"], None, None


def _logit(opacity: float) -> float:
    return math.log(opacity / (1 - opacity))


DEAD_SHARE = 0.01
"""Share of dead Gaussians above which a fit is warned about."""


@dataclass(frozen=True, eq=False)
class DeadGaussians:
    """Masks of the Gaussians whose gradients vanish, by cause.

    Attributes:
        saturated: opacities whose sigmoid has no slope in float32.
        faded: opacities, behind the 3D filter, below what the rasteriser draws.
        collapsed: all three standard deviations vanish beside the low-pass filter.
    """

    saturated: Bool[Tensor, " n"]
    faded: Bool[Tensor, " n"]
    collapsed: Bool[Tensor, " n"]

    @property
    def any(self) -> Bool[Tensor, " n"]:
        """Gaussians that are dead for any cause."""
        return self.saturated | self.faded | self.collapsed

    @property
    def share(self) -> float:
        """Share of the Gaussians that are dead, in [0, 1]."""
        return float(self.any.float().mean()) if len(self.faded) else 0.0

    def sentence(self) -> str:
        """Share, number and causes in words."""
        causes = {"saturated opacity": self.saturated, "too faint to be drawn": self.faded, "collapsed scales": self.collapsed}
        parts = [f"{cause} {int(which.sum()):,}" for cause, which in causes.items()]
        return f"no gradient can change {100 * self.share:.2g} % of {len(self.faded):,} Gaussians ({', '.join(parts)})."


@torch.no_grad()
def dead_gaussians(field: Field, cameras: Sequence[Camera]) -> DeadGaussians | None:
    """Find Gaussians whose gradients vanish; ``None`` for a field without Gaussians.

    Args:
        field: what is fitted, or was.
        cameras: the training cameras.
    """
    if not GAUSSIANS.met_by(field):
        return None
    gaussians = cast(GaussianParameters, field)
    opacity = gaussians.opacity_logits.float().sigmoid()
    largest = gaussians.log_scales.amax(dim=1).exp()
    return DeadGaussians(
        saturated=(opacity * (1 - opacity) < VANISHING_SLOPE) & (opacity > 0.5),
        faded=opacity * gaussians.filter_attenuation() < ALPHA_MIN,
        collapsed=largest < COLLAPSED * pixel_sizes(gaussians.means, cameras),
    )
