"""Fit x render on the page: the numbers are those of the files, and a report without renderings shows nothing of it."""

import json
import math
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from made_up_runs import made_up_run
from report_folders import METHODS, SEEDS, VIEWS, truth_frame, write_run

from invgraphics.errors import InputError
from invgraphics.report.build import build_report
from invgraphics.report.data.assets import Folder
from invgraphics.report.data.comparison import Comparison, read_comparison
from invgraphics.report.statistics import cross_render
from invgraphics.report.statistics.cross_render import CrossRendered, cross_table
from invgraphics.report.study import build_study_report
from invgraphics.runs.run import Run
from invgraphics.runs.scores import Score
from invgraphics.runs.study import Approximation

OWN, OTHER = METHODS[2], "gaussian-volume/exact:opacity=physical"
PAIR = Approximation("all that is approximate", OTHER, OWN)


def add_renderings(run: Path, method: str, rmse: float) -> None:
    """A second rendering of a run, made of the same degraded truth."""
    digest = json.loads((run / "provenance.json").read_text())["truth_sha256"]
    scores = json.loads((run / "scores.json").read_text())
    truth = [truth_frame(view) for view in range(len(scores["views"]))]
    write_run(run / "rendered" / "other", truth, digest, method, scores["seed"], worse=2.0)
    entries = [{"renderer": OWN, "run": "."}, {"renderer": OTHER, "run": "rendered/other"}]
    values = [rmse * (1 + 0.1 * view) for view in range(len(truth))]
    record = {"fitted_by": method, "views": scores["views"], "renderings": entries}
    differences = {"rmse": values, "largest": values, "depth": [2.5 * value for value in values]}
    record |= {"differences": [{"renderers": [OWN, OTHER], **differences}]}
    (run / "renderings.json").write_text(json.dumps(record))


@pytest.fixture
def crossed_folder(comparison_folder: Path) -> Path:
    for seed in SEEDS:
        add_renderings(comparison_folder / "runs" / "splatting-gaussians" / f"seed-{seed}", OWN, 0.01)
    return comparison_folder


def test_scores_and_differences_are_means_over_seeds_and_views(crossed_folder: Path) -> None:
    crossed = cross_table(read_comparison(crossed_folder), [PAIR], Folder(crossed_folder))
    assert crossed is not None
    assert (crossed.renderers, crossed.seeds, [row.method for row in crossed.rows]) == ((OWN, OTHER), 2, [OWN])
    own, other = crossed.rows[0].cells
    assert own is not None and other is not None
    runs = [crossed_folder / "runs" / "splatting-gaussians" / f"seed-{seed}" for seed in SEEDS]
    for cell, place in ((own, "."), (other, "rendered/other")):
        scores = [json.loads((run / place / "scores.json").read_text())["quality"]["psnr"]["mean"] for run in runs]
        assert cell.text == f"{sum(scores) / len(scores):.2f}"
        assert (crossed_folder / cell.picture).is_file()
    square = sum((0.01 * (1 + 0.1 * view)) ** 2 for view in range(VIEWS)) / VIEWS
    decibels = f"{-10 * math.log10(square):.1f}"
    assert (own.own, own.difference, other.own, other.difference) == (True, "", False, decibels)
    assert own.best and not other.best
    comparison = read_comparison(crossed_folder)
    once = replace(comparison, runs=tuple(run for run in comparison.runs if run.seed == 0))
    single = cross_table(once, [PAIR], Folder(crossed_folder))
    assert single is not None and not any(cell and cell.best for cell in single.rows[0].cells)  # one seed leads nothing
    assert [step.differences for step in crossed.steps] == [(decibels,)]
    depth = 2.5 * 0.01 * (1 + 0.1 * (VIEWS - 1) / 2)
    assert [step.depths for step in crossed.steps] == [(f"{depth:.2g}",)] and crossed.shows_depth


@pytest.mark.usefixtures("unpainted")
def test_the_page_shows_it(crossed_folder: Path) -> None:
    page = build_report(crossed_folder).read_text()
    assert '<section id="crossed">' in page and 'href="#crossed"' in page
    assert re.findall(r'data-fitted="([^"]+)"', page) == [OWN]
    assert re.findall(r'data-renderer="([^"]+)"', page) == [OWN, OTHER]
    assert "its own" in page and "differs: 38." in page
    assert f"| fitted by | {OWN} | {OTHER} |" in (crossed_folder / "index.md").read_text()


def test_without_renderings_there_is_no_section(pristine_comparison: Path, built_report: Path) -> None:
    assert cross_table(read_comparison(pristine_comparison), [], Folder(built_report)) is None
    assert 'id="crossed"' not in (built_report / "index.html").read_text()


def test_equal_pictures_are_called_the_same(comparison_folder: Path) -> None:
    add_renderings(comparison_folder / "runs" / "splatting-gaussians" / "seed-0", OWN, 0.0)
    crossed = cross_table(read_comparison(comparison_folder), [PAIR], Folder(comparison_folder))
    assert crossed is not None and crossed.steps[0].differences == ("same",)


def test_a_broken_record_is_explained(crossed_folder: Path) -> None:
    (crossed_folder / "runs" / "splatting-gaussians" / "seed-0" / "renderings.json").write_text('{"renderings": 3}')
    with pytest.raises(InputError, match="'renderings' cannot be 3"):
        cross_table(read_comparison(crossed_folder), [], Folder(crossed_folder))


def test_a_study_shows_approximations_and_analyses(small_study: Path) -> None:
    table = json.loads((small_study / "study.json").read_text())
    table |= {"approximations": [asdict(PAIR)], "analyses": ["one", "not-yet"]}
    (small_study / "study.json").write_text(json.dumps(table))
    add_renderings(small_study / table["cells"][0]["run"], METHODS[1], 0.02)
    curve = {"label": "rendered", "x": [0, 1, 2], "y": [0.1, 0.2, 0.4]}
    analysis = {"title": "A known case", "sentence": "It is twice as <much>.", "x": "angle", "y": "error", "curves": [curve]}
    (small_study / "analyses").mkdir()
    (small_study / "analyses" / "one.json").write_text(json.dumps(analysis | {"logarithmic": True}))
    page = build_study_report(small_study).read_text()
    assert 'data-step="all that is approximate"' in page and "<td>34.0<small>depth" in page
    assert "It is twice as &lt;much&gt;." in page and 'href="#analyses"' in page
    figure = (small_study / "figures" / "analysis-one.svg").read_text()
    assert "rendered" in figure and "error" in figure
    text = (small_study / "index.md").read_text()
    assert "Approximations by themselves" in text and "all that is approximate" in text


@pytest.mark.usefixtures("unpainted")
def test_a_broken_analysis_is_explained(small_study: Path) -> None:
    table = json.loads((small_study / "study.json").read_text()) | {"analyses": ["one"]}
    (small_study / "study.json").write_text(json.dumps(table))
    (small_study / "analyses").mkdir()
    (small_study / "analyses" / "one.json").write_text('{"title": "A"}')
    with pytest.raises(InputError, match="lacks the key 'sentence'"):
        build_study_report(small_study)


def test_the_best_renderers_of_a_page_are_one_family(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four methods and two renderers that are the same, on a page of five such tables: few pages may show a best one."""
    rng = np.random.default_rng(9)
    methods, made = tuple("abcd"), {}

    def shown(method: str, seed: int, psnr: float) -> Run:
        score = Score(mean=psnr, unit="dB", higher_is_better=True)
        return replace(made_up_run({"psnr": score}, method, seed), folder=tmp_path)

    def table(gain: float = 0.0, tables: int = 1) -> list[bool]:
        made.clear()
        for method in methods:
            for seed in range(3):
                own, other = (shown(method, seed, 25 + more + rng.normal(0, 0.1)) for more in (gain, 0.0))
                made[method, seed] = CrossRendered(own, {OWN: own, OTHER: other}, {})
        comparison = Comparison("s", "?", methods, tuple(one.fit for one in made.values()))
        crossed = cross_table(comparison, [], Folder(tmp_path), tables)
        assert crossed is not None
        return [bool(cell and cell.best) for row in crossed.rows for cell in row.cells]

    monkeypatch.setattr(cross_render, "read_renderings", lambda run, clean=str: made[run.method, run.seed])
    alone = [any(table()) for _ in range(100)]
    assert sum(alone) <= 8
    pages = [any(any(table(tables=5)) for _ in range(5)) for _ in range(20)]
    assert sum(pages) <= 3
    assert table(gain=2.0, tables=5) == [True, False] * 4
