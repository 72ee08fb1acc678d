"""Intervals, p-values and false alarms against scipy, statsmodels and simulation."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from made_up_runs import made_up_run
from scipy import stats
from statsmodels.stats.multitest import multipletests

from invgraphics.report.data.factors import METHOD, Factor, Observation
from invgraphics.report.statistics.effects import Effect, effects_on
from invgraphics.report.statistics.intervals import ENOUGH, RESAMPLES, Estimate, band, estimate, holm
from invgraphics.report.wording import quality_quantity
from invgraphics.runs.run import Run
from invgraphics.runs.scores import Score

PSNR = quality_quantity("psnr", Score(mean=0.0, unit="dB", higher_is_better=True))
FACTORS = (
    Factor(METHOD, ("volumetric/nerf", "volumetric/hash"), "volumetric/nerf"),
    Factor("data.train_views", ("40", "20"), "40"),
    Factor("field.levels", ("8", "12", "16"), "8"),
)


def known(nested: list[list[np.ndarray]]) -> Estimate:
    found = estimate(nested)
    assert found is not None
    return found


def nested_of(block: np.ndarray) -> list[list[np.ndarray]]:
    """(scene, seed, view) as nested lists."""
    return [list(scene) for scene in block]


def run_with(scene: str, seed: int, values: np.ndarray) -> Run:
    score = Score(mean=float(values.mean()), unit="dB", higher_is_better=True, per_view=tuple(values.tolist()))
    return made_up_run({"psnr": score}, "m", seed, scene, scene=scene, views=tuple(map(str, range(len(values)))))


def simulated(
    rng: np.random.Generator, factors: tuple[Factor, ...], shape: tuple[int, int, int], effect: float = 0.0
) -> list[Observation]:
    """A study whose only effect is ``effect`` dB of 20 training views.

    Scenes, views of a scene and seeds have difficulties of their own, which all levels share; fits and pictures have noise.
    """
    scenes, seeds, views = shape
    observations = []
    for s in range(scenes):
        hard = rng.normal(25, 4) + rng.normal(0, 2, views)
        noise = 0.4 * (1 + 2 * (s % 2)) if 1 < seeds < ENOUGH else 0.4  # fixed scenes may differ in how reproducible they are
        for k in range(seeds):
            lucky = rng.normal(0, 0.5)
            for levels in itertools.product(*(factor.levels for factor in factors)):
                named = dict(zip((factor.path for factor in factors), levels, strict=True))
                shift = effect * (named.get("data.train_views") == "20")
                values = hard + lucky + shift + rng.normal(0, noise) + rng.normal(0, 0.5, views)
                observations.append(Observation(run_with(f"scene-{s}", k, values), f"scene-{s}", {METHOD: "m"} | named))
    return observations


@pytest.mark.parametrize(
    ("factors", "shape"),
    [
        (FACTORS, (1, 3, 8)),  # Student over seeds
        (FACTORS, (2, 3, 8)),  # Welch over seeds of two scenes
        (FACTORS[:2], (4, 1, 8)),  # Student over scenes
        (FACTORS[1:2], (1, ENOUGH, 6)),  # seed > view resampled
        (FACTORS[1:2], (ENOUGH, 2, 3)),  # scene > seed > view resampled
    ],
)
def test_of_200_null_studies_few_are_called_an_effect(factors: tuple[Factor, ...], shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(7)
    false = sum(any(effect.found for effect in effects_on(PSNR, factors, simulated(rng, factors, shape))) for _ in range(200))
    assert 0.02 * 200 <= false <= 0.09 * 200


def test_views_as_units_would_call_most_null_studies_an_effect() -> None:
    """What nesting is for: a t-test over all views of all seeds mistakes the noise of fits for an effect."""
    rng, false = np.random.default_rng(8), 0
    for _ in range(100):
        table = simulated(rng, FACTORS[1:2], (1, 3, 50))
        sides = [
            [o.run.scores.quality["psnr"].per_view for o in table if o.levels["data.train_views"] == level]
            for level in ("40", "20")
        ]
        false += stats.ttest_rel(np.ravel(sides[1]), np.ravel(sides[0])).pvalue < 0.05
    assert false > 50


@pytest.mark.parametrize("shape", [(1, 4, 8), (2, 3, 8), (1, ENOUGH, 6), (ENOUGH, 2, 3)])
def test_planted_effect_is_found_and_nothing_else(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(3)
    factors = FACTORS[1:] if shape[1] < ENOUGH > shape[0] else FACTORS[1:2]
    effects = effects_on(PSNR, factors, simulated(rng, factors, shape, effect=-9.0))
    assert [effect.found for effect in effects] == [effect.factor == "data.train_views" for effect in effects]
    assert effects[0].estimate.low < -9.0 < effects[0].estimate.high
    assert effects[0].sentence.startswith("data.train_views 20 instead of 40 costs ")


@pytest.mark.parametrize("shape", [(1, 3, 5), (2, 4, 5), (1, ENOUGH, 5), (ENOUGH, 2, 4)])
def test_intervals_cover_the_true_mean_as_often_as_they_say(shape: tuple[int, int, int]) -> None:
    rng, hits, rounds = np.random.default_rng(5), 0, 300
    for _ in range(rounds):
        fits = 1.5 + rng.normal(0, 1, (*shape[:2], 1)) + rng.normal(0, 0.7 if shape[0] >= ENOUGH else 0.0, (shape[0], 1, 1))
        found = known(nested_of(fits + rng.normal(0, 1, shape)))
        hits += found.low <= 1.5 <= found.high
    assert 0.92 <= hits / rounds <= 0.99


def test_one_scene_is_the_paired_t_test_of_seed_means() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(2, 5, 7))
    found = known([list(after - before)])
    expected = stats.ttest_rel(after.mean(axis=1), before.mean(axis=1))
    assert (found.unit, found.resampled, found.size) == ("seed", False, "5 seeds")
    assert found.p == pytest.approx(expected.pvalue, rel=1e-10)
    assert (found.low, found.high) == pytest.approx(tuple(expected.confidence_interval()), rel=1e-10)


def test_two_scenes_are_welch() -> None:
    """The mean of two scenes is half the difference of one and the negative of the other."""
    rng = np.random.default_rng(1)
    one, other = rng.normal(1, 1, (3, 6)), rng.normal(2, 5, (4, 6))
    found = known([list(one), list(other)])
    expected = stats.ttest_ind(one.mean(axis=1), -other.mean(axis=1), equal_var=False)
    interval = expected.confidence_interval()
    assert found.p == pytest.approx(expected.pvalue, rel=1e-10)
    assert (found.low, found.high) == pytest.approx((interval.low / 2, interval.high / 2), rel=1e-10)
    assert found.size == "3 to 4 seeds × 2 scenes"


def test_scene_with_one_seed_borrows_the_pooled_variance_of_least_squares() -> None:
    import statsmodels.api as sm

    rng = np.random.default_rng(2)
    scenes = [rng.normal(size=(3, 4)), rng.normal(size=(1, 4)), rng.normal(size=(2, 4))]
    found = known([list(scene) for scene in scenes])
    means = np.concatenate([scene.mean(axis=1) for scene in scenes])
    group = np.repeat([0, 1, 2], [3, 1, 2])
    coded = np.eye(3)[group][:, :2] - (group == 2)[:, None]  # sum coding: the intercept is the mean of group means
    fit = sm.OLS(means, sm.add_constant(coded)).fit()
    assert (found.low, found.high) == pytest.approx(tuple(fit.conf_int()[0]), rel=1e-10)
    assert found.p == pytest.approx(fit.pvalues[0], rel=1e-10)


def test_one_seed_on_each_of_several_scenes_makes_the_scene_the_unit() -> None:
    values = np.random.default_rng(4).normal(1, 1, (4, 1, 3))
    found = known(nested_of(values))
    expected = stats.ttest_1samp(values.mean(axis=(1, 2)), 0)
    assert found.unit == "scene"
    assert (found.low, found.high) == pytest.approx(tuple(expected.confidence_interval()))


def test_resampled_interval_is_near_student_and_dual_to_its_p_value() -> None:
    rng = np.random.default_rng(6)
    sides = []
    for shift in np.linspace(-0.9, 0.9, 40):
        values = rng.normal(shift, 1, (1, 12, 5)) + rng.normal(0, 0.3, (1, 12, 1))
        found = known(nested_of(values))
        expected = stats.ttest_1samp(values.mean(axis=2)[0], 0).confidence_interval()
        assert found.resampled
        assert found.half_width == pytest.approx((expected.high - expected.low) / 2, rel=0.35)
        assert found.p is not None
        assert (found.p <= 0.05) == (not found.low <= 0 <= found.high)
        assert found.p >= 1 / (RESAMPLES + 1)
        sides.append(found.p <= 0.05)
    assert 5 < sum(sides) < 35
    assert known(nested_of(values)) == found  # the same seeds draw the same resamples


def test_estimates_without_spread() -> None:
    assert estimate([[np.array([np.nan])]]) is None
    single = known([[np.array([1.0, 2.0])]])
    assert (single.unit, single.p, single.low, single.high) == ("none", None, 1.5, 1.5)
    same = known([[np.zeros(3), np.zeros(3)]])
    assert (same.p, same.half_width) == (1.0, 0.0)
    exact = known([[np.full(3, 2.0), np.full(3, 2.0)]])
    assert (exact.p, exact.mean, exact.half_width) == (0.0, 2.0, 0.0)
    holed = known([[np.array([1.0, np.inf]), np.array([3.0, 5.0]), np.array([np.nan, np.nan])]])
    assert (holed.mean, holed.seeds) == (2.5, (2, 2))


def test_holm_is_step_down_and_skips_what_has_no_p_value() -> None:
    p = [0.01, None, 0.04, 0.03]
    assert holm(p) == [pytest.approx(0.03), None, pytest.approx(0.06), pytest.approx(0.06)]
    assert holm([None]) == [None]


def test_holm_is_that_of_statsmodels() -> None:
    rng = np.random.default_rng(11)
    for count in (1, 2, 5, 12):
        p = [float(value) for value in np.round(rng.random(count) ** 4, 2)]  # rounded: with ties and zeros
        np.testing.assert_allclose(np.array(holm(p), dtype=float), multipletests(p, method="holm")[1], atol=1e-15)


def test_band_is_a_t_interval_at_each_time() -> None:
    values = np.random.default_rng(9).normal(size=(4, 6))
    mean, low, high = band(values)
    for i in range(6):
        expected = stats.ttest_1samp(values[:, i], 0).confidence_interval()
        assert (low[i], high[i]) == pytest.approx(tuple(expected))
    assert mean == pytest.approx(values.mean(axis=0))
    assert all(np.array_equal(line, values[0]) for line in band(values[:1]))


def effect_with(mean: float, half: float, **changes: object) -> Effect:
    value = Estimate(mean, mean - half, mean + half, 0.001 if abs(mean) > half else 0.4, "seed", False, 2, (3, 3))
    effect = Effect("data.train_views", "40", "20", PSNR, value, value.p, 5, 6, {}, {}, False)
    return replace(effect, **changes)  # type: ignore[arg-type]


def test_sentences() -> None:
    assert (
        effect_with(-2.1, 0.3).sentence == "data.train_views 20 instead of 40 costs 2.10 dB [1.80, 2.40], 3 seeds × 2 scenes."
    )
    assert "gains 2.10 dB [1.80, 2.40]" in effect_with(2.1, 0.3).sentence
    nothing = effect_with(0.1, 0.3).sentence
    assert nothing == "data.train_views 20 instead of 40: no effect detectable above 0.30 dB, 3 seeds × 2 scenes."
    doubtful = effect_with(-2.1, 0.3, adjusted=0.08)
    assert not doubtful.found
    assert "with 5 comparisons in this study that may be chance (corrected p = 0.08)" in doubtful.sentence
    flip = quality_quantity("flip", Score(mean=0.0, higher_is_better=False))
    assert "costs 0.030 FLIP [0.020, 0.040]" in effect_with(0.03, 0.01, quantity=flip).sentence
    alone = Estimate(-1.0, -1.0, -1.0, None, "none", False, 1, (1, 1))
    assert "one seed" in effect_with(0, 0, estimate=alone, adjusted=None).sentence
    same = Estimate(0.0, 0.0, 0.0, 1.0, "seed", False, 1, (3, 3))
    assert effect_with(0, 0, estimate=same).sentence == "data.train_views 20 instead of 40: no difference at all, 3 seeds."
    assert "different pictures" in effect_with(-2.1, 0.3, truths_differ=True).sentence
    assert effect_with(1, 0.1, factor=METHOD, before="a/b", after="c/d").sentence.startswith("c/d instead of a/b gains")


def test_many_levels_are_compared_with_the_reference_only() -> None:
    assert Factor("x", ("1", "2", "3"), "2").pairs() == [("2", "1"), ("2", "3"), ("1", "3")]
    assert Factor("x", tuple("12345"), "3").pairs() == [("3", "1"), ("3", "2"), ("3", "4"), ("3", "5")]
