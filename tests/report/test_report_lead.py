"""What a page says of the method in front, in its sentence, its table and its first column, does not contradict itself."""

from __future__ import annotations

from dataclasses import replace

from made_up_runs import made_up_run

from invgraphics.report.data.comparison import Comparison
from invgraphics.report.statistics.summary import summarise
from invgraphics.report.statistics.verdict import verdict
from invgraphics.runs.scores import Score

CLOSE = {"A": (30.0, 30.1, 30.05), "B": (29.7, 29.85, 29.76), "C": (29.9, 29.4, 28.6), "D": (28.0, 28.3, 28.1)}


def comparison(values: dict[str, tuple[float, ...]]) -> Comparison:
    runs = [
        made_up_run({"psnr": Score(mean=value, unit="dB", higher_is_better=True)}, method, seed, scene="s")
        for method, seeds in values.items()
        for seed, value in enumerate(seeds)
    ]
    return Comparison("s", "?", tuple(values), tuple(runs), budget="500steps")


def test_a_lead_over_the_second_is_not_one_over_all() -> None:
    """A is ahead of B by more than chance, and of C, which scatters, not: nothing is marked, and the sentence says why."""
    close = comparison(CLOSE)
    summary = summarise(close)
    assert summary.legend == "(none leads all others by more than chance)"
    told = verdict(close, summary)[1]
    assert "(95% interval of this pair alone; that it leads all others is not beyond chance" in told
    clear = comparison(CLOSE | {"C": (29.4, 29.42, 29.38)})
    summary = summarise(clear)
    assert summary.legend == "(* leads all others by more than chance)"
    assert verdict(clear, summary)[1].endswith("dB (95% interval).")


def test_the_first_column_is_the_headline_metric_whichever_run_lacks_it() -> None:
    """Pictures of a first run that are not finite leave it with its surface's score alone."""
    whole = comparison(CLOSE)
    surface = Score(mean=0.03, higher_is_better=False)
    both = [replace(run, scores=replace(run.scores, quality=run.scores.quality | {"chamfer": surface})) for run in whole.runs]
    first = replace(both[0], scores=replace(both[0].scores, quality={"chamfer": surface}))
    summary = summarise(replace(whole, runs=(first, *both[1:])))
    assert [column.key for column in summary.columns if column.group != "cost"] == ["psnr", "chamfer"]
    told = verdict(replace(whole, runs=(first, *both[1:])), summary)
    assert "B reaches the highest PSNR" in told[0]
    assert any("A: a fit without a number for PSNR" in sentence for sentence in told)
