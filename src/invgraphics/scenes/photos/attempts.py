"""Strategies tried in turn until one passes the checks; the best is kept, and each leaves a line in the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from invgraphics.scenes.photos.mapping import Matched, reconstruct
from invgraphics.scenes.photos.quality import enough, hopeless
from invgraphics.scenes.photos.strategies import Strategy, strategies
from invgraphics.scenes.photos.strays import remove_strays
from invgraphics.scenes.photos.suspicion import examine
from invgraphics.scenes.process import Progress

Reconstruct = Callable[[Strategy, Matched, Progress], list[Any]]


@dataclass(frozen=True, eq=False)
class Attempt:
    """What one strategy came to.

    Attributes:
        strategy: that was followed.
        pieces: ``pycolmap.Reconstruction`` objects, the largest first, strays removed from it.
        strays: why each stray photograph was left out of the largest piece, by its own name.
        suspicion: see `invgraphics.scenes.photos.suspicion.examine`; ``None`` where nothing was placed.
        seconds: that it took.
    """

    strategy: Strategy
    pieces: list[Any]
    strays: dict[str, str]
    suspicion: dict[str, Any] | None
    seconds: float

    @property
    def registered(self) -> int:
        """Photographs in the largest piece."""
        return self.pieces[0].num_reg_images() if self.pieces else 0

    def passes(self, count: int) -> bool:
        """Whether enough of ``count`` photographs are placed and nothing is suspicious."""
        return self.suspicion is not None and not self.suspicion["suspicious"] and enough(self.registered, count)

    def rank(self, count: int) -> tuple[bool, float]:
        """Sorting key, best last: whether it passes, then the share of all verified matches that the poses explain."""
        return self.passes(count), self.suspicion["support"] if self.suspicion is not None else -1.0

    def row(self, kept: bool) -> dict[str, Any]:
        """For the report."""
        figures: dict[str, Any] = {"outcome": "nothing placed"}
        if self.suspicion is not None:
            model = self.pieces[0]
            points, explained = model.num_points3D(), 100 * self.suspicion["support"]
            verdict = "suspicious" if self.suspicion["suspicious"] else "not suspicious"
            figures = {
                "outcome": f"{self.registered} placed, {points} points, {explained:.0f} % of the matches explained, {verdict}",
                "points": points,
                "track_length": float(model.compute_mean_track_length()),
                "reprojection_error_px": float(model.compute_mean_reprojection_error()),
                **{key: value for key, value in self.suspicion.items() if key not in ("worst", "sentence")},
            }
        return {
            "strategy": self.strategy.name,
            "registered": self.registered,
            "strays": len(self.strays),
            **figures,
            "seconds": round(self.seconds, 2),
            "kept": kept,
        }


def try_strategies(
    matched: Matched, progress: Progress, place: Reconstruct = reconstruct
) -> tuple[Attempt, list[dict[str, Any]]]:
    """Reconstruct by one strategy after another until the checks pass.

    Args:
        matched: features and matches.
        progress: called with (done, in all, what is being done).
        place: makes a strategy's reconstruction.

    Returns:
        The best attempt, and the report's rows of all of them in their order.
    """
    count = len(matched.photos)
    attempts: list[Attempt] = []
    for strategy in strategies(matched.job, matched.photos):
        attempts.append(_attempt(strategy, matched, _share(progress, len(attempts)), place))
        if attempts[-1].passes(count) or hopeless(matched.photos, matched.evidence) is not None:
            break
    best = max(attempts, key=lambda attempt: attempt.rank(count))
    return best, [attempt.row(attempt is best) for attempt in attempts]


def _attempt(strategy: Strategy, matched: Matched, progress: Progress, place: Reconstruct) -> Attempt:
    since = time.perf_counter()
    pieces = place(strategy, matched, progress)
    progress(1, 1, "checking poses against the matches")
    strays, suspicion = {}, None
    if pieces:
        strays = remove_strays(pieces[0], matched.photos)
        suspicion = examine(pieces[0], matched.photos, matched.evidence)
    return Attempt(strategy, pieces, strays, suspicion, time.perf_counter() - since)


def _share(progress: Progress, before: int) -> Progress:
    """Progress of one of an unknown number of attempts: each gets half of what is left, and never falls back."""
    start, furthest = 1 - 0.5**before, 0.0

    def report(done: int, total: int, what: str) -> None:
        nonlocal furthest
        furthest = max(furthest, done / max(total, 1))
        progress(round(1000 * (start + (1 - start) / 2 * furthest)), 1000, what)

    return report


def choice(rows: Sequence[dict[str, Any]]) -> str:
    """A sentence on what was kept, after what."""
    kept = next(row for row in rows if row["kept"])
    if len(rows) == 1:
        return kept["strategy"]
    left = "; ".join(f"{row['strategy']}: {row['outcome']}" for row in rows if row is not kept)
    return f"{kept['strategy']}: {kept['outcome']} (the best of {len(rows)} tries; {left})"
