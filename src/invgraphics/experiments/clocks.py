"""Time costs of a fit and of its pictures, and detection of timings disturbed by other processes or by a standstill."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import replace

from invgraphics.core import Camera, Model, Rendering
from invgraphics.runs.fit import FitRecord
from invgraphics.text import duration
from invgraphics.training.clock import SchedulerTimes

LEAST_SHARE = 0.85
"""A fit that ran for less of the time in which it was ready to run was disturbed: its times are not ranked."""

LEAST_READY = 0.2
"""Least time ready to run, in seconds, over which the CPU share of pictures is computed: in less, one time slice decides."""


class PictureClock:
    """Times pictures as a viewer renders them, and measures the process's CPU share meanwhile.

    Attributes:
        seconds: of each picture.
    """

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self._ran = self._waited = 0.0
        self._whole: SchedulerTimes | None = None

    def render(self, model: Model, camera: Camera) -> Rendering:
        """Render a view with colour, alpha and depth, on the clock."""
        scheduler = SchedulerTimes()
        self._whole = self._whole or scheduler
        began = time.perf_counter()
        picture = model.render(camera, normals=False)
        self.seconds.append(time.perf_counter() - began)
        ran, waited = scheduler.seconds() or (0.0, 0.0)
        self._ran, self._waited = self._ran + ran, self._waited + waited
        return picture

    @property
    def processor_share(self) -> float | None:
        """CPU share while pictures were rendered, in [0, 1]; ``None`` where the system does not say, or all was over too soon.

        Pictures that took less than `LEAST_READY` together are judged by all of the evaluation that they are spread over.
        """
        whole = None if self._whole is None else self._whole.seconds()
        for ran, waited in ((self._ran, self._waited), whole or (0.0, 0.0)):
            if ran + waited >= LEAST_READY:
                return ran / (ran + waited)
        return None


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


def at_step(fit: FitRecord, steps: int) -> FitRecord:
    """Clock readings of a fit at a step after its record: the steps in between count at the mean rate of those before."""
    if not fit.steps or steps <= fit.steps:
        return fit
    clocks = ("seconds", "cpu_seconds", "ran_seconds", "waited_seconds")
    known = {name: value for name in clocks if (value := getattr(fit, name)) is not None}
    return replace(fit, steps=steps, **{name: value * steps / fit.steps for name, value in known.items()})


def processor_share(fit: FitRecord) -> float | None:
    """CPU share of a fit: running time over runnable time, in [0, 1]; ``None`` where unknown.

    From the scheduler's own times (see `training.clock`), else from the load average at the end: cores per runnable
    process, which counts other programs' processes that wait for a disk as well.
    """
    if fit.ran_seconds is not None and fit.waited_seconds is not None and fit.ran_seconds + fit.waited_seconds > 0:
        return fit.ran_seconds / (fit.ran_seconds + fit.waited_seconds)
    load = None if fit.load_average is None else fit.load_average.end
    return None if not load else min(1.0, float(fit.cores or 1) / load)


def disturbance(costs: Mapping[str, float | None]) -> str:
    """Describe how the timings of a fit and of its pictures were disturbed, as a sentence without its subject; else empty.

    Args:
        costs: as `fit_costs` and an evaluation have them.
    """
    share, still = costs.get("fit_processor_share"), costs.get("fit_standstill_seconds")
    drawing = costs.get("render_processor_share")
    found = []
    if share is not None and share < LEAST_SHARE:
        found.append(f"had {100 * share:.0f} % of the processor time that it was ready to use; other programs had the rest")
    if still:
        found.append(f"stood still for {duration(still)}, which are not counted: it was stopped, or the machine suspended")
    if drawing is not None and drawing < LEAST_SHARE:
        found.append(f"rendered its pictures with {100 * drawing:.0f} % of the processor time that it was ready to use")
    return ", and ".join(found)
