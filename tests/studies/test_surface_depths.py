"""Depths of densities made from a distance, against closed forms on a ball seen along its axis and over its disc."""

import math
from itertools import pairwise

import pytest

from invgraphics.studies import surfaces


def test_gaps_fall_with_the_width() -> None:
    """VolSDF's about with the width, NeuS's, unbiased to first order, faster."""
    widths = (0.04, 0.02, 0.01)
    volsdf, neus = ([surfaces.depth_gap(of(width)) for width in widths] for of in (surfaces.volsdf, surfaces.neus))
    assert all(1.5 < before / after < 2.1 for before, after in pairwise(volsdf))
    assert all(before / after > 2.5 for before, after in pairwise(neus))
    assert all(a < b for a, b in zip(neus, volsdf, strict=True))


def test_what_even_steps_leave() -> None:
    """At a width far below a step, a hit is the middle of its interval: a quarter of a step away; half of one behind it if the
    density at the middle stands for the interval."""
    step = 2 / surfaces.STEPS
    assert surfaces.depth_gap(surfaces.volsdf(1e-4)) == pytest.approx(step / 4, rel=0.15)
    assert surfaces.depth_gap(surfaces.at_points(1e-4)) == pytest.approx(step / 2, rel=0.2)


def test_the_analysis_names_where_depths_meet() -> None:
    analysis = surfaces.depth_over_width()
    assert [curve.label for curve in analysis.curves][::2] == ["VolSDF", "NeuS"]
    for curve in analysis.curves:
        assert curve.x == pytest.approx([-math.log10(width) for width in surfaces.WIDTHS])
        widest = max(width for width, gap in zip(surfaces.WIDTHS, curve.y, strict=True) if gap <= surfaces.MET)
        assert f"{curve.label} from a width of {widest:g}" in analysis.sentence
