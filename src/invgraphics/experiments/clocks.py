"""What a fit cost in time, and whether its clock can be believed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

LEAST_SHARE = 0.85
"""A fit that ran for less of the time in which it was ready to run was disturbed: its times are not ranked."""


def load_average() -> float | None:
    """Processes that ran or were ready to, mean over the last minute; ``None`` where the system does not say."""
    try:
        return round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        return None


def fit_costs(record: Mapping[str, Any]) -> dict[str, Any]:
    """Costs of a fit for its scores.

    Args:
        record: a run's ``fit.json``.
    """
    return {
        "fit_seconds": record["seconds"],
        "fit_cpu_seconds": record.get("cpu_seconds"),
        "fit_processor_share": processor_share(record),
        "steps": record["steps"],
        "peak_memory_bytes": record.get("peak_memory_bytes"),
    }


def processor_share(record: Mapping[str, Any]) -> float | None:
    """Share of the time in which a fit was ready to run that it ran; ``None`` where nothing is known.

    From the scheduler's own times (see `training.clock`), else from the load average at the end: cores per process that wants
    one, which counts other programs' processes that wait for a disk as well.

    Args:
        record: a run's ``fit.json``.
    """
    ran, waited = record.get("ran_seconds"), record.get("waited_seconds")
    if ran is not None and waited is not None and ran + waited > 0:
        return float(ran / (ran + waited))
    load = (record.get("load_average") or {}).get("end")
    return None if not load else min(1.0, float(record.get("cores") or 1) / load)


def disturbance(share: float | None) -> str:
    """What is wrong with a fit's clock, the subject left out; empty where nothing is.

    Args:
        share: as `processor_share` has it.
    """
    if share is None or share >= LEAST_SHARE:
        return ""
    return f"had {100 * share:.0f} % of the processor time that it was ready to use; other programs had the rest"
