"""Adaptive resolution: as many pixels as render in a fixed time while the camera moves, full size at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass

TARGET_SECONDS = 0.085
"""Time from request to frame while the camera moves, encoding included: ten frames a second, with a margin for noise. Also of
one strip of a still."""
SETTLE_SECONDS = 0.2
"""Seconds without input after which the camera counts as at rest."""
INITIAL_PIXELS, MIN_PIXELS, MAX_PIXELS = 40 * 40, 12 * 12, 1 << 22
"""Pixel budget: initial value and range."""
MAX_RISE, MAX_DROP = 2.0, 8.0
"""Largest factors by which one measurement raises or lowers the budget: a slow frame is worse than a coarse one."""
PYRAMID_FACTOR = 2.5
"""Approximate ratio of sides between levels: all coarser levels cost a fifth of the last."""


@dataclass
class AdaptiveResolution:
    """Controller of the pixel budget that keeps frames within `TARGET_SECONDS`.

    Attributes:
        pixels: current budget.
    """

    pixels: float = float(INITIAL_PIXELS)

    def update(self, pixels: int, seconds: float) -> None:
        """Update the budget from one measurement: ``pixels`` rendered in ``seconds``."""
        wanted = pixels * TARGET_SECONDS / max(seconds, 1e-6)
        self.pixels = min(max(wanted, self.pixels / MAX_DROP, MIN_PIXELS), self.pixels * MAX_RISE, float(MAX_PIXELS))

    def pyramid_scales(self, width: int, height: int, skip_coarse: bool = False, renderers: int = 1) -> list[float]:
        """Scales of the levels that lead to ``width`` x ``height``, from coarse to 1.

        Args:
            width: of the finest level.
            height: likewise.
            skip_coarse: start with the finest level, because an image is on screen already.
            renderers: number of images that share `TARGET_SECONDS`.
        """
        coarse = math.sqrt(max(self.pixels / renderers, MIN_PIXELS) / (width * height))
        if skip_coarse or coarse >= 1:
            return [1.0]
        steps = max(1, round(-math.log(coarse, PYRAMID_FACTOR)))
        return [coarse ** (1 - step / steps) for step in range(steps + 1)]

    def strip_rows(self, width: int) -> int:
        """Rows of a strip of ``width`` columns within the budget."""
        return max(1, int(self.pixels) // width)
