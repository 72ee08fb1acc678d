"""CPU share and processor speed during a fit: scheduler times of this process, and a speed probe.

CPU time against time waiting for a core distinguishes a loaded machine from serial code, and a machine that stood still from
both. Neither shows a core that does less in a second since its other hyperthread is busy, a neighbour on the same host fills
the caches, or its clock is lowered: of two fits of equal seconds one then takes fewer steps.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

TASKS = Path("/proc/self/task")
"""Linux: this process's threads. The ``schedstat`` of each begins with nanoseconds on a core, and nanoseconds ready for one."""

BUSY = 0.1
"""A thread is busy if it ran for at least this share of the busiest one's time; others only wake to poll."""

STANDSTILL = 2.0
"""Seconds of a step in which no thread ran or waited that are taken for a standstill; timers and page faults cost far less."""

PROBE_EVERY = 0.2
"""Seconds on the fit's clock between two probes; one takes a quarter of a millisecond."""


class SchedulerTimes:
    """Seconds in which this process's busy threads ran, and in which they were runnable but waited for a core.

    A serial stretch of code is neither: its idle threads are not ready. So on a quiet machine the second number stays near
    zero whatever the code does, and a process that always shares its cores with another one waits as long as it runs.
    """

    def __init__(self) -> None:
        self._before = _thread_times()
        self._waited = _waited(self._before)

    def seconds(self) -> tuple[float, float] | None:
        """(ran, waited) since the start; ``None`` where the system does not report it. Threads that have ended are excluded."""
        now = _thread_times()
        changes = []
        for thread, (ran, waited) in now.items():
            before = self._before.get(thread, (0, 0))
            changes.append((ran - before[0], waited - before[1]))
        most = max((ran for ran, _ in changes), default=0)
        busy = [change for change in changes if change[0] > 0 and change[0] >= BUSY * most]
        return (sum(ran for ran, _ in busy) * 1e-9, sum(waited for _, waited in busy) * 1e-9) if now else None

    def standstill(self, seconds: float, cpu_seconds: float) -> float:
        """Seconds, of ``seconds`` by the wall clock since a step of CPU work began, in which the process stood still.

        It was stopped then (Ctrl-Z), or its machine suspended or paused: no thread ran, or waited for a core that another
        program had. A step that waits for a disk, on which memory was swapped, cannot be distinguished from that. At least
        `STANDSTILL`; else, or where the system does not report it, 0.

        Args:
            seconds: of the step.
            cpu_seconds: of all threads together during the step.
        """
        if seconds - cpu_seconds < STANDSTILL or not (now := _thread_times()):
            return 0.0
        waited = max(0, _waited(now) - self._waited) * 1e-9  # since the last long step, so at least as long as in this one
        self._waited = _waited(now)
        still = seconds - cpu_seconds - waited
        return still if still >= STANDSTILL else 0.0


class SpeedProbe:
    """Repeats a fixed piece of work beside a fit: arithmetic in the cache, and a random gather beyond it.

    By the thread's own CPU time, which does not count waiting for a core. One thread: no pool is involved. Over two seconds
    at a time the steps per second of a fit follow it: correlations 0.98 for splats, 0.89 for NeRF and 0.87 for the hash grid.

    Args:
        speed: mean of earlier probes of the same fit, in repetitions per second.
        probes: their number.
    """

    def __init__(self, speed: float = 0.0, probes: int = 0) -> None:
        self._sum, self.probes = speed * probes, probes
        self._next = 0.0

    @property
    def speed(self) -> float | None:
        """Repetitions per second in the mean over time; ``None`` before the first probe."""
        return self._sum / self.probes if self.probes else None

    def probe_at(self, clock: float) -> None:
        """Do the work once if at least `PROBE_EVERY` seconds have passed on the fit's clock since the last time."""
        if clock < self._next:
            return
        began = time.thread_time()
        self._work()
        self._sum += 1.0 / max(time.thread_time() - began, 1e-6)
        self.probes += 1
        self._next = clock + PROBE_EVERY

    def _work(self) -> None:
        for _ in range(8):
            np.exp(_VALUES, out=_RESULTS)
            np.sqrt(_RESULTS, out=_RESULTS)
        np.take(_TABLE, _INDEX, out=_GATHERED, mode="clip")


# Made when this is imported: memory of the probe is then none of a fit's.
_VALUES = np.linspace(0, 1, 1 << 14, dtype=np.float32)
_RESULTS = np.empty_like(_VALUES)
_TABLE = np.ones(1 << 20, np.float32)
_INDEX = np.random.default_rng(0).integers(0, len(_TABLE), 1 << 15)
_GATHERED = np.ones(len(_INDEX), np.float32)


def _waited(times: Mapping[str, tuple[int, int]]) -> int:
    return sum(waited for _, waited in times.values())


def _thread_times() -> dict[str, tuple[int, int]]:
    """Thread -> nanoseconds that it ran, and that it waited for a core."""
    times = {}
    for path in TASKS.glob("*/schedstat"):
        try:
            ran, waited = path.read_text().split()[:2]
        except (OSError, ValueError):  # the thread has ended since it was listed, or the kernel keeps no such times
            continue
        times[path.parent.name] = (int(ran), int(waited))
    return times
