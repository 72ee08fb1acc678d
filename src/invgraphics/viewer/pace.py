"""How large a picture may be: small while the camera moves, whole when it rests, by the measured speed of rendering."""

from __future__ import annotations

import math
from dataclasses import dataclass

TARGET = 0.08
"""Seconds that rendering may take while the camera moves (with sending, ten pictures a second), and an uncut piece of work."""
REST = 0.2
"""Seconds without news after which the camera counts as resting."""
FIRST, LEAST, MOST = 40 * 40, 12 * 12, 1 << 22
"""Pixels of the first picture, and the least and the most that a picture may be given."""
STEP = 2.0
"""Largest factor by which one measurement changes the number of pixels: single measurements are noisy."""
GROWTH = 2.5
"""How much longer the sides of each finer picture are, about: what leads to the finest costs a fifth of it."""


@dataclass
class Pace:
    """Learns how many pixels can be rendered in `TARGET` seconds.

    Attributes:
        pixels: that number, as far as it is known.
    """

    pixels: float = float(FIRST)

    def learn(self, pixels: int, seconds: float) -> None:
        """Take note that so many pixels took so many seconds."""
        wanted = pixels * TARGET / max(seconds, 1e-6)
        self.pixels = min(max(wanted, self.pixels / STEP, LEAST), self.pixels * STEP, float(MOST))

    def scales(self, width: int, height: int, resting: bool = False, sharing: int = 1) -> list[float]:
        """Scales of the pictures that lead to one of ``width`` x ``height``, from coarse to 1.

        Args:
            width: of the finest picture.
            height: likewise.
            resting: whether the coarse ones can be left out, because there is a picture already.
            sharing: pictures that `TARGET` has to do for.
        """
        coarse = math.sqrt(max(self.pixels / sharing, LEAST) / (width * height))
        if resting or coarse >= 1:
            return [1.0]
        steps = max(1, round(-math.log(coarse, GROWTH)))
        return [coarse ** (1 - step / steps) for step in range(steps + 1)]

    def rows(self, width: int) -> int:
        """Rows of a picture that make one piece of work."""
        return max(1, int(self.pixels) // width)
