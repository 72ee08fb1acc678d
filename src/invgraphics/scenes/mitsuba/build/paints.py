"""Random paints of objects of a class."""

from __future__ import annotations

import colorsys

import numpy as np

from invgraphics.scenes.mitsuba.build.surfaces import Colour, to_linear


def paint(rng: np.random.Generator) -> Colour:
    """Draw a linear colour: any hue, from greyish to saturated, neither black nor white."""
    r, g, b = to_linear(np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.1, 0.85), rng.uniform(0.35, 0.95)))).tolist()
    return r, g, b
