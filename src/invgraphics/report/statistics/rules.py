"""Verdicts on the cells of a study: outcome, measured value, limit and sentence for every rule."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from typing import Literal

from invgraphics.report.data.factors import METHOD, StudyCell
from invgraphics.report.statistics.values import clipped, value_of
from invgraphics.report.wording import listing, quality_quantity
from invgraphics.runs.run import Run
from invgraphics.runs.scores import Score
from invgraphics.runs.study import KnownDeviation
from invgraphics.text import duration

RULES = {
    "budget": "A longer budget never scores lower (0.2 dB)",
    "monitor": "No monitor score falls more than 0.5 dB below its best",
    "views": "No view is more than 8 dB below the median view",
    "dead": "Fewer than 1% of the primitives are dead",
    "memory": "Peak memory stays within the forecast",
    "finite": "Every fit ends, and every number is finite",
    "late": "No cell takes an hour longer than forecast",
}
"""Key -> what every cell must hold to."""

BUDGET_DB, MONITOR_DB, VIEW_DB, DEAD_SHARE, LATE_SECONDS = 0.2, 0.5, 8.0, 0.01, 3600.0

Outcome = Literal["ok", "red", "known", "none"]
"""``known`` is red with a cause that the study states; ``none`` says that the rule does not apply."""

Standing = Literal["green", "known", "red", "skipped", "missing"]

STANDINGS: dict[Standing, tuple[str, str]] = {
    "green": ("green", "✓"),
    "known": ("red with a known cause", "△"),
    "red": ("red", "✗"),
    "skipped": ("skipped", "○"),
    "missing": ("not run yet", "–"),
}
"""Standing -> (in words, sign); the sign says it without colour."""


@dataclass(frozen=True)
class Verdict:
    """Outcome of one rule on one cell.

    Attributes:
        rule: key of ``RULES``.
        outcome: whether it holds.
        sentence: the numbers in words, or why the rule does not apply.
        value: what was measured, in the limit's unit; ``None`` where the rule does not apply.
        limit: what it was compared with.
        cause: why it is red, where that is known.
        issue: where that is followed up.
    """

    rule: str
    outcome: Outcome
    sentence: str
    value: float | None = None
    limit: float | None = None
    cause: str = ""
    issue: str = ""


@dataclass(frozen=True)
class JudgedCell:
    """A cell and the verdict of every rule; none for a cell that was skipped or has not run."""

    cell: StudyCell
    verdicts: tuple[Verdict, ...]

    @property
    def red(self) -> tuple[Verdict, ...]:
        """Verdicts of broken rules, with and without a known cause."""
        return tuple(verdict for verdict in self.verdicts if verdict.outcome in ("red", "known"))

    @property
    def standing(self) -> Standing:
        """Worst outcome over all rules; ``skipped`` or ``missing`` for a cell without a run."""
        if self.cell.status == "skipped":
            return "skipped"
        if self.cell.status == "missing":
            return "missing"
        outcomes = {verdict.outcome for verdict in self.red}
        return "red" if "red" in outcomes else "known" if outcomes else "green"


def judge(cells: Sequence[StudyCell], known: Sequence[KnownDeviation] = ()) -> tuple[JudgedCell, ...]:
    """Evaluate every rule on every cell that has run."""
    groups: dict[tuple[object, ...], list[StudyCell]] = {}
    keys = [_without_budget(cell) for cell in cells]
    for key, cell in zip(keys, cells, strict=True):
        groups.setdefault(key, []).append(cell)
    judged = []
    for key, cell in zip(keys, cells, strict=True):
        judged.append(JudgedCell(cell, tuple(_excused(cell, one, known) for one in _verdicts(cell, groups[key]))))
    return tuple(judged)


def unused(judged: Sequence[JudgedCell], known: Sequence[KnownDeviation]) -> tuple[KnownDeviation, ...]:
    """Stale known deviations: all cells that they name have run, and none breaks the rule."""
    left = []
    for entry in known:
        named = [one for one in judged if fnmatchcase(one.cell.label, entry.cells)]
        shown = any(verdict.rule == entry.rule for one in named for verdict in one.red)
        if not shown and not any(one.standing in ("missing", "skipped") for one in named):
            left.append(entry)
    return tuple(left)


def headline(judged: Sequence[JudgedCell]) -> list[str]:
    """Sentences on the numbers of green, red, skipped and missing cells, and the reasons of skipped ones."""
    counts = {key: sum(one.standing == key for one in judged) for key in STANDINGS}
    rest = [f"{counts[key]} {words}" for key, (words, _) in STANDINGS.items() if key != "green" and counts[key]]
    first = f"{counts['green']} of {len(judged)} cells are green" + (f"; {', '.join(rest)}." if rest else ".")
    return [
        first,
        *(f"Skipped: {why}." for why in dict.fromkeys(one.cell.error for one in judged if one.standing == "skipped")),
    ]


def psnr_of(cell: StudyCell) -> float | None:
    """Mean PSNR over the cell's test views, dB, that of equal pictures at a finite value; ``None`` without a run."""
    score = None if cell.run is None else cell.run.scores.quality.get("psnr")
    return None if cell.run is None or score is None else value_of(cell.run, quality_quantity("psnr", score))


def worst_view(run: Run) -> tuple[str, float, float] | None:
    """(name, PSNR, PSNR below the median) of the worst view, dB; ``None`` where single views have no scores."""
    score = run.scores.quality.get("psnr")
    if score is None:
        return None
    clip = partial(clipped, column=quality_quantity("psnr", score))
    values = [(clip(value), view) for value, view in zip(score.per_view, run.scores.views, strict=False) if value is not None]
    if not values:
        return None
    worst, view = min(values)
    return view, worst, statistics.median(value for value, _ in values) - worst


def dead_share(run: Run) -> float | None:
    """Fraction of primitives that no gradient can change at the end of the fit; ``None`` where they were not counted."""
    if (share := run.scores.cost.get("dead")) is not None:
        return share
    return next((entry.dead for entry in reversed(run.history) if entry.dead is not None), None)


def _verdicts(cell: StudyCell, alike: Sequence[StudyCell]) -> list[Verdict]:
    """Outcome of every rule on a cell; ``alike`` are those that differ from it in nothing but the budget."""
    if cell.status == "failed":
        rest = [Verdict(rule, "none", "The fit failed.") for rule in RULES if rule not in ("finite", "late")]
        return [*rest, Verdict("finite", "red", f"The fit failed: {cell.error}"), _late(cell)]
    if cell.run is None:
        return []
    of_run: tuple[Callable[[Run], Verdict], ...] = (_monitor, _views, _dead, _memory, _finite)
    return [_budget(cell, alike), *(rule(cell.run) for rule in of_run), _late(cell)]


def _excused(cell: StudyCell, verdict: Verdict, known: Sequence[KnownDeviation]) -> Verdict:
    if verdict.outcome != "red":
        return verdict
    for entry in known:
        if entry.rule == verdict.rule and fnmatchcase(cell.label, entry.cells):
            return replace(verdict, outcome="known", cause=entry.cause, issue=str(entry.issue or ""))
    return verdict


def _verdict(rule: str, broken: bool, sentence: str, value: float, limit: float) -> Verdict:
    return Verdict(rule, "red" if broken else "ok", sentence, value, limit)


def _budget(cell: StudyCell, alike: Sequence[StudyCell]) -> Verdict:
    """PSNR against the best of all shorter budgets, so that a fall and a later recovery are distinguished."""
    own = psnr_of(cell)
    shorter = [
        (value, other)
        for other in alike
        if cell.amount and other.amount and other.amount[0] == cell.amount[0] and other.amount[1] < cell.amount[1]
        if (value := psnr_of(other)) is not None
    ]
    if own is None or not shorter:
        return Verdict("budget", "none", "No shorter budget of the same fit is done.")
    best, other = max(shorter, key=lambda pair: pair[0])
    sentence = f"{own:.2f} dB after {cell.budget}, {abs(own - best):.2f} dB {'above' if own >= best else 'below'} the "
    return _verdict("budget", best - own > BUDGET_DB, f"{sentence}{best:.2f} dB of {other.budget}.", own - best, -BUDGET_DB)


def _without_budget(cell: StudyCell) -> tuple[object, ...]:
    levels = {path: level for path, level in cell.levels.items() if path.rpartition(":")[2] != "budget" and path != METHOD}
    return cell.scene, cell.method, cell.seed, cell.size, tuple(sorted(levels.items()))


def _monitor(run: Run) -> Verdict:
    """Largest drop of the monitored PSNR below its running maximum, and its drop at the end."""
    curve = [(entry, entry.psnr) for entry in run.history if entry.psnr is not None]
    if len(curve) < 2:
        return Verdict("monitor", "none", "The monitor has looked less than twice.")
    best, fall, place = -math.inf, 0.0, ""
    for entry, psnr in curve:
        best = max(best, psnr)
        if best - psnr > fall:
            fall, place = (
                best - psnr,
                f"at {entry.progress:.0%} of the budget" if entry.progress is not None else f"at step {entry.step}",
            )
    ended = best - curve[-1][1]
    end = f"ended {ended:.2f} dB below its best of {best:.2f} dB" if ended >= 0.005 else f"ended at its best, {best:.2f} dB"
    sentence = f"Fell {fall:.2f} dB below the best so far {place} and {end}." if fall > 0 else f"Never fell, and {end}."
    return _verdict("monitor", fall > MONITOR_DB, sentence, fall, MONITOR_DB)


def _views(run: Run) -> Verdict:
    found = worst_view(run)
    if found is None:
        return Verdict("views", "none", "Single views have no scores.")
    view, worst, below = found
    sentence = f"The worst view, {view}, scores {worst:.2f} dB, {below:.2f} dB below the median."
    return _verdict("views", below > VIEW_DB, sentence, below, VIEW_DB)


def _dead(run: Run) -> Verdict:
    share, count = dead_share(run), run.scores.cost.get("primitives")
    if share is None:
        return Verdict("dead", "none", "The field has no primitives." if not count else "Dead primitives were not counted.")
    total = f" of {count:,.0f}" if count else ""
    return _verdict("dead", share >= DEAD_SHARE, f"{100 * share:.2g}%{total} primitives are dead.", share, DEAD_SHARE)


def _memory(run: Run) -> Verdict:
    peak, forecast = run.scores.cost.get("peak_memory_bytes"), run.provenance.memory_forecast_bytes
    if peak is None or forecast is None:
        return Verdict("memory", "none", "The run holds no forecast of its memory.")
    sentence = f"Peak of {peak / 1e6:,.0f} MB, forecast {forecast / 1e6:,.0f} MB."
    return _verdict("memory", peak > forecast, sentence, peak, float(forecast))


def _finite(run: Run) -> Verdict:
    """Check scores, costs and history for non-finite values, metrics skipped for that reason included; perfect PSNR is fine."""
    found = [name for name, score in run.scores.quality.items() if not _all_finite(name, score)]
    found += [name for name, why in run.scores.skipped.items() if "finite" in why]
    found += [name for name, value in run.scores.cost.items() if value is not None and not math.isfinite(value)]
    found += [f"{name} at step {entry.step}" for entry in run.history for name in entry.not_finite]
    if found:
        return Verdict(
            "finite", "red", f"Not finite: {listing(found[:5])}{' and more' if len(found) > 5 else ''}.", len(found), 0.0
        )
    return Verdict("finite", "ok", "All metrics, costs and curves are finite.", 0.0, 0.0)


def _all_finite(name: str, score: Score) -> bool:
    column = quality_quantity(name, score)
    return all(math.isfinite(clipped(value, column)) for value in (score.mean, *score.per_view))


def _late(cell: StudyCell) -> Verdict:
    if cell.seconds is None or cell.forecast is None:
        return Verdict("late", "none", "The time or its forecast is not known.")
    sentence = f"Took {duration(cell.seconds)}, forecast {duration(cell.forecast)}."
    return _verdict("late", cell.seconds - cell.forecast > LATE_SECONDS, sentence, cell.seconds, cell.forecast + LATE_SECONDS)
