"""``fit.json``: step count and clock readings of a fit, written with every checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from invgraphics.runs.provenance import LoadAverage
from invgraphics.runs.schema import Record


@dataclass(frozen=True, kw_only=True)
class FitRecord(Record):
    """Steps, times and peak memory of a fit, which resuming and scoring need besides the checkpoint.

    Attributes:
        steps: optimisation steps taken; ``None`` for a model that was fitted elsewhere.
        seconds: time of these steps; ``None`` for a model that was fitted elsewhere.
        cpu_seconds: of all threads together.
        ran_seconds: that busy threads had a core; ``None`` where the system does not say.
        waited_seconds: that busy threads waited for a core.
        standstill_seconds: in which the process was stopped or its machine suspended; not among ``seconds``.
        processor_speed: repetitions per second of a fixed piece of work beside the fit (`training.clock.SpeedProbe`): it falls
            where another program has the core's other hyperthread or fills its caches; ``None`` on a GPU.
        speed_probes: repetitions that this is the mean of.
        peak_memory_bytes: most memory so far above what its process held before the fit, the largest where a fit was resumed.
        cores: that the process may use; known at the end.
        load_average: known at the end.
    """

    FILE: ClassVar[str] = "fit.json"

    steps: int | None = None
    seconds: float | None = None
    cpu_seconds: float | None = None
    ran_seconds: float | None = None
    waited_seconds: float | None = None
    standstill_seconds: float | None = None
    processor_speed: float | None = None
    speed_probes: int = 0
    peak_memory_bytes: int | None = None
    cores: int | None = None
    load_average: LoadAverage | None = None
