"""Intervals, p-values and false alarms against scipy, statsmodels and simulation."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_up_runs import made_up_run
from scipy import stats
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.weightstats import DescrStatsW

from invgraphics.report.data.factors import METHOD, Factor, Observation
from invgraphics.report.statistics.effects import Effect, SceneEffect, contrasts_of, effects_of
from invgraphics.report.statistics.intervals import Estimate, band, estimate, holm
from invgraphics.report.statistics.pairing import Contrast, sample
from invgraphics.report.statistics.sentences import effect_sentence
from invgraphics.report.statistics.settings import SettingEffect
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
        for k in range(seeds):
            lucky = rng.normal(0, 0.5)
            for levels in itertools.product(*(factor.levels for factor in factors)):
                named = dict(zip((factor.path for factor in factors), levels, strict=True))
                shift = effect * (named.get("data.train_views") == "20")
                values = hard + lucky + shift + rng.normal(0, 0.4) + rng.normal(0, 0.5, views)
                observations.append(Observation(run_with(f"scene-{s}", k, values), f"scene-{s}", {METHOD: "m"} | named))
    return observations


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


@pytest.mark.parametrize("shape", [(1, 4, 8), (3, 3, 8)])
def test_planted_effect_is_found_and_nothing_else(shape: tuple[int, int, int]) -> None:
    effects = effects_of(contrasts_of(FACTORS[1:]), PSNR, simulated(np.random.default_rng(3), FACTORS[1:], shape, effect=-9.0))
    assert [effect.found for effect in effects] == [effect.factor == "data.train_views" for effect in effects]
    assert effects[0].estimate.low < -9.0 < effects[0].estimate.high
    assert effect_sentence(effects[0]).startswith("data.train_views 20 instead of 40 costs ")


@pytest.mark.parametrize(("shape", "over"), [((1, 3, 5), "seeds"), ((2, 4, 5), "seeds"), ((6, 2, 3), "scenes")])
def test_intervals_cover_the_true_mean_as_often_as_they_say(shape: tuple[int, int, int], over: Any) -> None:
    rng, hits, rounds = np.random.default_rng(5), 0, 600
    for _ in range(rounds):
        fits = 1.5 + rng.normal(0, 1, (*shape[:2], 1)) + rng.normal(0, 2.0 if over == "scenes" else 0.0, (shape[0], 1, 1))
        found = estimate(nested_of(fits + rng.normal(0, 1, shape)), over)
        assert found is not None
        hits += found.low <= 1.5 <= found.high
    assert 0.93 <= hits / rounds <= 0.975


def test_one_scene_is_the_paired_t_test_of_seed_means() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(2, 5, 7))
    found = known([list(after - before)])
    expected = stats.ttest_rel(after.mean(axis=1), before.mean(axis=1))
    assert (found.unit, found.size) == ("seed", "5 seeds")
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


def test_scenes_as_units_are_student_over_scene_means() -> None:
    values = np.random.default_rng(4).normal(1, 1, (4, 2, 3))
    found = estimate(nested_of(values), "scenes")
    assert found is not None and found.unit == "scene"
    expected = stats.ttest_1samp(values.mean(axis=(1, 2)), 0)
    assert found.p == pytest.approx(expected.pvalue)
    assert (found.low, found.high) == pytest.approx(tuple(expected.confidence_interval()))


def test_equivalence_is_that_of_statsmodels() -> None:
    values = np.random.default_rng(6).normal(0.1, 0.3, 8)
    found = known([[np.array([value]) for value in values]])
    for margin in (0.1, 0.3, 0.6):
        assert found.equivalence(margin) == pytest.approx(DescrStatsW(values).ttost_mean(-margin, margin)[0], rel=1e-9)


def test_estimates_without_spread() -> None:
    """Equal differences are not certain: their spread is unknown, and nothing is tested."""
    assert estimate([[np.array([np.nan])]]) is None
    single = known([[np.array([1.0, 2.0])]])
    assert (single.unit, single.p, single.low, single.high) == ("none", None, 1.5, 1.5)
    for value in (0.0, 2.0):
        same = known([[np.full(3, value), np.full(3, value)]])
        assert (same.unit, same.p, same.mean, same.half_width, same.detectable()) == ("none", None, value, 0.0, None)
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


VIEWS = Contrast("data.train_views", "40", "20")


def effect_with(mean: float, half: float, **changes: Any) -> Effect:
    value = Estimate(mean, mean - half, mean + half, 0.001 if abs(mean) > half else 0.4, "seed", 1, (3, 3), half / 4.3, 2.0)
    return replace(Effect(VIEWS, PSNR, value, None, value.p, 5, 6, {}, {}), **changes)


def test_sentences() -> None:
    assert effect_sentence(effect_with(-2.1, 0.3)) == "data.train_views 20 instead of 40 costs 2.10 dB [1.80, 2.40], 3 seeds."
    assert "gains 2.10 dB [1.80, 2.40]" in effect_sentence(effect_with(2.1, 0.3))
    nothing = effect_sentence(effect_with(0.1, 0.3))
    assert nothing.startswith("data.train_views 20 instead of 40: undecided, 0.10 dB [−0.20, 0.40], 3 seeds; an effect of ")
    assert nothing.endswith(" would be found with 80% power after correction for 5 comparisons.")
    doubtful = effect_with(-2.1, 0.3, adjusted=0.08)
    assert not doubtful.found
    assert "with 5 such comparisons that may be chance (corrected p = 0.08)" in effect_sentence(doubtful)
    flip = quality_quantity("flip", Score(mean=0.0, higher_is_better=False))
    assert "costs 0.030 FLIP [0.020, 0.040]" in effect_sentence(effect_with(0.03, 0.01, quantity=flip))
    alone = Estimate(-1.0, -1.0, -1.0, None, "none", 1, (1, 1))
    assert "with one seed only, which cannot be told from chance" in effect_sentence(
        effect_with(0, 0, estimate=alone, adjusted=None)
    )
    same = Estimate(0.0, 0.0, 0.0, None, "none", 1, (3, 3))
    assert (
        effect_sentence(effect_with(0, 0, estimate=same)) == "data.train_views 20 instead of 40: no difference at all, 3 seeds."
    )
    steady = Estimate(-1.0, -1.0, -1.0, None, "none", 1, (2, 2))
    assert "by the same amount each time, 2 seeds: no spread is known" in effect_sentence(effect_with(0, 0, estimate=steady))
    assert "different pictures" in effect_sentence(effect_with(-2.1, 0.3, truths_differ=True))
    equal = effect_sentence(effect_with(0.05, 0.1, equivalence=0.01))
    assert "no effect beyond ±0.20 dB (equivalence test), 0.05 dB [−0.05, 0.15], 3 seeds." in equal
    between = effect_with(1, 0.1, contrast=Contrast(METHOD, "a/b", "c/d"))
    assert effect_sentence(between).startswith("c/d instead of a/b gains")


def test_methods_are_compared_over_the_same_levels_of_other_factors() -> None:
    """Seeds that lack a level, as in unfinished studies, are left out on each side: 20 dB at one level, 10 at the other."""

    def one(method: str, level: str, seed: int) -> Observation:
        value = {"easy": 20.0, "hard": 10.0}[level] + 0.01 * seed
        run = run_with("s", seed, np.array([value, value]))
        return Observation(replace(run, method=method), "s", {METHOD: method, "k": level})

    first = [one("a", level, seed) for level in ("easy", "hard") for seed in range(3)]
    unfinished = [one("b", "easy", seed) for seed in range(3)]
    contrast, psnr = Contrast(METHOD, "a", "b"), quality_quantity("psnr", first[0].run.scores.quality["psnr"])
    assert not sample(contrast, psnr, [*first, *unfinished, one("b", "hard", 3)]).scenes
    whole = sample(contrast, psnr, [*first, *unfinished, *(one("b", "hard", seed) for seed in (0, 1))])
    assert [len(values) for _, values in whole.scenes["s"]] == [2, 3]
    assert sum(sign * values.mean() for sign, values in whole.scenes["s"]) == pytest.approx(-0.005)


def test_nothing_has_no_sign() -> None:
    effect = effect_with(0.1, 0.3)
    assert (effect.text(-0.001), effect.text(-0.01), effect.text(0.0)) == ("0.00", "−0.01", "0.00")


def test_many_levels_are_compared_with_the_reference_only() -> None:
    assert Factor("x", ("1", "2", "3"), "2").pairs() == [("2", "1"), ("2", "3"), ("1", "3")]
    assert Factor("x", tuple("12345"), "3").pairs() == [("3", "1"), ("3", "2"), ("3", "4"), ("3", "5")]


@pytest.mark.parametrize("comparisons", [1, 5, 20, 63, 1000])
def test_the_detectable_effect_of_two_fits_grows_with_the_number_of_comparisons(comparisons: int) -> None:
    """At one degree of freedom the ratio of effects is half-Cauchy: 80 % power needs tan(0.4 pi) = 3.08 critical values."""
    expected = math.tan(0.4 * math.pi) * stats.t.isf(0.025 / comparisons, 1)
    assert Estimate(1, 0, 2, 0.5, "seed", 1, (2, 2), 1.0, 1.0).detectable(comparisons) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("freedom", "comparisons"), [(2.0, 1), (2.0, 100), (3.7, 4), (12.0, 1), (500.0, 3)])
def test_the_detectable_effect_is_that_of_simulated_repetitions(freedom: float, comparisons: int) -> None:
    rng = np.random.default_rng(12)
    effect = Estimate(1, 0, 2, 0.5, "seed", 1, (3, 3), 1.0, freedom).detectable(comparisons)
    assert effect is not None
    stated, repeated = np.sqrt(rng.chisquare(freedom, (2, 200_000)) / freedom)
    found = rng.normal(size=200_000) + effect * stated > stats.t.isf(0.025 / comparisons, freedom) * repeated
    assert found.mean() == pytest.approx(0.8, abs=0.004)


def test_a_significant_mean_and_one_significant_setting_or_scene_of_the_other_sign_are_opposed() -> None:
    """The mean has a sign, and no other setting is significant by itself."""
    ill = Estimate(-0.5, -0.6, -0.4, 0.001, "seed", 1, (3, 3), 0.05, 2.0)
    well = Estimate(2.0, -0.5, 4.5, 0.08, "seed", 1, (3, 3), 0.5, 2.0)
    places = {str(i): (well, 0.2) for i in range(7)} | {"bad": (ill, 0.01)}
    settings = {name: SettingEffect(one, None, adjusted) for name, (one, adjusted) in places.items()}
    scenes = {name: SceneEffect(one, adjusted) for name, (one, adjusted) in places.items()}
    for adjusted, opposed in ((0.01, True), (0.2, False)):
        by_setting, by_scene = (
            effect_with(1.7, 0.3, adjusted=adjusted, **{k: v}) for k, v in (("by_setting", settings), ("by_scene", scenes))
        )
        assert (by_setting.opposed, by_scene.contradicted) == (opposed, opposed)
        assert not by_setting.found and not by_scene.found
        assert ("the sign depends on other factors" in effect_sentence(by_setting)) == opposed
        assert ("no common direction" in effect_sentence(by_scene)) == opposed
