"""What may not be called an effect: one fit, opposite signs, lost, incomplete and disturbed fits; on made-up scores."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from made_up_runs import made_up_run

from invgraphics.report.data.factors import METHOD, Observation
from invgraphics.report.statistics.effects import Effect, effects_of
from invgraphics.report.statistics.intervals import over_seeds
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.statistics.sentences import effect_sentence
from invgraphics.report.wording import quality_quantity
from invgraphics.runs.scores import Score

PSNR = quality_quantity("psnr", Score(mean=0.0, unit="dB", higher_is_better=True))
A_TO_B = Contrast(METHOD, "A", "B")
SIZE = Contrast("size", "8", "16")


def fit(psnr: float, scene: str = "s", seed: int = 0, method: str = "m", **levels: str) -> Observation:
    quality = {"psnr": Score(mean=psnr, unit="dB", higher_is_better=True, per_view=(psnr,))}
    run = made_up_run(quality, method, seed, truth=scene, views=("0",))
    return Observation(run, scene, {METHOD: method} | levels)


def effect_of(contrast: Contrast, fits: list[Observation], *lost: Any) -> Effect:
    (effect,) = effects_of([contrast], PSNR, fits, lost)
    return effect


def fits_of(scenes: int, seeds: int, psnr: Callable[[int, str], float]) -> list[Observation]:
    """Fits of two methods whose scores depend on scene and method."""
    return [fit(psnr(s, m), f"s{s}", k, m) for s in range(scenes) for k in range(seeds) for m in "AB"]


def test_one_fit_of_a_method_borrows_no_spread_from_another() -> None:
    """Three close fits of A tell nothing of how fits of B scatter: with ten times A's spread, half of such pages were wrong."""
    one = effect_of(A_TO_B, [*(fit(25 + 0.01 * k, seed=k, method="A") for k in range(3)), fit(26.0, method="B")])
    assert one.estimate.p is None and one.estimate.unit == "none" and not one.found
    assert (
        effect_sentence(one) == "B instead of A gains 0.99 dB with one seed only on one side, which cannot be told from chance."
    )


def test_a_side_borrows_spread_from_its_own_fits_on_other_scenes() -> None:
    """Of two scenes, the second has one fit of B: B's spread is that of the first scene, A's is by itself."""
    first, second = np.array([1.0, 3.0, 2.0]), np.array([0.0, 5.0, 1.0, 2.0])
    scenes = [[(1.0, second), (-1.0, first)], [(1.0, np.array([7.0])), (-1.0, first)]]
    found = over_seeds(scenes)
    assert found is not None
    parts = [(second.var(ddof=1) * (1 / 4 + 1), 3), (first.var(ddof=1) / 3, 2), (first.var(ddof=1) / 3, 2)]
    total = sum(share for share, _ in parts)
    assert found.error == pytest.approx(np.sqrt(total) / 2, rel=1e-12)
    assert found.freedom == pytest.approx(total**2 / sum(share**2 / free for share, free in parts), rel=1e-12)
