"""Reconstruction by one strategy after another until one is sound; the best is kept, and each gets a row in the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from invgraphics.scenes.photos.consistency import check_consistency
from invgraphics.scenes.photos.job import DATABASE
from invgraphics.scenes.photos.mapping import Matched, reconstruct
from invgraphics.scenes.photos.outlier_cameras import (
    remove_outlier_cameras,
    remove_uncorrectable_cameras,
    uncorrectable_cameras,
)
from invgraphics.scenes.photos.pairs import read_verified_matches
from invgraphics.scenes.photos.quality import FEW_FEATURES, is_usable, placeable, registration_obstacle
from invgraphics.scenes.photos.sfm import Verification, match, may_match_all, pairs
from invgraphics.scenes.photos.strategies import Strategy, strategies
from invgraphics.scenes.process import Progress

NEARLY_ALL = 0.9
"""Share of the photographs that can be placed with which a strategy is the last that is tried."""

Reconstruct = Callable[[Strategy, Matched, Progress], list[Any]]


@dataclass(frozen=True, eq=False)
class Attempt:
    """Result of one strategy.

    Attributes:
        strategy: that was followed.
        pieces: ``pycolmap.Reconstruction`` objects, the largest first, without its outlier cameras.
        outliers: photograph -> why its camera was removed from the largest piece.
        consistency: see `invgraphics.scenes.photos.consistency.check_consistency`; ``None`` where nothing was placed.
        seconds: that it took.
        straight: whether the distortion of all lenses of the largest piece can be corrected.
    """

    strategy: Strategy
    pieces: list[Any]
    outliers: dict[str, str]
    consistency: dict[str, Any] | None
    seconds: float
    straight: bool = True

    @property
    def registered(self) -> int:
        """Photographs in the largest piece."""
        return self.pieces[0].num_reg_images() if self.pieces else 0

    def is_sound(self, count: int) -> bool:
        """Whether enough of ``count`` photographs are placed, all distortion can be corrected, and nothing is suspicious."""
        trusted = self.consistency is not None and not self.consistency["suspicious"]
        return trusted and self.straight and is_usable(self.registered, count)

    def rank(self, count: int) -> tuple[bool, bool, int, float]:
        """Sorting key, best last: whether it is sound, whether all distortion can be corrected, then how many photographs are
        placed and the share of all verified matches that the poses explain; of unsound ones that share alone."""
        if self.consistency is None:
            return False, False, 0, -1.0
        sound = self.is_sound(count)
        return sound, self.straight, self.registered if sound else 0, self.consistency["support"]

    def straightened(self, matched: Matched) -> Attempt:
        """The attempt without the photographs whose distortion cannot be corrected; of less than a pair nothing is left."""
        if self.straight:
            return self
        removed = remove_uncorrectable_cameras(self.pieces[0], matched.photos)
        outliers = self.outliers | removed
        if self.registered < 2:
            return replace(self, pieces=[], outliers=outliers, consistency=None, straight=True)
        consistency = check_consistency(self.pieces[0], matched.photos, matched.evidence)
        return replace(self, outliers=outliers, consistency=consistency, straight=True)

    def row(self, kept: bool) -> dict[str, Any]:
        """Its figures for the report."""
        figures: dict[str, Any] = {"outcome": "nothing placed"}
        if self.consistency is not None:
            model = self.pieces[0]
            points, explained = model.num_points3D(), 100 * self.consistency["support"]
            verdict = "suspicious" if self.consistency["suspicious"] else "not suspicious"
            figures = {
                "outcome": f"{self.registered} placed, {points} points, {explained:.0f} % of the matches explained, {verdict}",
                "points": points,
                "track_length": float(model.compute_mean_track_length()),
                "reprojection_error_px": float(model.compute_mean_reprojection_error()),
                **{key: value for key, value in self.consistency.items() if key not in ("worst", "sentence")},
            }
        return {
            "strategy": self.strategy.name,
            "registered": self.registered,
            "outlier_cameras": len(self.outliers),
            **figures,
            "seconds": round(self.seconds, 2),
            "kept": kept,
        }


def try_strategies(
    matched: Matched, progress: Progress, place: Reconstruct = reconstruct
) -> tuple[Attempt, list[dict[str, Any]]]:
    """Reconstruct by one strategy after another until one is sound and places nearly all photographs that can be placed.

    Args:
        matched: features and matches.
        progress: called with (done, in all, what is being done).
        place: makes a strategy's reconstruction.

    Returns:
        The best attempt, and the report's rows of all of them in their order.
    """
    count, enough = len(matched.photos), NEARLY_ALL * placeable(matched.evidence)
    attempts: list[Attempt] = []
    for strategy in strategies(matched.job, matched.photos):
        attempts.append(_attempt(strategy, matched, _attempt_progress(progress, len(attempts)), place))
        done = attempts[-1].is_sound(count) and attempts[-1].registered >= enough
        if done or registration_obstacle(matched.photos, matched.evidence) is not None:
            break
    best = max(attempts, key=lambda attempt: attempt.rank(count))
    kept = best.straightened(matched)
    return kept, [kept.row(True) if attempt is best else attempt.row(False) for attempt in attempts]


def try_all_pairs(
    matched: Matched, best: Attempt, rows: list[dict[str, Any]], progress: Progress, place: Reconstruct = reconstruct
) -> tuple[Matched, Attempt, list[dict[str, Any]]]:
    """Where each photograph was matched with its neighbours only and few could be placed: match all pairs, and try again.

    Photographs of no order share little with those of the next names.

    Args:
        matched: features and matches.
        best: the best attempt so far.
        rows: the report's rows so far.
        progress: as for `try_strategies`, of which it goes on.
        place: likewise.

    Returns:
        The matches, the best attempt and the rows: as they were, where this does not apply or places no more.
    """
    count = len(matched.photos)
    few_features = float(np.median(matched.evidence.features)) < FEW_FEATURES
    if is_usable(best.registered, count) or few_features or not may_match_all(matched.job.matching, count):
        return matched, best, rows
    database = matched.work / DATABASE
    step = _attempt_progress(progress, len(rows))
    match(pairs(count, "exhaustive"), matched.photos, database, step, Verification(matched.job.seed))
    full = replace(matched, evidence=read_verified_matches(database, matched.photos))
    again, more = try_strategies(full, _rest(progress, len(rows) + 1), place)
    better = again.registered > best.registered
    more = [row | {"strategy": f"{row['strategy']}, all pairs matched", "kept": row["kept"] and better} for row in more]
    rows = [row | {"kept": row["kept"] and not better} for row in rows] + more
    return (full, again, rows) if better else (matched, best, rows)


def _attempt(strategy: Strategy, matched: Matched, progress: Progress, place: Reconstruct) -> Attempt:
    since = time.perf_counter()
    pieces = place(strategy, matched, progress)
    progress(1, 1, "checking poses against the matches")
    outliers, consistency, straight = {}, None, True
    if pieces:
        outliers = remove_outlier_cameras(pieces[0], matched.photos)
        consistency = check_consistency(pieces[0], matched.photos, matched.evidence)
        straight = not uncorrectable_cameras(pieces[0])
    return Attempt(strategy, pieces, outliers, consistency, time.perf_counter() - since, straight)


def _attempt_progress(progress: Progress, before: int) -> Progress:
    """Progress of one of an unknown number of attempts: each gets half of what is left, and never falls back."""
    start, furthest = 1 - 0.5**before, 0.0

    def report(done: int, total: int, what: str) -> None:
        nonlocal furthest
        furthest = max(furthest, done / max(total, 1))
        progress(round(1000 * (start + (1 - start) / 2 * furthest)), 1000, what)

    return report


def _rest(progress: Progress, before: int) -> Progress:
    """Progress of all that comes after so many attempts."""
    start = 1 - 0.5**before
    return lambda done, total, what: progress(round(1000 * (start + (1 - start) * done / max(total, 1))), 1000, what)


def choice(rows: Sequence[dict[str, Any]]) -> str:
    """A sentence that names the kept strategy and the outcomes of the others."""
    kept = next(row for row in rows if row["kept"])
    if len(rows) == 1:
        return kept["strategy"]
    left = "; ".join(f"{row['strategy']}: {row['outcome']}" for row in rows if row is not kept)
    return f"{kept['strategy']}: {kept['outcome']} (the best of {len(rows)} tries; {left})"
