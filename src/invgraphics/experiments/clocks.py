"""Time costs of a fit, and detection of timings disturbed by other processes or by a standstill."""

from __future__ import annotations

import os
from collections.abc import Mapping

from invgraphics.runs.fit import FitRecord
from invgraphics.text import duration

LEAST_SHARE = 0.85
"""A fit that ran for less of the time in which it was ready to run was disturbed: its times are not ranked."""


def load_average() -> float | None:
    """System load: mean number of running or runnable processes over the last minute; ``None`` where unavailable."""
    try:
        return round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        return None


def fit_record(steps: int, clocks: Mapping[str, float | None], peak_memory_bytes: int | None = None) -> FitRecord:
    """Make the record of a fit's step count, clock readings (`training.fit.Fit.clocks`) and peak memory."""
    return FitRecord(
        steps=steps,
        seconds=clocks["seconds"],
        cpu_seconds=clocks["cpu_seconds"],
        ran_seconds=clocks["ran_seconds"],
        waited_seconds=clocks["waited_seconds"],
        standstill_seconds=clocks["standstill_seconds"],
        processor_speed=clocks["processor_speed"],
        speed_probes=int(clocks["speed_probes"] or 0),
        peak_memory_bytes=peak_memory_bytes,
    )


def fit_costs(fit: FitRecord) -> dict[str, float | None]:
    """Costs of a fit for its scores (`invgraphics.runs.scores.COST_UNITS`)."""
    return {
        "fit_seconds": fit.seconds,
        "fit_cpu_seconds": fit.cpu_seconds,
        "fit_processor_share": processor_share(fit),
        "fit_standstill_seconds": fit.standstill_seconds,
        "fit_processor_speed": fit.processor_speed,
        "steps": fit.steps,
        "peak_memory_bytes": fit.peak_memory_bytes,
    }


def processor_share(fit: FitRecord) -> float | None:
    """CPU share of a fit: running time over runnable time, in [0, 1]; ``None`` where unknown.

    From the scheduler's own times (see `training.clock`), else from the load average at the end: cores per process that wants
    one, which counts other programs' processes that wait for a disk as well.
    """
    if fit.ran_seconds is not None and fit.waited_seconds is not None and fit.ran_seconds + fit.waited_seconds > 0:
        return fit.ran_seconds / (fit.ran_seconds + fit.waited_seconds)
    load = None if fit.load_average is None else fit.load_average.end
    return None if not load else min(1.0, float(fit.cores or 1) / load)


def disturbance(costs: Mapping[str, float | None]) -> str:
    """Describe how a fit's timings were disturbed, as a sentence without its subject; empty where they were not.

    Args:
        costs: as `fit_costs` has them.
    """
    share, still = costs.get("fit_processor_share"), costs.get("fit_standstill_seconds")
    found = []
    if share is not None and share < LEAST_SHARE:
        found.append(f"had {100 * share:.0f} % of the processor time that it was ready to use; other programs had the rest")
    if still:
        found.append(f"stood still for {duration(still)}, which are not counted: it was stopped, or the machine suspended")
    return ", and ".join(found)
