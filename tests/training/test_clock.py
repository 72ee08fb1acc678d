"""Clocks: processor time, time spent waiting for a core, and threads that do not spin."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from invgraphics.training import clock
from invgraphics.training.clock import PROBE_EVERY, SchedulerTimes, SpeedProbe

WORK = """
import os, time
os.sched_setaffinity(0, {{ {core} }})
end = time.monotonic() + 60
while time.monotonic() < end:
    pass
"""


def _thread(folder: Path, name: str, ran: int, waited: int) -> None:
    (folder / name).mkdir(exist_ok=True)
    (folder / name / "schedstat").write_text(f"{ran} {waited} 7\n")


def test_only_busy_threads_count(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(clock, "TASKS", tmp_path)
    _thread(tmp_path, "1", 5_000_000_000, 1_000_000_000)
    _thread(tmp_path, "2", 0, 0)
    _thread(tmp_path, "9", 0, 0)
    times = SchedulerTimes()
    assert times.seconds() == (0, 0)  # nothing has run
    _thread(tmp_path, "1", 7_000_000_000, 1_500_000_000)
    _thread(tmp_path, "2", 10_000_000, 900_000_000)  # wakes now and then
    _thread(tmp_path, "3", 1_000_000_000, 250_000_000)  # began since
    (tmp_path / "9" / "schedstat").unlink()  # has ended
    assert times.seconds() == pytest.approx((3.0, 0.75))


def test_kernels_without_such_times(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(clock, "TASKS", tmp_path / "absent")
    assert SchedulerTimes().seconds() is None
    assert SchedulerTimes().standstill(100.0, 1.0) == 0


def test_a_standstill_is_neither_running_nor_waiting(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(clock, "TASKS", tmp_path)
    _thread(tmp_path, "1", 5_000_000_000, 1_000_000_000)
    times = SchedulerTimes()
    assert times.standstill(8.0, 6.5) == 0  # too short to tell
    _thread(tmp_path, "1", 8_000_000_000, 1_500_000_000)
    assert times.standstill(10.0, 3.0) == pytest.approx(6.5)
    _thread(tmp_path, "1", 11_000_000_000, 8_000_000_000)  # waited for all but half a second of it
    assert times.standstill(10.0, 3.0) == 0
    assert times.standstill(10.0, 3.0) == pytest.approx(7.0)  # the waiting was in the step before


STOPPED = """
import time
from invgraphics.training.clock import PROBE_EVERY, SchedulerTimes, SpeedProbe
times, began, cpu_began = SchedulerTimes(), time.perf_counter(), time.process_time()
print("began", flush=True)
while time.process_time() - cpu_began < 1:
    pass
print(times.standstill(time.perf_counter() - began, time.process_time() - cpu_began))
"""


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the kernel keeps no times of threads")
def test_a_stopped_process_stands_still() -> None:
    """As by Ctrl-Z; a suspended machine looks the same from within."""
    process = subprocess.Popen([sys.executable, "-c", STOPPED], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "began\n"
    process.send_signal(signal.SIGSTOP)
    time.sleep(3)
    process.send_signal(signal.SIGCONT)
    assert float(process.communicate()[0]) == pytest.approx(3.0, abs=0.5)


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the kernel keeps no times of threads")
def test_waiting_for_a_core_is_told_from_having_nothing_to_do() -> None:
    """A thread that shares its core with another program waits about as long as it runs; one that sleeps does not wait."""
    core = min(os.sched_getaffinity(0))
    rival = subprocess.Popen([sys.executable, "-c", WORK.format(core=core)])
    found: dict[str, tuple[float, float]] = {}

    def work(name: str, pause: float) -> None:
        os.sched_setaffinity(0, {core})  # of this thread alone
        tid = str(threading.get_native_id())
        before = clock._thread_times()[tid]
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            if pause:
                time.sleep(pause)
        after = clock._thread_times()[tid]
        found[name] = (after[0] - before[0]) * 1e-9, (after[1] - before[1]) * 1e-9

    try:
        for name, pause in (("busy", 0.0), ("idle", 0.3)):
            thread = threading.Thread(target=work, args=(name, pause))
            thread.start()
            thread.join()
    finally:
        rival.kill()
        rival.wait()
    ran, waited = found["busy"]
    assert waited > 0.3 * ran
    assert sum(found["idle"]) < 0.5 * (ran + waited)


SPINNING = """
import {first}
import torch, time
import invgraphics
from invgraphics.kernels.openmp import limit_spinning
print(limit_spinning())
torch.set_num_threads(2)
values = torch.zeros(200_000)
for _ in range(5):
    values = values + 1
began = time.process_time()
for _ in range(60):
    values = values + 1
    time.sleep(0.01)
print((time.process_time() - began) / 60)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="libgomp is torch's on Linux")
@pytest.mark.parametrize("first", ["invgraphics", "torch"])
def test_idle_threads_sleep_whatever_is_imported_first(first: str) -> None:
    """A sum over two threads takes microseconds; a thread that spins until the next one comes would burn milliseconds."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("GOMP_", "OMP_"))}
    script = SPINNING.format(first=first)
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    told, seconds = done.stdout.split()
    assert (int(told) > 0) == (first == "torch")
    assert float(seconds) < 1.5e-3


def _busy(seconds: float) -> None:
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_speed_is_the_mean_rate_of_the_probes(monkeypatch) -> None:
    """Half as fast for half of the time: the mean of the rates, as steps would add up, not the inverse of the mean time."""
    probe = SpeedProbe()
    assert probe.speed is None
    for index, work in enumerate((2e-3, 2e-3, 4e-3, 4e-3)):
        monkeypatch.setattr(probe, "_work", lambda work=work: (_busy(work), time.sleep(5e-3)))  # who waits is not slow
        probe.probe_at(index * PROBE_EVERY)
        probe.probe_at(index * PROBE_EVERY + 0.9 * PROBE_EVERY)
    assert probe.probes == 4
    assert probe.speed == pytest.approx(375, rel=0.1)
    later = SpeedProbe(probe.speed, probe.probes)
    assert later.speed == pytest.approx(probe.speed)
    monkeypatch.setattr(later, "_work", lambda: _busy(1e-3))
    later.probe_at(100.0)
    assert later.speed == pytest.approx((4 * 375 + 1000) / 5, rel=0.1)


def test_the_probe_takes_no_memory_from_a_fit() -> None:
    """Its arrays are there before a fit, whose peak is what it takes above the memory held before."""
    import tracemalloc

    tracemalloc.start()
    probe = SpeedProbe()
    probe.probe_at(0.0)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert probe.speed
    assert taken < 100_000
