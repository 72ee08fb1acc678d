"""Fits whose cores others had: their times are shown in red, and never ranked."""

import json
from dataclasses import replace
from pathlib import Path

from made_up_runs import made_up_run
from report_folders import write_comparison

from invgraphics.report.build import build_report
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.statistics.summary import summarise
from invgraphics.report.statistics.verdict import verdict
from invgraphics.runs.run import Run
from invgraphics.runs.scores import Score

TOLD = "had 50 % of the processor time that it was ready to use; other programs had the rest"


def _run(method: str, seed: int, fps: float, disturbed: str = "") -> Run:
    quality = {"psnr": Score(mean=30.0 + fps / 100 + 1e-3 * seed, unit="dB", higher_is_better=True)}
    cost = {"fit_seconds": 60.0, "fit_cpu_seconds": 100.0, "render_fps": fps + 0.02 * seed, "model_bytes": 1e6 * fps}
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


def _best(summary, key: str) -> list[str]:
    return [row.label for row in summary.rows if summary.cell(row, key).best]


def test_a_page_says_it_in_red(tmp_path: Path) -> None:
    root = write_comparison(tmp_path)
    scores = sorted(root.glob("runs/*/*/scores.json"))[0]
    scores.write_text(json.dumps(json.loads(scores.read_text()) | {"disturbed": TOLD}))
    page = build_report(root)
    assert '<p class="disturbed" role="note">The times of ' in page.read_text()
    assert "are not ranked: seed 0 had 50 % of the processor time" in (root / "index.md").read_text()
