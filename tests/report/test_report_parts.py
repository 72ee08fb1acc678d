"""The parts of a report against independent routes: brute force, closed forms, another reader."""

from __future__ import annotations

import itertools
import json
import math
import random
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from made_up_runs import made_up_run
from PIL import Image

from invgraphics.report.data.comparison import read_comparison
from invgraphics.report.data.factors import METHOD, Observation
from invgraphics.report.figures import views as pictures
from invgraphics.report.figures.curves import NARROW, WIDE, draw_curves
from invgraphics.report.figures.distributions import draw_distributions, per_view
from invgraphics.report.figures.style import GRID, INK, MUTED, PAGE, SERIES, spread_labels
from invgraphics.report.figures.tradeoffs import draw_tradeoffs
from invgraphics.report.statistics.effects import effects_of
from invgraphics.report.statistics.intervals import Estimate
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.statistics.summary import pareto_front, quality_columns, summarise
from invgraphics.report.statistics.time_to_quality import span_to_reach, time_to_quality
from invgraphics.report.statistics.verdict import verdict
from invgraphics.report.wording import budget_words, listing, quality_quantity, significant_decimals, times
from invgraphics.runs.comparison import Failure
from invgraphics.runs.run import Run
from invgraphics.runs.scores import Score
from invgraphics.text import duration, name_lines


def test_pareto_front_is_what_brute_force_finds() -> None:
    dice = random.Random(0)
    for _ in range(300):
        points = [(dice.randrange(6) / 2, dice.randrange(6) / 2) for _ in range(dice.randrange(1, 9))]
        dominated = {
            i for i, j in itertools.permutations(range(len(points)), 2)
            if points[j] != points[i] and points[j][0] <= points[i][0] and points[j][1] <= points[i][1]
        }  # fmt: skip
        assert sorted(pareto_front(points)) == sorted(set(range(len(points))) - dominated)


def test_time_to_reach_is_the_first_crossing(built_report: Path) -> None:
    comparison = read_comparison(built_report)
    for run in comparison.runs:
        lines = [json.loads(line) for line in (run.folder / "history.jsonl").read_text().splitlines()]
        measured = [(line["seconds"], line["psnr"]) for line in lines if "psnr" in line]
        for level in (12.0, 20.0, 25.0, 99.0):
            reached = [seconds for seconds, psnr in measured if psnr >= level]
            before = [seconds for seconds, _ in measured if reached and seconds < min(reached)]
            assert span_to_reach(run, level) == ((max(before, default=0.0), min(reached)) if reached else None)
    reach = time_to_quality(comparison)
    assert reach is not None
    assert list(reach.levels) == sorted(reach.levels)
    assert all(any(times[i] != "not reached" for _, _, times in reach.rows) for i in range(len(reach.levels)))


def test_a_time_is_told_as_exactly_as_the_monitor_looked(built_report: Path) -> None:
    """A look every 6 s is no 42.0 s; one every 0.2 s is."""
    comparison = read_comparison(built_report)

    def told(gap: float) -> set[str]:
        history = tuple(
            replace(comparison.runs[0].history[0], seconds=gap * i, psnr=10.0 + 20.0 * (i >= 7) + 0.01 * i) for i in range(12)
        )
        reach = time_to_quality(replace(comparison, runs=tuple(replace(run, history=history) for run in comparison.runs)))
        assert reach is not None
        return {time for _, _, times in reach.rows for time in times}

    assert told(6.0) == {"36–42 s"}
    assert told(0.2) == {"1.4 s"}


@pytest.mark.parametrize(
    ("seconds", "told"),
    [
        ((10.0, 30.0, None), "30.0 s"),
        ((None, 10.0, 30.0, 20.0), "25.0 s"),
        ((10.0, 20.0, None, None), "not reached"),
        ((10.0, None, None), "not reached"),
        ((None, 10.0, 20.0, None, 30.0), "30.0 s"),
    ],
)
def test_the_median_time_counts_seeds_that_never_got_there(
    built_report: Path, seconds: tuple[float | None, ...], told: str
) -> None:
    """Looks every tenth of a second, and PSNR jumps from 10 to 20 dB; by hand, a seed that never does comes last."""
    comparison = read_comparison(built_report)
    first = comparison.runs[0]

    def run(seed: int, reached: float | None) -> Run:
        when = 40.0 if reached is None else reached
        moments = (0.0, when - 0.1, when)
        values = (10.0, 10.0, 10.5 if reached is None else 20.0)
        history = tuple(replace(first.history[0], seconds=at, psnr=psnr) for at, psnr in zip(moments, values, strict=True))
        return replace(first, seed=seed, history=history)

    other = run(9, 5.0)  # of another method, so that the levels lie in between whatever the first one reaches
    runs = [run(seed, reached) for seed, reached in enumerate(seconds)]
    names = comparison.methods[:2]
    runs = (*(replace(one, method=names[0]) for one in runs), replace(other, method=names[1]))
    reach = time_to_quality(replace(comparison, methods=names, runs=runs))
    assert reach is not None and reach.levels[-1] == 20
    assert reach.rows[0][2][-1] == told and reach.rows[1][2][-1] == "5.0 s"


def test_failed_fits_never_get_there(built_report: Path) -> None:
    """One of three seeds is there after 20 s, two have failed: a median over all seeds is no 20 s."""
    comparison = read_comparison(built_report)
    first, name = comparison.runs[0], comparison.methods[0]
    moments = ((0.0, 10.0), (19.9, 10.0), (20.0, 20.0))
    history = tuple(replace(first.history[0], seconds=at, psnr=psnr) for at, psnr in moments)
    one = replace(comparison, methods=(name,), runs=(replace(first, history=history),), failures=())
    for failed, told in ((0, "20.0 s"), (1, "not reached"), (2, "not reached")):
        lost = tuple(Failure(method=name, seed=seed + 1, error="The fit failed.") for seed in range(failed))
        reach = time_to_quality(replace(one, failures=lost))
        assert reach is not None and reach.rows[0][2][-1] == told


def test_perfect_views_are_drawn_among_the_others() -> None:
    score = Score(mean=math.inf, per_view=(30.0, math.inf, None), unit="dB", higher_is_better=True)
    runs = [made_up_run({"psnr": replace(score, per_view=values)}) for values in (score.per_view, (32.0, 60.0, 10.0))]
    assert per_view(runs, quality_quantity("psnr", score)) == [31.0, 80.0, 10.0]


def test_methods_of_a_comparison_are_compared_as_the_page_says(built_report: Path) -> None:
    """On the same views, seeds as independent groups: a seed of one method says nothing of the same seed of another."""
    comparison = read_comparison(built_report)
    first, second = comparison.methods[:2]

    def compared(runs: tuple[Run, ...]) -> Estimate:
        observed = [Observation(run, comparison.scene, {METHOD: run.method}) for run in runs]
        (effect,) = effects_of([Contrast(METHOD, first, second)], quality_columns(comparison)[0], observed)
        return effect.estimate

    seeds = {0: 1, 1: 0}
    mixed = tuple(
        replace(run, seed=seeds.get(run.seed, run.seed) if run.method == first else run.seed) for run in comparison.runs
    )
    assert mixed != comparison.runs and compared(mixed) == compared(comparison.runs)
    page = (built_report / "index.html").read_text()
    lead = page.partition("<h2>Differences between methods</h2>")[2].partition("</p>")[0]
    assert "on the same test views" in lead and "independent groups" in lead and "aired" not in lead


def test_error_maps_average_to_the_reported_flip(built_report: Path) -> None:
    pytest.importorskip("flip_evaluator")
    run = built_report / "runs/volumetric-hash/seed-0"
    truth = next((built_report / "truth").iterdir())
    scores = json.loads((run / "scores.json").read_text())["quality"]["flip"]["per_view"]
    for view in (0, 3):
        images = [np.asarray(Image.open(folder / f"{view:04d}.png")) for folder in (truth, run / "test")]
        assert pictures.error_map(*images).mean() == pytest.approx(scores[view], abs=1e-5)


def test_without_flip_the_map_is_the_absolute_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "has_flip", lambda: False)
    a, b = np.zeros((4, 5, 3), np.uint8), np.full((4, 5, 3), 51, np.uint8)
    assert pictures.error_map(a, b) == pytest.approx(np.full((4, 5), 0.2))


def test_depth_maps_share_the_range_of_the_truth(built_report: Path) -> None:
    """The same depth gets the same colour in every picture of a view, and transparent means not opaque."""
    import matplotlib as mpl

    truth_folder = next((built_report / "truth").iterdir())
    truth = np.load(truth_folder / "0000.npz")
    solid = truth["alpha"] >= 0.5
    low, high = np.percentile(truth["depth"][solid], [1, 99])
    colours = mpl.colormaps["viridis_r"]
    # The file's 255 levels and the map's 256 bins disagree by at most one and a half bins; bytes are rounded by one half.
    tolerance = 1.5 * np.abs(np.diff(colours(np.linspace(0, 1, 256))[:, :3], axis=0)).max() * 255 + 0.5
    for name, source in (("truth", truth), ("1", np.load(built_report / "runs/volumetric-hash/seed-0/test/0000.npz"))):
        picture = np.asarray(Image.open(built_report / f"figures/views/0000/depth-{name}.png").convert("RGBA"))
        mask = source["alpha"].astype(np.float32) >= 0.5
        assert np.array_equal(picture[..., 3] > 0, mask)
        want = colours(((source["depth"][mask] - low) / (high - low)).clip(0, 1))[:, :3] * 255
        assert np.abs(picture[mask][:, :3] - want).max() < tolerance < 5


def test_views_shown_are_spread_and_hold_the_worst(built_report: Path) -> None:
    comparison = read_comparison(built_report)
    per_view = np.mean([run.scores.quality["psnr"].per_view for run in comparison.runs], axis=0)
    chosen = dict(pictures.choose_views(comparison.runs))
    assert {0, 2, 3, 5} <= set(chosen)
    assert "worst PSNR" in chosen[int(np.argmin(per_view))]


def test_figures_are_xml_that_knows_the_dark(built_report: Path) -> None:
    figures = sorted((built_report / "figures").glob("*.svg"))
    assert len(figures) == 2 + 2 + 4 + 6
    for path in figures:
        ElementTree.parse(path)
        assert "prefers-color-scheme: dark" in path.read_text()


def test_report_is_the_same_when_built_again(built_report: Path, comparison_folder: Path) -> None:
    from invgraphics.report.build import build_report

    build_report(comparison_folder)
    for name in ("index.html", "index.md", "results.csv", "table.tex", "figures/psnr-against-model-bytes.svg"):
        assert (comparison_folder / name).read_text() == (built_report / name).read_text(), name


@pytest.mark.parametrize("cost", [1e-300, 1e-30, 1e30, math.inf])
def test_costs_that_no_axis_holds_are_not_drawn(
    comparison_folder: Path, tmp_path: Path, edit: Callable[..., None], cost: float
) -> None:
    from invgraphics.report.build import build_report

    scores = next(comparison_folder.glob("runs/*/seed-*/scores.json"))
    edit(scores, lambda table: table["cost"].update(fit_seconds=cost))
    comparison = read_comparison(comparison_folder)
    summary = summarise(comparison)
    assert verdict(comparison, summary)
    figures = draw_tradeoffs(summary, tmp_path)
    assert any(figure.path.stem == "psnr-against-model-bytes" for figure in figures)
    for figure in figures:
        ElementTree.parse(figure.path)
    if cost == math.inf:
        assert build_report(comparison_folder).is_file()


def test_report_is_small(built_report: Path) -> None:
    assert sum(path.stat().st_size for path in built_report.rglob("*") if path.is_file()) < 10e6


def luminance(colour: str) -> float:
    values = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(a: str, b: str) -> float:
    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_colours_stand_out_on_both_pages() -> None:
    for tone in (*SERIES, MUTED):
        assert contrast(tone.light, PAGE.light) >= 3
        assert contrast(tone.dark, PAGE.dark) >= 3
    for tone in (INK, MUTED):
        assert contrast(tone.light, PAGE.light) >= 4.5
        assert contrast(tone.dark, PAGE.dark) >= 4.5
    assert contrast(GRID.light, PAGE.light) < 1.5


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("splatting/gaussians-absgrad", ["splatting/gaussians-absgrad"]),
        ("volumetric/hash:field.width=16:batches.rays=64", ["volumetric/hash:", "field.width=16:", "batches.rays=64"]),
        ("optimiser.groups.background.lr=0.0015", ["optimiser.groups.background.", "lr=0.0015"]),
        ("x" * 60, ["x" * 28, "x" * 28, "xxxx"]),
        ("a/" * 100, ["a/" * 14, "a/" * 14, "a/" * 14, "a/" * 13 + "a…"]),
    ],
)
def test_long_names_are_broken_where_they_may(name: str, lines: list[str]) -> None:
    assert name_lines(name, 28) == lines


def test_plots_of_long_names_keep_their_room(comparison_folder: Path, tmp_path: Path) -> None:
    """No line is long, plots of many names grow, and layout that fails is an error of the whole suite: see `filterwarnings`."""
    comparison = read_comparison(comparison_folder)
    suffix = ":optimiser.groups.colour.lr=0.0012345:field.count=60:field.sh_degree="
    longer = {f"{method}{suffix}{i}": method for i in range(6) for method in comparison.methods}
    runs = tuple(replace(run, method=name) for name, method in longer.items() for run in comparison.runs_of(method))
    comparison = replace(comparison, methods=tuple(longer), runs=runs, shown=())
    summary = summarise(comparison)
    curves = draw_curves(comparison, summary, tmp_path)
    assert curves is not None
    assert curves.narrow is not None
    for path, usual in ((curves.path, WIDE), (curves.narrow, NARROW)):
        assert float(ElementTree.parse(path).getroot().attrib["height"].removesuffix("pt")) > usual[1]
    strips = draw_distributions(comparison, summary, tmp_path)
    assert len(strips) == len(quality_columns(comparison))
    for path in tmp_path.glob("*.svg"):
        named = [text for text in re.findall(r">([^<>]+)<", path.read_text()) if "optimiser" in text]
        assert named, path
        assert max(map(len, named)) <= 42
    for figure in draw_tradeoffs(summary, tmp_path / "tradeoffs"):
        named = [text for text in re.findall(r">([^<>]+)<", figure.path.read_text()) if "optimiser" in text]
        assert max(map(len, named), default=0) <= 28


def test_labels_are_pushed_apart_no_further_than_needed() -> None:
    placed = spread_labels([1.0, 1.1, 5.0], gap=1.0, low=0.0, high=10.0)
    assert placed[1] - placed[0] == pytest.approx(1.0)
    assert placed[2] == 5.0
    assert spread_labels([0.1, 0.2], gap=1.0, low=0.0, high=10.0)[0] == pytest.approx(0.0)


def _below_baseline(run: Run) -> Run:
    return replace(run, scores=replace(run.scores, below_baseline=f"{run.method}: fog."))


def test_verdict_counts_what_seeds_cannot_resolve(built_report: Path) -> None:
    from invgraphics.report.statistics.summary import summarise

    comparison = read_comparison(built_report)
    told = " ".join(verdict(comparison, summarise(comparison)))
    assert "volumetric/hash reaches the highest PSNR" in told
    assert "that lead" in told
    single = replace(comparison, runs=tuple(run for run in comparison.runs if run.seed == 0))
    assert "names no winner" in " ".join(verdict(single, summarise(single)))
    pair = replace(comparison, runs=tuple(run for run in comparison.runs if run.seed < 2))

    def scattered(run: Run) -> Run:
        """One method gains 2 dB from one seed to the next, the others nothing."""
        gain = 2.0 * run.seed if run.method == "volumetric/hash" else 0.0
        views = tuple(20.0 + gain for _ in run.scores.views)
        psnr = replace(run.scores.quality["psnr"], mean=20.0 + gain, per_view=views)
        return replace(run, scores=replace(run.scores, quality={"psnr": psnr}))

    pair = replace(pair, runs=tuple(map(scattered, pair.runs)))
    told = " ".join(verdict(pair, summarise(pair)))
    # One degree of freedom and a standard error of 1 dB: 39.16 of them are found with 80 % power (Monte Carlo: 0.799).
    found = re.search(
        r"2 seeds cannot tell that lead from chance: an effect of ([\d.]+) dB would be found with 80% power", told
    )
    assert found is not None and float(found[1]) == pytest.approx(39.16, rel=0.01)
    better = replace(comparison.runs[0].scores.quality["psnr"], mean=28.0)
    bad = replace(comparison, baselines={"nearest view": {"psnr": better}})
    assert "did not beat the trivial baseline 'nearest view'" in " ".join(verdict(bad, summarise(bad)))
    foggy = replace(comparison, runs=tuple(_below_baseline(run) for run in comparison.runs))
    told = verdict(foggy, summarise(foggy))
    assert [told.count(f"{method}: fog.") for method in comparison.methods] == [1] * len(comparison.methods)


def test_words() -> None:
    assert listing(["a"]) == "a"
    assert listing("abc") == "a, b and c"
    assert [times(ratio) for ratio in (1.44, 14.2, 137.0)] == ["1.4", "14", "140"]
    assert [duration(s) for s in (12, 412, 600, 7260)] == ["12 s", "6 min 52 s", "10 min", "2 h 1 min"]
    assert [budget_words(b) for b in ("60s", "5000steps", "2m", "60 s", "1step", "odd")] == [
        "60 s", "5,000 steps", "2 min", "60 s", "1 steps", "odd",
    ]  # fmt: skip
    assert [significant_decimals(v) for v in (1234.0, 12.3, 0.0123)] == [0, 1, 4]


def test_report_never_imports_torch() -> None:
    code = "import sys, invgraphics.report.build; sys.exit('torch' in sys.modules or 'matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_verdict_says_on_which_side_of_a_line_the_winner_is(built_report: Path) -> None:
    from invgraphics.report.statistics.summary import summarise

    comparison = read_comparison(built_report)
    score = comparison.runs[0].scores.quality["psnr"]
    for ceiling, baseline, words in (
        (41.7, 10.0, ("below the truth", "ahead of the better")),
        (20.0, 50.0, ("above the", "behind the")),
    ):
        changed = replace(comparison, noise_ceiling=ceiling, baselines={"mean image": {"psnr": replace(score, mean=baseline)}})
        told = verdict(changed, summarise(changed))[0]
        assert all(word in told for word in words), told
    alone = replace(comparison, methods=comparison.methods[:1], runs=comparison.runs_of(comparison.methods[0]))
    assert "reaches a PSNR of" in verdict(alone, summarise(alone))[0]
