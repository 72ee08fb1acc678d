"""Fits whose cores others had: their times are shown in red, and never ranked."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from made_up_runs import made_up_run
from report_folders import write_comparison

from invgraphics.report.build import build_report
from invgraphics.report.data.assets import Folder
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import METHOD, Observation
from invgraphics.report.figures.tradeoffs import draw_tradeoffs
from invgraphics.report.pages.facts import shared_facts
from invgraphics.report.pages.parts import draw_contrasts
from invgraphics.report.pages.tables import markdown_effects
from invgraphics.report.statistics.effects import effects_of
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.statistics.sentences import effect_sentence
from invgraphics.report.statistics.summary import summarise
from invgraphics.report.statistics.verdict import verdict
from invgraphics.report.wording import COSTS
from invgraphics.runs.run import Run
from invgraphics.runs.scores import Score

TOLD = "had 50 % of the processor time that it was ready to use; other programs had the rest"


def _run(method: str, seed: int, fps: float, disturbed: str = "", speed: float | None = None) -> Run:
    quality = {"psnr": Score(mean=30.0 + fps / 100 + 1e-3 * seed, unit="dB", higher_is_better=True)}
    cost = {"fit_seconds": 60.0, "fit_cpu_seconds": 100.0, "render_fps": fps + 0.02 * seed, "model_bytes": 1e6 * fps}
    cost |= {} if speed is None else {"fit_processor_speed": speed}
    return made_up_run(quality, method, seed, scene="s", preset="laptop", cost=cost, disturbed=disturbed)


def test_disturbed_times_are_shown_but_not_ranked() -> None:
    runs = (_run("fast", 0, 90.0), _run("fast", 1, 90.0), _run("slow", 0, 20.0), _run("slow", 1, 20.0), _run("mid", 0, 50.0))
    runs += (_run("mid", 1, 50.0),)
    comparison = Comparison("s", "?", ("fast", "mid", "slow"), runs, budget="500steps")
    quiet = summarise(comparison)
    assert quiet.disturbances == ()
    assert _best(quiet, "render_fps") == ["fast"]
    disturbed = replace(comparison, runs=(runs[0], replace(runs[1], scores=replace(runs[1].scores, disturbed=TOLD)), *runs[2:]))
    summary = summarise(disturbed)
    assert _best(summary, "render_fps") == ["mid"]
    assert _best(summary, "fit_seconds") == []  # equal ones lead nobody
    assert _best(summary, "psnr") == ["fast"]  # what is no time is ranked as before
    assert _best(summary, "model_bytes") == ["slow"]
    assert summary.disturbances == (f"The times of fast are not ranked: seed 1 {TOLD}.",)
    assert any("mid renders fastest" in sentence for sentence in verdict(disturbed, summary))
    assert summary.cell(summary.rows[0], "render_fps").text == "90.0"


def test_times_of_a_slower_or_faster_processor_are_not_ranked() -> None:
    """A fit's core may do less in a second beside a neighbour, with all of its time to itself."""
    runs = (_run("fast", 0, 90.0, speed=700.0), _run("fast", 1, 90.0, speed=1000.0), _run("slow", 0, 20.0, speed=1020.0))
    runs += (_run("slow", 1, 20.0, speed=1180.0), _run("mid", 0, 50.0, speed=1000.0), _run("mid", 1, 50.0, speed=880.0))
    comparison = Comparison("s", "?", ("fast", "mid", "slow"), runs, budget="60s")
    summary = summarise(comparison)
    assert summary.disturbances == (
        "The times of fast are not ranked: seed 0 had a processor that a probe found 30 % slower than beside the median fit.",
        "The times of slow are not ranked: seed 1 had a processor that a probe found 18 % faster than beside the median fit.",
    )
    assert _best(summary, "render_fps") == []
    assert dict(shared_facts(comparison))["processor speed during the fits"] == "0.70 to 1.18 of the median"
    busy = replace(runs[0], scores=replace(runs[0].scores, disturbed=TOLD))
    both = summarise(replace(comparison, runs=(busy, *runs[1:]))).disturbances[0]
    assert both.startswith(f"The times of fast are not ranked: seed 0 {TOLD}, and had a processor that a probe found 30 %")


def test_quality_in_equal_seconds_is_not_ranked_either_where_a_fit_had_less_of_them() -> None:
    """One fit had half of its core. On a machine that is busy throughout all have less, and may be compared."""
    runs = [_run(method, seed, fps) for method, fps in (("fast", 90.0), ("mid", 50.0), ("slow", 20.0)) for seed in (0, 1)]

    def with_share(run: Run, share: float) -> Run:
        cost, told = run.scores.cost | {"fit_processor_share": share}, TOLD if share < 0.85 else ""
        scores = replace(run.scores, cost=cost, disturbed=told)
        return replace(run, scores=scores, provenance=replace(run.provenance, budget="60s"))

    def with_shares(*shares: float) -> Comparison:
        timed = map(with_share, runs, shares)
        return Comparison("s", "?", ("fast", "mid", "slow"), tuple(timed), budget="60s")

    one = with_shares(0.5, 1.0, 1.0, 1.0, 0.99, 1.0)
    assert _best(summarise(one), "psnr") == ["mid"]
    assert summarise(one).disturbances[0].startswith("The times and the quality of fast are not ranked: seed 0")
    steps = replace(one, runs=tuple(replace(r, provenance=replace(r.provenance, budget="500steps")) for r in one.runs))
    assert _best(summarise(steps), "psnr") == ["fast"]
    busy = summarise(with_shares(0.5, 0.52, 0.5, 0.51, 0.5, 0.55))
    assert _best(busy, "psnr") == ["fast"] and len(busy.disturbances) == 3
    observations = [Observation(run, "s", {METHOD: run.method}) for run in one.runs]
    (effect,) = effects_of([Contrast(METHOD, "mid", "fast")], summarise(one).columns[0], observations)
    assert effect.disturbed == 1 and effect.estimate.seeds == (1, 2)
    assert "Left out is 1 fit with less processor time than others in equal seconds." in effect_sentence(effect)


def test_two_fits_and_unmeasured_ones_have_no_usual_speed() -> None:
    runs = (_run("a", 0, 90.0, speed=700.0), _run("b", 0, 90.0, speed=1000.0), _run("c", 0, 90.0))
    comparison = Comparison("s", "?", ("a", "b", "c"), runs, budget="60s")
    assert summarise(comparison).disturbances == ()
    assert "processor speed during the fits" not in dict(shared_facts(comparison))


@pytest.mark.parametrize("quiet", [0, 1, 2])
def test_disturbed_times_make_no_pareto_front(tmp_path: Path, quiet: int) -> None:
    """Two methods whose clocks can be compared are the fewest that make one; sizes are compared whatever the clocks."""
    runs = [_run(method, seed, fps) for method, fps in (("a", 90.0), ("b", 50.0), ("c", 20.0)) for seed in (0, 1)]
    runs = [
        one if "abc".index(one.method) < quiet else replace(one, scores=replace(one.scores, disturbed=TOLD)) for one in runs
    ]
    comparison = Comparison("s", "?", ("a", "b", "c"), tuple(runs), budget="500steps")
    drawn = {figure.path.stem: figure for figure in draw_tradeoffs(summarise(comparison), tmp_path)}
    size = drawn["psnr-against-model-bytes"]
    assert "On the Pareto front: c, b and a" in size.alt and "Dashed: Pareto front" in size.path.read_text()
    for name in ("psnr-against-render-fps", "psnr-against-fit-seconds"):
        alt, picture = drawn[name].alt, drawn[name].path.read_text()
        assert (
            ("On the Pareto front: a" in alt)
            == ("Pareto front" in picture)
            == ("stroke-dasharray: 4.4" in picture)
            == (quiet == 2)
        )
        assert ("not ranked" in alt) == (quiet < 2)


def _best(summary, key: str) -> list[str]:
    return [row.label for row in summary.rows if summary.cell(row, key).best]


@pytest.mark.usefixtures("unpainted")
def test_a_page_says_it_in_red(tmp_path: Path) -> None:
    root = write_comparison(tmp_path)
    scores = sorted(root.glob("runs/*/*/scores.json"))[0]
    scores.write_text(json.dumps(json.loads(scores.read_text()) | {"disturbed": TOLD}))
    page = build_report(root)
    assert '<p class="disturbed" role="note">The times of ' in page.read_text()
    assert "are not ranked: seed 0 had 50 % of the processor time" in (root / "index.md").read_text()


@pytest.mark.parametrize("speeds", [False, True])
def test_disturbed_times_are_in_no_comparison(speeds: bool, tmp_path: Path) -> None:
    """Two of a's five fits had half of the processor: the table of effects is of the other three, and says so."""
    told = {"speed": 1000.0} if speeds else {}
    ill = {"speed": 500.0} if speeds else {"disturbed": TOLD}
    runs = [_run("a", seed, 40.0 if seed < 2 else 20.0, **(ill if seed < 2 else told)) for seed in range(5)]
    runs += [_run("b", seed, 20.0, **told) for seed in range(5)]
    observations = [Observation(run, "s", {METHOD: run.method}) for run in runs]
    fps, size = (next(cost for cost in COSTS if cost.key == key) for key in ("render_fps", "model_bytes"))
    (effect,) = effects_of([Contrast(METHOD, "b", "a")], fps, observations)
    assert abs(effect.estimate.mean) < 0.1 and effect.estimate.seeds == (3, 5)
    assert effect.disturbed == 2
    assert "Times of 2 fits are left out: their clocks were disturbed." in effect_sentence(effect)
    assert "3 to 5 seeds, 2 left out: clock" in markdown_effects([effect])
    (other,) = effects_of([Contrast(METHOD, "b", "a")], size, observations)
    assert (other.disturbed, other.estimate.seeds) == (0, (5, 5))  # what is no time stays
    all_of_a = [replace(run, scores=replace(run.scores, disturbed=TOLD)) for run in runs[:5]]
    gone = [Observation(run, "s", {METHOD: run.method}) for run in (*all_of_a, *runs[5:])]
    assert effects_of([Contrast(METHOD, "b", "a")], fps, gone) == []
    contrasts = draw_contrasts([fps], [Contrast(METHOD, "b", "a")], (gone, []), Folder(tmp_path))
    assert contrasts.tables == () and contrasts.disturbed == "Times of 5 fits are left out: their clocks were disturbed."
