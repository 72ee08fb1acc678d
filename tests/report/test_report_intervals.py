"""Interval plots: the bar on which a verdict rests is seen whole, or is seen to go on."""

from __future__ import annotations

import math
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from invgraphics.report.figures.effects import _limits, draw_intervals
from invgraphics.report.statistics.effects import Effect
from invgraphics.report.statistics.intervals import Estimate
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.wording import quality_quantity
from invgraphics.runs.scores import Score

PSNR = quality_quantity("psnr", Score(mean=0.0, unit="dB", higher_is_better=True))
SVG = "{http://www.w3.org/2000/svg}"


def effect(mean: float, seeds: float, scenes: float | None, after: str = "b") -> Effect:
    """An effect with the half widths of its interval over seeds and over scenes."""
    estimate = Estimate(mean, mean - seeds, mean + seeds, 0.01, "seed", 3, (3, 3), 0.1, 4.0)
    across = None if scenes is None else Estimate(mean, mean - scenes, mean + scenes, 0.01, "scene", 3, (3, 3), 0.1, 2.0)
    return Effect(Contrast("field.x", "a", after), PSNR, estimate, across, 0.01, 1, 9, {}, {})


def arrows(path: Path) -> set[str]:
    return {name for one in ElementTree.parse(path).iter() if (name := one.get("id", "")).startswith("beyond")}


def test_the_interval_over_scenes_is_within_the_frame(tmp_path: Path) -> None:
    """That of the committed study of Gaussians' parts, [1.76, 9.83], whose bar ended at the frame."""
    shown = [effect(5.8, 0.3, 4.035), effect(-0.4, 0.2, 0.9, "c"), effect(0.1, 0.1, None, "d")]
    low, high = _limits(shown)
    assert low < -1.3 and high > 9.835
    figure = draw_intervals(shown, tmp_path)
    assert figure is not None and figure.narrow is not None
    assert not arrows(figure.path) | arrows(figure.narrow)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("scenes", [None, 400.0])
def test_a_bar_that_leaves_the_plot_ends_in_an_arrowhead(tmp_path: Path, sign: int, scenes: float | None) -> None:
    """An interval hundreds of times wider than the others does not squeeze them; and nothing else gets an arrowhead."""
    wide = effect(sign * 0.5, 300.0 if scenes is None else 1.0, scenes)
    shown = [wide, *(effect(0.2, 0.1, 0.2, after) for after in "cde")]
    low, high = _limits(shown)
    assert -5 < low < 0 < high < 5
    figure = draw_intervals(shown, tmp_path)
    assert figure is not None
    tree = ElementTree.parse(figure.path)
    groups = {one.get("id", ""): one for one in tree.iter(f"{SVG}g")}
    places = {name: float(use.get("x", "nan")) for name in arrows(figure.path) for use in groups[name].iter(f"{SVG}use")}
    assert places.keys() == {"beyond-low-0", "beyond-high-0"}
    width = float(re.split(r"[ ,]+", tree.getroot().get("viewBox", ""))[2])
    assert places["beyond-low-0"] < 0.1 * width and places["beyond-high-0"] > 0.9 * width


def test_limits_of_effects_without_any_spread_are_a_frame() -> None:
    low, high = _limits([effect(0.0, 0.0, None)])
    assert math.isfinite(low) and low < 0 < high
