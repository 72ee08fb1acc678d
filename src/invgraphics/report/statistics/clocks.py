"""Fits whose clocks are not to be compared: their cores were shared, or faster or slower than those of the other fits."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from invgraphics.report.data.factors import Observation
from invgraphics.report.wording import TIMES, MeasuredQuantity
from invgraphics.runs.run import Run

LEAST_RATIO = 0.85
"""Ratio of a processor's speed to the median below which (or above whose inverse) a fit's times are not to be compared."""

FEWEST = 3
"""Fits of which a median says what is usual."""


@dataclass(frozen=True)
class Speeds:
    """Processor speeds of fits that are compared with each other (`invgraphics.training.clock.SpeedProbe`).

    Attributes:
        median: of those that are known, in 1/s; ``None`` of fewer than `FEWEST`.
        least: the lowest, as a ratio to the median.
        most: the highest, as a ratio to the median.
    """

    median: float | None = None
    least: float = 1.0
    most: float = 1.0

    @staticmethod
    def of(runs: Sequence[Run]) -> Speeds:
        """Speeds of some runs; fits on a GPU, and of code that did not measure it, have none."""
        known = [speed for run in runs if (speed := _speed(run))]
        if len(known) < FEWEST:
            return Speeds()
        median = statistics.median(known)
        return Speeds(median, min(known) / median, max(known) / median)

    def disturbance(self, run: Run) -> str:
        """Why a run's times are not to be compared, the subject left out; empty where they are."""
        speed, found = _speed(run), [run.scores.disturbed] if run.scores.disturbed else []
        ratio = speed / self.median if speed and self.median else 1.0
        if not LEAST_RATIO <= ratio <= 1 / LEAST_RATIO:
            change = f"{100 * abs(ratio - 1):.0f} % {'slower' if ratio < 1 else 'faster'}"
            found.append(f"had a processor that a probe found {change} than beside the median fit")
        return ", and ".join(found)

    @property
    def words(self) -> str:
        """Lowest and highest speed; empty where they are unknown."""
        return "" if self.median is None else f"{self.least:.2f} to {self.most:.2f} of the median"


def cpu_starved_fits(runs: Sequence[Run]) -> list[Run]:
    """Fits of a budget of seconds with much less of their processor time than the fit with most: fewer steps, lower quality."""
    shares = {id(run): share for run in runs if _by_time(run) and (share := run.scores.cost.get("fit_processor_share"))}
    most = max(shares.values(), default=0.0)
    return [run for run in runs if shares.get(id(run), most) < LEAST_RATIO * most]


def disturbed_fits(observations: Sequence[Observation], quantity: MeasuredQuantity) -> list[Observation]:
    """Fits whose value of a quantity is not to be compared with other fits' of their scene.

    Of times these are the fits whose clock was disturbed, of qualities those that are `cpu_starved_fits`.
    """
    if quantity.key not in TIMES and quantity.group == "cost":
        return []
    left_out: set[int] = set()
    for scene in {one.scene for one in observations}:
        runs = [one.run for one in observations if one.scene == scene]
        speeds = Speeds.of(runs)
        found = [run for run in runs if speeds.disturbance(run)] if quantity.key in TIMES else cpu_starved_fits(runs)
        left_out |= set(map(id, found))
    return [one for one in observations if id(one.run) in left_out]


def _by_time(run: Run) -> bool:
    """Whether a fit's budget was in seconds."""
    return bool(run.provenance.budget) and "step" not in run.provenance.budget


def _speed(run: Run) -> float | None:
    return run.scores.cost.get("fit_processor_speed")
