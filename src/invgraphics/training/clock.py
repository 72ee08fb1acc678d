"""Scheduler times of this process: CPU time against time waiting for a core, to tell a loaded machine from serial code."""

from __future__ import annotations

from pathlib import Path

TASKS = Path("/proc/self/task")
"""Linux: this process's threads. The ``schedstat`` of each begins with nanoseconds on a core, and nanoseconds ready for one."""

BUSY = 0.1
"""A thread is busy if it ran for at least this share of the busiest one's time; others only wake to poll."""


class SchedulerTimes:
    """Seconds in which this process's busy threads ran, and in which they were runnable but waited for a core.

    A serial stretch of code is neither: its idle threads are not ready. So on a quiet machine the second number stays near
    zero whatever the code does, and a process that always shares its cores with another one waits as long as it runs.
    """

    def __init__(self) -> None:
        self._before = _thread_times()

    def seconds(self) -> tuple[float, float] | None:
        """(ran, waited) since the start; ``None`` where the system does not say. Threads that have ended are left out."""
        now = _thread_times()
        changes = []
        for thread, (ran, waited) in now.items():
            before = self._before.get(thread, (0, 0))
            changes.append((ran - before[0], waited - before[1]))
        most = max((ran for ran, _ in changes), default=0)
        busy = [change for change in changes if change[0] > 0 and change[0] >= BUSY * most]
        return (sum(ran for ran, _ in busy) * 1e-9, sum(waited for _, waited in busy) * 1e-9) if now else None


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
