"""What may not be called an effect: one fit, opposite signs, lost, incomplete and disturbed fits; on made-up scores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jinja2 import Environment, PackageLoader
from made_up_runs import made_up_run

from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import METHOD, FailedFit, Observation
from invgraphics.report.figures.effects import draw_intervals
from invgraphics.report.pages.tables import markdown_effects, write_latex_effects
from invgraphics.report.statistics.effects import Effect, effects_of
from invgraphics.report.statistics.intervals import over_seeds
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.statistics.predictions import judge_predictions
from invgraphics.report.statistics.sentences import effect_sentence
from invgraphics.report.statistics.summary import summarise
from invgraphics.report.wording import quality_quantity
from invgraphics.runs.run import Run
from invgraphics.runs.scores import Score
from invgraphics.runs.study import Prediction

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
    """Three close fits of A tell nothing of how fits of B scatter: with ten times A's spread, two pages of three were wrong."""
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


GAINS = (1.0, 1.2, 1.1, 0.9, 1.0, 1.05, -0.5)


def test_an_effect_that_a_scene_contradicts_is_no_winner(tmp_path: Path) -> None:
    """Six scenes gain 1 dB, the seventh loses 0.5: the mean is significant over scenes, and not true of the seventh."""
    rng = np.random.default_rng(3)
    contrary = effect_of(A_TO_B, fits_of(7, 4, lambda s, m: 20 + GAINS[s] * (m == "B") + rng.normal(0, 0.02)))
    assert contrary.adjusted is not None and contrary.adjusted < 0.02 and contrary.scenes("lower") == ["s6"]
    assert not contrary.found and not contrary.uncorrected and contrary.contradicted
    sentence = effect_sentence(contrary)
    assert "no common direction" in sentence and "worse on s6" in sentence and "gains" not in sentence
    common = effect_of(A_TO_B, fits_of(7, 4, lambda s, m: 20 + abs(GAINS[s]) * (m == "B") + rng.normal(0, 0.02)))
    assert common.found
    assert _bold(common, tmp_path) == (True, True, True, True)
    assert _bold(contrary, tmp_path) == (False, False, False, False)


def _bold(effect: Effect, folder: Path) -> tuple[bool, bool, bool, bool]:
    """Whether a difference is bold in Markdown, LaTeX and HTML, and its mark filled in the plot."""
    mean = effect.text(effect.estimate.mean)
    write_latex_effects([effect], "caption", folder / "effects.tex")
    environment = Environment(loader=PackageLoader("invgraphics.report", "templates"))
    macros: Any = environment.get_template("sections.html").make_module()
    figure = draw_intervals([effect], folder)
    assert figure is not None
    return (
        f"**{mean} dB**" in markdown_effects([effect]),
        f"textbf{{{mean} dB}}" in (folder / "effects.tex").read_text(),
        f"<b>{mean}</b>" in macros.effect_table(effect.quantity, [effect]).split("this scene alone")[0],
        "stroke-width: 1.8" not in figure.path.read_text(),
    )


def test_scenes_of_opposite_signs_are_not_equal() -> None:
    """Sixteen scenes that gain or lose 0.35 dB: their mean is zero within 0.2, and no scene is."""
    rng = np.random.default_rng(4)
    for size, equal in ((0.35, False), (0.05, True)):
        signs = [size if s % 2 else -size for s in range(16)]
        effect = effect_of(A_TO_B, fits_of(16, 1, lambda s, m, g=signs: 20 + g[s] * (m == "B") + rng.normal(0, 0.03)))
        assert effect.equivalence is not None and effect.equivalence < 0.05
        assert effect.equivalent == equal
        assert ("no effect beyond" in effect_sentence(effect)) == equal


NORMALS = Score(mean=0.0, unit="degrees", higher_is_better=False)
UNSEEN = "view 0001: no pixel shows a surface (alpha >= 0.5) in both truth and prediction"


def surface(method: str, seed: int, degrees: float | None) -> Run:
    """A fit with an error of its normals, or with the reason why it has none."""
    quality = {"psnr": Score(mean=30 + 0.01 * seed, unit="dB", higher_is_better=True)}
    quality |= {} if degrees is None else {"normal_deg": replace(NORMALS, mean=degrees, per_view=(degrees, degrees))}
    skipped = {"normal_deg": UNSEEN} if degrees is None else {}
    return made_up_run(quality, method, seed, "s", views=("0", "1"), skipped=skipped)


@pytest.mark.parametrize("lost", [True, False])
def test_a_seed_without_a_value_does_not_help_its_method(lost: bool) -> None:
    """The fourth fit of A has no surface to score; the other three look better than B."""
    errors = {"A": (10.0, 10.1, 10.05, None if lost else 10.02), "B": (12.0, 12.1, 12.05, 12.02)}
    runs = tuple(surface(method, seed, value) for method, values in errors.items() for seed, value in enumerate(values))
    quantity = quality_quantity("normal_deg", NORMALS)
    observations = [Observation(run, "s", {METHOD: run.method}) for run in runs]
    (effect,) = effects_of([Contrast(METHOD, "B", "A")], quantity, observations)
    assert (effect.lost, effect.found, effect.flattered) == ((0, int(lost)), not lost, lost)
    summary = summarise(Comparison("s", "?", ("A", "B"), runs, budget="60s"))
    assert any(row.cells[1].best for row in summary.rows) != lost and summary.rows[0].ranked_in(quantity) != lost
    if lost:
        unscored = [replace(run, scores=replace(run.scores, quality={})) for run in runs if run.method == "A"]
        others = [Observation(run, "s", {METHOD: "A"}) for run in unscored]
        assert not effects_of([A_TO_B], quantity, [*others, *observations[4:]]), "what no seed has is undefined, not lost"
        assert summarise(Comparison("s", "?", ("A", "B"), (*unscored, *runs[4:]))).rows[0].lost == frozenset()


def factorial(*missing: tuple[int, str], seeds: int = 4) -> list[Observation]:
    """Pairs of two sizes with 5 photographs, where the second gains 5 dB, and with 40, where it gains nothing."""
    rng = np.random.default_rng(5)
    places = [(k, views, gain) for k in range(seeds) for views, gain in (("5", 5.0), ("40", 0.0)) if (k, views) not in missing]
    return [
        fit(20 + gain * (size == "16") + rng.normal(0, 0.02), seed=k, size=size, views=views)
        for k, views, gain in places
        for size in ("8", "16")
    ]


@pytest.mark.parametrize(
    ("missing", "mean", "seeds"),
    [
        ([], 2.5, 4),
        ([(3, "40")], 2.5, 3),  # the seed goes: three of both settings are more than four of one
        ([(1, "40"), (2, "40"), (3, "40")], 5.0, 4),  # the setting goes, which a single seed has
        ([(0, "40"), (1, "40"), (2, "5"), (3, "5")], 5.0, 2),  # no seed has both
    ],
)
def test_incomplete_seeds_do_not_mix_settings(missing: list[tuple[int, str]], mean: float, seeds: int) -> None:
    """A seed that has one of two settings has that setting's difference, which is no draw of their mean."""
    fits = factorial(*missing)
    effect = effect_of(SIZE, fits)
    assert effect.estimate.mean == pytest.approx(mean, abs=0.05) and effect.estimate.half_width < 0.3
    assert effect.estimate.seeds == (seeds, seeds)
    stated = Prediction(text="?", source="?", before={"size": "8"}, after={"size": "16"}, low=mean - 0.5, high=mean + 0.5)
    (judged,) = judge_predictions([stated], fits)
    assert judged.verdict == "held" or seeds == 2
    assert judged.estimate is not None and judged.estimate.mean == pytest.approx(effect.estimate.mean)


def test_a_fit_lost_on_a_scene_does_not_help_its_method_there() -> None:
    """B gains 2 dB on both scenes and lost a fit on the first, A one on the second: in total they lost equally many."""
    rng = np.random.default_rng(7)
    missing = {("s0", "B"), ("s1", "A")}
    fits = fits_of(2, 5, lambda s, m: 25 + 2 * (m == "B") + rng.normal(0, 0.1))
    fits = [one for one in fits if (one.scene, one.levels[METHOD]) not in missing or one.run.seed]
    effect = effect_of(A_TO_B, fits, *(FailedFit(scene, {METHOD: method}) for scene, method in missing))
    assert effect.lost == (1, 1) and not effect.flattered
    assert {scene: one.verdict for scene, one in effect.by_scene.items()} == {"s0": "undecided", "s1": "higher"}


def test_fits_lost_at_settings_make_no_opposite_signs() -> None:
    """At each setting the side that lost its worst fit looks better by 1 dB, which is no sign that depends on the setting."""
    rng = np.random.default_rng(8)
    fits, lost = [], []
    for views, loser in (("5", "16"), ("40", "8")):
        for seed, size in ((seed, size) for seed in range(5) for size in ("8", "16")):
            if size == loser and seed == 0:
                lost.append(FailedFit("s", {METHOD: "m", "size": size, "views": views}))
            else:
                fits.append(fit(20 + (size == loser) + rng.normal(0, 0.1), seed=seed, size=size, views=views))
    effect = effect_of(SIZE, fits, *lost)
    assert effect.lost == (1, 1) and not effect.opposed
    assert [one.sign for one in effect.by_setting.values()] == [0, 0]
    assert effect_of(SIZE, fits).opposed, "with nothing lost they are opposite"


@pytest.mark.parametrize("gain", [1.0, 0.001])
def test_equal_differences_are_equal_whatever_rounding_makes_of_them(gain: float) -> None:
    """The differences of 20.31 + 0.001 and 33.07 + 0.001 are not the same number: two seeds gave a p-value of 1e-12."""
    rng = np.random.default_rng(10)
    for base in rng.uniform(20, 40, (40, 2)).round(2):
        fits = [fit(psnr + more, seed=k, size=size) for k, psnr in enumerate(base) for size, more in (("8", 0.0), ("16", gain))]
        one = effect_of(SIZE, fits)
        assert one.estimate.p is None and not one.found and "nothing is tested" in effect_sentence(one)
        scenes = effect_of(SIZE, [replace(one, scene=f"s{one.run.seed}") for one in fits])
        assert scenes.across is not None and scenes.across.p is None
        stated = Prediction(text="?", source="?", before={"size": "8"}, after={"size": "16"}, low=0.0)
        assert judge_predictions([stated], fits)[0].verdict == "undecided"
