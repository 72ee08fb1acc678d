"""Verdicts: every rule is seen to go red, to hold, and not to apply; the page shows each of them."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from judged_folders import SECONDS, entry, rising, write_judged

from invgraphics.cli import main
from invgraphics.report.data.studies import read_study
from invgraphics.report.statistics import rules
from invgraphics.report.statistics.rules import RULES, JudgedCell, judge, unused
from invgraphics.report.study import build_study_report
from invgraphics.studies.study import KnownDeviation

pytestmark = pytest.mark.usefixtures("unpainted")

SPLATS, HASH = "splatting/gaussians", "volumetric/hash"


def judged(root: Path, *cells: dict[str, Any], known: tuple[dict[str, Any], ...] = ()) -> list[JudgedCell]:
    study = read_study(write_judged(root / "study", cells, known))
    return list(judge(study.cells, study.known))


def outcome(one: JudgedCell, rule: str) -> str:
    return next(verdict.outcome for verdict in one.verdicts if verdict.rule == rule)


def sentence(one: JudgedCell, rule: str) -> str:
    return next(verdict.sentence for verdict in one.verdicts if verdict.rule == rule)


def falling(fall: float, back: float = 0.0) -> list[dict[str, Any]]:
    """A curve that falls after its best at 20 dB, and comes back by some of it."""
    psnrs = [10.0, 18.0, 20.0, 20.0 - fall, 20.0 - fall + back]
    return [{"step": i, "seconds": i + 1.0, "progress": i / 4, "psnr": psnr} for i, psnr in enumerate(psnrs)]


def test_a_cell_without_blame_is_green(tmp_path: Path) -> None:
    (one,) = judged(tmp_path, entry(SPLATS, "fence", 128, "60s"))
    assert one.standing == "green" and [verdict.rule for verdict in one.verdicts] == list(RULES)
    assert {verdict.rule: verdict.outcome for verdict in one.verdicts} == dict.fromkeys(RULES, "ok") | {"budget": "none"}


@pytest.mark.parametrize(("longer", "expected"), [(24.0, "ok"), (23.81, "ok"), (23.79, "red")])
def test_a_longer_budget_may_not_score_lower(tmp_path: Path, longer: float, expected: str) -> None:
    """The best shorter budget counts: 20 minutes may not lie below 60 s, even if it is above 5 minutes."""
    scores = {"60s": 24.0, "5min": 22.0, "20min": longer}
    cells = [entry(HASH, "fence", 128, budget, psnr=[value]) for budget, value in scores.items()]
    short, middle, long = judged(tmp_path, *cells)
    assert [outcome(one, "budget") for one in (short, middle, long)] == ["none", "red", expected]
    assert "2.00 dB below the 24.00 dB of 60 s" in sentence(middle, "budget")


@pytest.mark.parametrize("other", [("bricks", 128, HASH), ("fence", 400, HASH), ("fence", 128, SPLATS)])
def test_only_fits_that_differ_in_nothing_else_are_compared(tmp_path: Path, other: tuple[str, int, str]) -> None:
    scene, size, method = other
    cells = entry(method, scene, size, "60s", psnr=[30.0]), entry(HASH, "fence", 128, "5min", psnr=[20.0])
    assert outcome(judged(tmp_path, *cells)[1], "budget") == "none"


@pytest.mark.parametrize(
    ("history", "expected"), [(falling(0.49), "ok"), (falling(0.51), "red"), (falling(0.6, back=1.0), "red"), ([], "none")]
)
def test_the_monitor_may_not_fall_below_its_best(tmp_path: Path, history: list, expected: str) -> None:
    """Neither at the end nor on the way, although it came back."""
    (one,) = judged(tmp_path, entry(HASH, "fence", 128, "60s", history=history))
    assert outcome(one, "monitor") == expected
    if expected == "red":
        assert "below the best so far at 75% of the budget" in sentence(one, "monitor")


@pytest.mark.parametrize(("worst", "expected"), [(17.1, "ok"), (16.9, "red")])
def test_no_view_may_be_far_below_the_median(tmp_path: Path, worst: float, expected: str) -> None:
    """The median of the views with the worst among them is 25 dB."""
    (one,) = judged(tmp_path, entry(HASH, "fence", 128, "60s", psnr=[25.0, worst, 24.0, 26.0, 27.0]))
    assert outcome(one, "views") == expected and "view, 0001," in sentence(one, "views")


@pytest.mark.parametrize(("share", "expected"), [(0.0099, "ok"), (0.01, "red"), (None, "none")])
def test_dead_primitives_stay_below_a_percent(tmp_path: Path, share: float | None, expected: str) -> None:
    cost = {"primitives": 40000, "fit_seconds": 60.0} | ({} if share is None else {"dead": share})
    (one,) = judged(tmp_path, entry(SPLATS, "fence", 128, "60s", scores={"cost": cost}))
    assert outcome(one, "dead") == expected


def test_dead_primitives_are_read_from_the_history_too(tmp_path: Path) -> None:
    lines = rising(25.0, 60.0)
    lines[-1]["dead"] = 0.3
    cost = {"primitives": 40000, "fit_seconds": 60.0}
    (one,) = judged(tmp_path, entry(SPLATS, "fence", 128, "60s", history=lines, scores={"cost": cost}))
    assert sentence(one, "dead") == "30% of 40,000 primitives are dead."


@pytest.mark.parametrize(("forecast", "expected"), [(3.1e8, "ok"), (2.9e8, "red"), (None, "none")])
def test_memory_stays_within_its_forecast(tmp_path: Path, forecast: float | None, expected: str) -> None:
    (one,) = judged(tmp_path, entry(HASH, "fence", 128, "60s", provenance={"memory_forecast_bytes": forecast}))
    assert outcome(one, "memory") == expected


def test_numbers_are_finite(tmp_path: Path) -> None:
    """In a curve, in a view, in a metric that was left out for it; a fit that failed has none at all."""
    lines = rising(25.0, 60.0)
    lines[3]["loss"] = math.inf
    failed = entry(HASH, "cloud", 128, "60s", status="failed", error="Step 3: the loss is not finite.")
    cells = [
        entry(HASH, "fence", 128, "60s", history=lines),
        entry(HASH, "room", 128, "60s", psnr=[20.0, math.nan]),
        entry(HASH, "bricks", 128, "60s", scores={"skipped": {"ssim": "view 0001: the value is not finite (nan)"}}),
        failed,
    ]
    found = judged(tmp_path, *cells)
    assert [outcome(one, "finite") for one in found] == ["red"] * 4
    words = ["loss at step 30", "psnr", "ssim", "Step 3: the loss is not finite."]
    assert all(word in sentence(one, "finite") for one, word in zip(found, words, strict=True))
    assert found[3].standing == "red" and outcome(found[3], "monitor") == "none"


def test_time_to_judge_grows_with_the_cells_and_not_with_their_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What cells have in common is looked at once for each, and not once for each pair."""
    seen, plain = [], rules._without_budget
    monkeypatch.setattr(rules, "_without_budget", lambda cell: (seen.append(cell), plain(cell))[1])
    cells = [entry(HASH, "fence", size, budget, psnr=[30.0]) for size in range(100, 110) for budget in SECONDS]
    found = judged(tmp_path, *cells)
    assert len(seen) <= 2 * len(cells)
    assert [outcome(one, "budget") for one in found] == ["none", "ok", "ok"] * 10


def test_a_perfect_view_breaks_no_rule(tmp_path: Path) -> None:
    """Nor do perfect ones beside a bad one: a PSNR of equal pictures counts as 100 dB everywhere."""
    cells = [
        entry(HASH, "fence", 128, "60s", psnr=[30.0, math.inf, 31.0], history=rising(40.0, 60.0)),
        entry(HASH, "fence", 128, "5min", psnr=[math.inf, math.inf, 93.0], history=rising(40.0, 300.0)),
    ]
    first, second = judged(tmp_path, *cells)
    assert [outcome(one, rule) for one in (first, second) for rule in ("finite", "views")] == ["ok"] * 4
    assert sentence(second, "views") == "The worst view, 0002, scores 93.00 dB, 7.00 dB below the median."
    assert sentence(second, "budget") == "97.67 dB after 300 s, 44.00 dB above the 53.67 dB of 60 s."


@pytest.mark.parametrize(("seconds", "expected"), [(3600 + 71.0, "red"), (3600 + 69.0, "ok"), (None, "none")])
def test_no_cell_is_an_hour_late(tmp_path: Path, seconds: float | None, expected: str) -> None:
    (one,) = judged(tmp_path, entry(HASH, "fence", 128, "60s", seconds=seconds))
    assert outcome(one, "late") == expected


def test_a_known_cause_changes_the_colour_and_hides_nothing(tmp_path: Path) -> None:
    cell = entry(SPLATS, "fence", 128, "60s", history=falling(2.0))
    cause = {"cells": "splatting/* fence@* *", "rule": "monitor", "cause": "Resets of opacity.", "issue": 21}
    study = read_study(write_judged(tmp_path / "a", [cell], [cause, cause | {"rule": "dead"}, cause | {"cells": "* room@*"}]))
    (one,) = judge(study.cells, study.known)
    (verdict,) = one.red
    assert one.standing == "known" and (verdict.cause, verdict.issue) == ("Resets of opacity.", "21")
    assert "Fell 2.00 dB" in verdict.sentence
    assert [entry.rule for entry in unused([one], study.known)] == ["dead", "monitor"]
    other = [cause | {"rule": "views"}]
    assert judged(tmp_path / "b", cell, known=tuple(other))[0].standing == "red"


def test_the_rules_that_a_study_may_excuse_are_the_rules() -> None:
    assert get_args(get_type_hints(KnownDeviation)["rule"]) == tuple(RULES)


@pytest.fixture
def gauntlet(tmp_path: Path) -> Path:
    """One cell of every standing."""
    fox = "$INVGRAPHICS_DATA/fox"
    cells = [
        entry(SPLATS, "fence", 128, "60s"),
        entry(SPLATS, "fence", 128, "5min", psnr=[20.0, 21.0]),
        entry(HASH, "fence", 128, "60s", history=falling(2.0)),
        entry(HASH, fox, 400, "20min", status="skipped", error="INVGRAPHICS_DATA is not set", seconds=None),
        entry(HASH, "room", 800, "20min", status="missing", seconds=None),
        entry(SPLATS, "room", 128, "60s", status="failed", error="Out of <memory>."),
    ]
    known = {"cells": f"{HASH} fence@128 *", "rule": "monitor", "cause": "A cold grid.", "issue": 7}
    return write_judged(tmp_path / "gauntlet", cells, [known])


def test_the_page_shows_every_standing(gauntlet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = build_study_report(gauntlet).read_text()
    first = "1 of 6 cells are green; 1 red with a known cause, 2 red, 1 skipped, 1 not run yet."
    told = ("Skipped: INVGRAPHICS_DATA is not set.", ">fox<small>400 px", "A cold grid. Issue 7.", "Out of &lt;memory&gt;.")
    assert all(words in page for words in (first, *told))
    for standing in ("green", "known", "red", "skipped", "missing"):
        assert f'<td class="{standing}"' in page
    markdown = (gauntlet / "index.md").read_text()
    assert first in markdown and "Known cause: A cold grid. (issue 7)" in markdown
    with (gauntlet / "verdicts.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * len(RULES)
    assert [(row["cell"], row["rule"]) for row in rows if row["outcome"] == "known"] == [
        (f"{HASH} fence@128 60s seed=0", "monitor")
    ]
    assert len(list((gauntlet / "figures").glob("curves-*.svg"))) == 1
    assert main.run(["report", str(gauntlet)]) == main.DONE
    assert first in capsys.readouterr().out


def test_the_page_names_fits_that_had_less_than_their_cores(tmp_path: Path) -> None:
    told = {"disturbed": "had 84 % of the processor time that it was ready to use"}
    cells = [entry(HASH, "fence", 128, "60s", scores=told), entry(SPLATS, "fence", 128, "60s")]
    page = build_study_report(write_judged(tmp_path / "gauntlet", cells)).read_text()
    sentence = f"{HASH} fence@128 60s seed=0: {told['disturbed']}."
    assert page.count("84 % of the processor") == 1 and f'<p class="disturbed" role="note">{sentence}</p>' in page
    assert f"- {sentence}" in (tmp_path / "gauntlet" / "index.md").read_text()


def test_a_public_page_holds_what_a_study_goes_on_from(gauntlet: Path, tmp_path: Path) -> None:
    """The same records in the same places, and the same page again from them alone."""
    out = tmp_path / "public"
    build_study_report(gauntlet, out, public=True)
    for cell in json.loads((out / "study.json").read_text())["cells"]:
        if cell["status"] == "done":
            names = {path.name for path in (out / cell["run"]).iterdir()}
            assert names == {"scores.json", "history.jsonl", "provenance.json", "environment.json", "recipe.toml"}
    page = (out / "index.html").read_text()
    assert build_study_report(out).read_text() == page
    assert str(tmp_path) not in page + (out / "study.json").read_text()
