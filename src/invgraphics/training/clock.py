"""Scheduler times of this process: CPU time against time waiting for a core.

They distinguish a loaded machine from serial code, and a machine that stood still from both.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

TASKS = Path("/proc/self/task")
"""Linux: this process's threads. The ``schedstat`` of each begins with nanoseconds on a core, and nanoseconds ready for one."""

BUSY = 0.1
"""A thread is busy if it ran for at least this share of the busiest one's time; others only wake to poll."""

STANDSTILL = 2.0
"""Seconds of a step in which no thread ran or waited that are taken for a standstill; timers and page faults cost far less."""


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
