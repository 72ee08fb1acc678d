"""Predictions of a study on made-up scores: intervals against scipy, every verdict, growth with a factor, losses, the page."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from made_up_runs import made_up_run
from report_folders import PREDICTED
from scipy import stats

from invgraphics.errors import InputError
from invgraphics.report.data.factors import Factor, FailedFit, Observation
from invgraphics.report.statistics.effects import contrasts_of, effects_of
from invgraphics.report.statistics.predictions import PREDICTION_HEADS, judge_predictions, predictions_sentence
from invgraphics.report.wording import quality_quantity
from invgraphics.runs.scores import Score
from invgraphics.runs.study import Prediction
from invgraphics.studies.checks import checked, completed
from invgraphics.studies.study import Study

N = "field.count"
SPLAT, EXACT = "splatting/gaussians", "gaussian-volume/exact"
GAIN = {("ball", 4): 0.6, ("ball", 100): 0.0, ("fog", 4): 0.2, ("fog", 100): 0.9}
METHODS = Prediction(
    text="The integral is better.", source="a paper", before={"method": SPLAT}, after={"method": EXACT}, low=0.3, high=0.9
)


def fit(scene: str, method: str, count: int, seed: int, psnr: float) -> Observation:
    score = Score(mean=psnr, unit="dB", higher_is_better=True)
    run = made_up_run({"psnr": score}, method=method, seed=seed, truth=scene)
    return Observation(run, scene, {"method": method, N: str(count), "field.init": "random"})


def fits(noise: float = 0.02, seeds: int = 4) -> list[Observation]:
    rng = np.random.default_rng(0)
    return [
        fit(scene, method, count, seed, 30 + (gain if method == EXACT else 0) + rng.normal(0, noise))
        for (scene, count), gain in GAIN.items()
        for method in (SPLAT, EXACT)
        for seed in range(seeds)
    ]


def values(made: list[Observation], scene: str, method: str, count: int) -> np.ndarray:
    wanted = (scene, method, str(count))
    return np.array([
        one.run.scores.quality["psnr"].mean for one in made if (one.scene, one.levels["method"], one.levels[N]) == wanted
    ])  # fmt: skip


def test_interval_over_two_methods_is_welchs() -> None:
    made = fits()
    (judged,) = judge_predictions([replace(METHODS, where={N: 4}, scenes=("ball",))], made)
    expected = stats.ttest_ind(values(made, "ball", EXACT, 4), values(made, "ball", SPLAT, 4), equal_var=False)
    low, high = expected.confidence_interval()
    assert judged.estimate is not None
    assert (judged.estimate.low, judged.estimate.high) == pytest.approx((low, high), rel=1e-9)
    assert judged.verdict == "held"


def test_interval_within_a_method_is_paired() -> None:
    made = fits()
    wanted = replace(
        METHODS, before={"method": EXACT, N: 4}, after={"method": EXACT, N: 100}, scenes=("fog",), low=0.0, high=None
    )
    (judged,) = judge_predictions([wanted], made)
    pairs = values(made, "fog", EXACT, 100) - values(made, "fog", EXACT, 4)
    low, high = stats.ttest_1samp(pairs, 0).confidence_interval()
    assert judged.estimate is not None
    assert (judged.estimate.low, judged.estimate.high) == pytest.approx((low, high), rel=1e-9)


@pytest.mark.parametrize(
    ("scene", "where", "against", "low", "high", "verdict"),
    [
        ("ball", 4, None, 0.3, 0.9, "held"),
        ("ball", 100, None, 0.3, 0.9, "failed"),
        ("ball", 100, None, None, 0.2, "held"),
        ("ball", 4, None, 0.6, None, "undecided"),  # the bound lies within the interval
        ("fog", 4, 100, 0.0, None, "held"),  # grows by 0.7
        ("ball", 4, 100, 0.0, None, "failed"),  # shrinks by 0.6
        ("ball", 7, None, 0.0, None, "open"),
    ],
)
def test_verdicts(scene: str, where: int, against: int | None, low: float | None, high: float | None, verdict: str) -> None:
    there = {} if against is None else {N: against}
    one = replace(METHODS, scenes=(scene,), where={N: where}, against=there, low=low, high=high)
    (judged,) = judge_predictions([one], fits())
    assert judged.verdict == verdict
    if against is not None:
        assert judged.estimate is not None
        assert judged.estimate.mean == pytest.approx(GAIN[scene, against] - GAIN[scene, where], abs=0.05)


def test_nothing_is_claimed_from_one_seed_or_after_losses() -> None:
    held = replace(METHODS, where={N: 4}, scenes=("ball",))
    (single,) = judge_predictions([held], fits(seeds=1))
    assert single.verdict == "undecided"
    assert "no interval from 1 seed" in single.cells[-1]
    levels = {"method": SPLAT, N: "4", "field.init": "random"}
    lost = [FailedFit("ball", levels), FailedFit("fog", levels), FailedFit("ball", levels | {"field.init": "stereo"})]
    (fewer,) = judge_predictions([held], fits(), lost)  # of the three, one is on the scene and of settings that were fitted
    assert (fewer.verdict, fewer.lost) == ("undecided", 1)
    assert judge_predictions([held], fits(), lost[1:])[0].verdict == "held"
    assert predictions_sentence([single, fewer]) == "Of 2 predictions: 2 undecided."


def test_digits_are_those_of_the_metric_and_of_the_bounds() -> None:
    """A thousandth of SSIM is something; it was printed as +0.00."""
    small = Prediction(
        text="Better.", source="a paper", before={X: False}, after={X: True}, metric="ssim", low=0.002, high=0.0045
    )
    made = []
    for level, value in (("false", 0.9), ("true", 0.9031)):
        for seed in range(3):
            score = Score(mean=value + 1e-5 * seed * (level == "true"), higher_is_better=True)
            made.append(Observation(made_up_run({"ssim": score}, method="m", seed=seed), "ball", {"method": "m", X: level}))
    (judged,) = judge_predictions([small], made)
    assert judged.verdict == "held" and judged.cells[3] == "+0.0020 to +0.0045" and judged.cells[4].startswith("+0.0031")


X, VIEWS = "field.isotropic", "data.train_views"
SWITCH = Prediction(text="Isotropic Gaussians lose.", source="a paper", before={X: False}, after={X: True}, high=-0.1)


def at(seed: int, psnr: float, method: str, levels: dict[str, str]) -> Observation:
    run = made_up_run({"psnr": Score(mean=psnr, unit="dB", higher_is_better=True)}, method=method, seed=seed, truth="ball")
    return Observation(run, "ball", {"method": method, **levels})


def switch(seed: int, x: str, views: str) -> Observation:
    """Views are worth 4 dB, which are no part of the switch's effect of 0.02 dB on average."""
    psnr = 24.0 + 4.0 * (views == "12") + (0.01 + 0.02 * seed) * (x == "true")
    return at(seed, psnr, SPLAT, {X: x, VIEWS: views})


@pytest.mark.parametrize(
    "planned",
    [
        [("false", "6"), ("true", "6"), ("false", "12")],  # one at a time
        [("false", "12"), ("true", "6"), ("false", "6"), ("true", "24")],  # a list
    ],
)
def test_levels_that_one_side_lacks_are_left_out(planned: list[tuple[str, str]]) -> None:
    """As in the effects of the same study; with all fits of each side averaged it would be -2 dB."""
    made = [switch(seed, *cell) for cell in planned for seed in (0, 1)]
    (judged,) = judge_predictions([SWITCH], made)
    assert judged.estimate is not None
    assert judged.estimate.mean == pytest.approx(0.02)
    quantity = quality_quantity("psnr", made[0].run.scores.quality["psnr"])
    (effect,) = effects_of(contrasts_of([Factor(X, ("false", "true"), "false")]), quantity, made)
    assert (judged.estimate.mean, judged.estimate.p) == pytest.approx((effect.estimate.mean, effect.estimate.p))


def test_an_unfinished_factorial_compares_what_is_done() -> None:
    """Seed 1 lacks one fit: its pairs count, the fit without a partner does not."""
    cells = [(seed, x, views) for seed in (0, 1) for views in ("6", "12") for x in ("false", "true")]
    (judged,) = judge_predictions([SWITCH], [switch(*cell) for cell in cells[:-1]])
    assert judged.estimate is not None
    assert (judged.estimate.mean, judged.estimate.seeds) == (pytest.approx(0.02), (2, 2))


@pytest.mark.parametrize("named", [False, True])
def test_methods_are_compared_at_equal_levels(named: bool) -> None:
    """A factor that one method has stays at its base for the other; of a cut study, seeds that lack a level are left out."""
    scope = "gaussian-volume/*:renderer.opacity"
    made = []
    for seed in range(3):
        for views, worth in (("6", 0.0), ("12", 4.0)):
            for method, opacity, gain in ((SPLAT, "peak", 0.0), (EXACT, "peak", 0.5), (EXACT, "extinction", 3.0)):
                made.append(at(seed, 24 + worth + gain + 0.01 * seed, method, {VIEWS: views, scope: opacity}))
    wanted = replace(METHODS, after={"method": EXACT, scope: "extinction"}) if named else METHODS
    (judged,) = judge_predictions([wanted], made[:-1])
    assert judged.estimate is not None
    assert judged.estimate.mean == pytest.approx(2.995 if named else 0.5, abs=1e-9)
    assert judged.estimate.seeds == ((2, 3) if named else (3, 3))


def test_growth_from_method_to_method_is_of_independent_groups() -> None:
    """Each method's differences pair by seed; the two methods' do not."""
    made = fits()
    wanted = replace(
        METHODS, before={N: 4}, after={N: 100}, where={"method": SPLAT}, against={"method": EXACT}, scenes=("fog",)
    )
    (judged,) = judge_predictions([wanted], made)
    ours, theirs = (values(made, "fog", method, 100) - values(made, "fog", method, 4) for method in (EXACT, SPLAT))
    expected = stats.ttest_ind(ours, theirs, equal_var=False).confidence_interval()
    assert judged.estimate is not None
    assert (judged.estimate.low, judged.estimate.high) == pytest.approx((expected.low, expected.high), rel=1e-9)


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        ([(0, "false", "6"), (0, "true", "12")], "its sides have no level of data.train_views in common"),
        ([(0, "false", "6"), (1, "true", "6")], "no seed has fits of all sides"),
        ([(0, "false", "6")], "no finished fit at field.isotropic true"),
        ([], "no finished fit has the metric psnr"),
    ],
)
def test_what_was_not_measured_says_why(made: list[tuple[int, str, str]], reason: str) -> None:
    (judged,) = judge_predictions([SWITCH], [switch(*cell) for cell in made])
    assert (judged.verdict, judged.estimate) == ("open", None)
    assert judged.cells[-1].startswith(f"not measured: {reason}")


def test_the_page_states_the_verdict(built_study: Path) -> None:
    table = pd.read_csv(built_study / "results.csv", dtype=str)
    table = table[(table["metric"] == "psnr") & (table["scene"] == "moons") & (table["field.encoding.levels"] == "8")]
    table["value"] = table["value"].astype(float)
    means = table[table["status"] == "ok"].groupby(["data.train_views", "seed"])["value"].mean().unstack(0)
    low, high = stats.ttest_1samp(means["20"] - means["40"], 0).confidence_interval()
    page, text = ((built_study / name).read_text() for name in ("index.html", "index.md"))
    verdict = "held" if high < -0.1 else "failed" if low > -0.1 else "undecided"
    row = page.split(f'data-verdict="{verdict}"')[1].split("</tr>")[0]
    assert PREDICTED["text"] in row
    assert f"<td>{low:+.2f} to {high:+.2f}</td>".replace("-", "−") in row
    assert "Of 1 prediction: 1 " in page
    assert f"| {PREDICTED['text']} | a paper | moons | at most −0.10 |" in text


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"where": {"field.size": 4}}, "no factor"),
        ({"where": {N: 5}}, "none of its levels"),
        ({"scenes": ("room",)}, "none of the study's scenes"),
        ({"after": {"method": SPLAT}}, "same fits"),
        ({"against": {N: 100}}, "'against'"),
    ],
)
def test_predictions_of_what_a_study_lacks_are_refused(change: dict, word: str) -> None:
    study = Study("?", ("bricks",), (SPLAT, EXACT), factors={N: [4, 100]}, predictions=(replace(METHODS, **change),))
    with pytest.raises(InputError, match=word):
        checked(completed(study, "here"), "here")


def test_a_prediction_needs_bounds_in_order() -> None:
    for low, high in ((None, None), (1.0, 0.0)):
        with pytest.raises(ValueError, match="low"):
            replace(METHODS, low=low, high=high)


def gains(*gains: float, seeds: int = 3, noise: float = 0.03) -> list[Observation]:
    """Fits of two methods, the second better by so much on each scene."""
    rng = np.random.default_rng(6)
    return [
        fit(f"s{index}", method, 4, seed, 20 + gain * (method == EXACT) + rng.normal(0, noise))
        for index, gain in enumerate(gains)
        for seed in range(seeds)
        for method in (SPLAT, EXACT)
    ]


BETTER = replace(METHODS, low=1.0, high=None)


def test_several_scenes_are_judged_as_a_sample_of_scenes() -> None:
    """Three seeds tell a mean of three scenes to 0.04 dB, and nothing of a fourth."""
    (judged,) = judge_predictions([BETTER], gains(3.0, 2.9, -1.0))
    assert judged.estimate is not None and judged.estimate.low > 1.0  # on these scenes it holds
    assert judged.verdict == "undecided" and judged.across is not None and judged.across.low < 1.0
    low, high = stats.t.interval(0.95, 2, judged.across.mean, stats.sem([3.0, 2.9, -1.0]))
    assert (judged.across.low, judged.across.high) == pytest.approx((low, high), abs=0.2)
    assert judged.cells[5] != judged.cells[6] and len(judged.cells) == len(PREDICTION_HEADS)
    (alike,) = judge_predictions([BETTER], gains(3.0, 2.9, 3.1))
    assert alike.verdict == "held" and alike.reason == ""
    (alone,) = judge_predictions([replace(BETTER, scenes=("s2",))], gains(3.0, 2.9, -1.0))
    assert alone.verdict == "failed" and alone.across is None


def test_a_scene_that_says_the_opposite_leaves_a_prediction_undecided() -> None:
    made = gains(*[3.0] * 9, 0.5)
    (judged,) = judge_predictions([BETTER], made)
    assert judged.across is not None and judged.across.low > 1.0
    assert (judged.verdict, judged.reason) == ("undecided", "did not hold on s9")
    (contrary,) = judge_predictions([replace(BETTER, low=None, high=1.0)], made)
    assert (contrary.verdict, contrary.reason) == ("undecided", "held on s9")


def test_a_prediction_for_all_scenes_is_about_those_without_fits_too() -> None:
    """Failed throughout, or not run yet."""
    made = gains(3.0, 2.9, 3.1)
    scenes = ("s0", "s1", "s2", "s3")
    assert judge_predictions([BETTER], made, scenes=scenes[:3])[0].verdict == "held"
    (missing,) = judge_predictions([BETTER], made, scenes=scenes)
    assert (missing.verdict, missing.reason) == ("undecided", "no fits of all sides on s3")
    lost = [FailedFit("s3", {"method": method, N: "4"}) for method in (SPLAT, EXACT)]
    (failed,) = judge_predictions([BETTER], made, lost, scenes)
    assert (failed.verdict, failed.lost) == ("undecided", 2)


def test_scenes_without_fits_leave_a_prediction_undecided() -> None:
    wanted = replace(BETTER, scenes=("s0", "s1", "s2"))
    assert judge_predictions([wanted], gains(3.0, 2.9, 3.1))[0].verdict == "held"
    (judged,) = judge_predictions([wanted], gains(3.0))
    assert judged.cells[-1] == "undecided: no fits of all sides on s1 and s2"


@pytest.mark.parametrize("methods", [(SPLAT, SPLAT), (SPLAT, EXACT)])
def test_predictions_hold_views_equal(methods: tuple[str, str]) -> None:
    """A view of 20 degrees that one fit lacks is no gain of that fit, whether fits pair or not."""
    made = []
    for method, level in zip(methods, ("false", "true"), strict=True):
        for seed in range(3):
            own = 5 + 0.01 * seed * (level == "true")
            values = (own, None if (level, seed) == ("true", 1) else 20.0)
            score = Score(mean=own if None in values else (own + 20) / 2, higher_is_better=False, per_view=values)
            run = made_up_run({"normal_deg": score}, method=method, seed=seed, views=("0", "1"))
            made.append(Observation(run, "ball", {"method": method, X: "false" if methods[0] != methods[1] else level}))
    sides = ({"method": SPLAT}, {"method": EXACT}) if methods[0] != methods[1] else ({X: False}, {X: True})
    stated = Prediction(text="?", source="?", before=sides[0], after=sides[1], metric="normal_deg", high=-1.0)
    (judged,) = judge_predictions([stated], made)
    assert judged.estimate is not None and judged.estimate.mean == pytest.approx(0.0075, abs=0.01)
    factor = Factor("method", methods, SPLAT) if methods[0] != methods[1] else Factor(X, ("false", "true"), "false")
    quantity = quality_quantity("normal_deg", made[0].run.scores.quality["normal_deg"])
    (effect,) = effects_of(contrasts_of([factor]), quantity, made)
    assert judged.estimate == effect.estimate
