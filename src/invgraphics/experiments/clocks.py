"""What a fit cost in time, and whether its clock can be believed."""

from __future__ import annotations

import os
from collections.abc import Mapping

from invgraphics.runs.fit import FitRecord

LEAST_SHARE = 0.85
"""A fit that ran for less of the time in which it was ready to run was disturbed: its times are not ranked."""


def load_average() -> float | None:
    """Processes that ran or were ready to, mean over the last minute; ``None`` where the system does not say."""
    try:
        return round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        return None


def fit_record(steps: int, clocks: Mapping[str, float | None]) -> FitRecord:
    """How far a fit is, from its steps and what `training.fit.Fit.clocks` says."""
    return FitRecord(
        steps=steps,
        seconds=clocks["seconds"],
        cpu_seconds=clocks["cpu_seconds"],
        ran_seconds=clocks["ran_seconds"],
        waited_seconds=clocks["waited_seconds"],
    )


def fit_costs(fit: FitRecord) -> dict[str, float | None]:
    """Costs of a fit for its scores (`invgraphics.runs.scores.COST_UNITS`)."""
    return {
        "fit_seconds": fit.seconds,
        "fit_cpu_seconds": fit.cpu_seconds,
        "fit_processor_share": processor_share(fit),
        "steps": fit.steps,
        "peak_memory_bytes": fit.peak_memory_bytes,
    }


def processor_share(fit: FitRecord) -> float | None:
    """Share of the time in which a fit was ready to run that it ran; ``None`` where nothing is known.

    From the scheduler's own times (see `training.clock`), else from the load average at the end: cores per process that wants
    one, which counts other programs' processes that wait for a disk as well.
    """
    if fit.ran_seconds is not None and fit.waited_seconds is not None and fit.ran_seconds + fit.waited_seconds > 0:
        return fit.ran_seconds / (fit.ran_seconds + fit.waited_seconds)
    load = None if fit.load_average is None else fit.load_average.end
    return None if not load else min(1.0, float(fit.cores or 1) / load)


def disturbance(share: float | None) -> str:
    """What is wrong with a fit's clock, the subject left out; empty where nothing is.

    Args:
        share: as `processor_share` has it.
    """
    if share is None or share >= LEAST_SHARE:
        return ""
    return f"had {100 * share:.0f} % of the processor time that it was ready to use; other programs had the rest"
