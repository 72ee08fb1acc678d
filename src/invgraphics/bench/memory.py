"""Memory per primitive and per sample, each operation in a process of its own.

Torch and Numba allocate behind Python's back, so the kernel's high-water mark of the resident set is read. It is put back
(``/proc/self/clear_refs``) when the input is made and the code is loaded; inherited marks of ``getrusage`` would mislead.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from invgraphics.bench.results import Footprint, Results, Skipped

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
PEAK_TO_NOW = "5"
"""Written to `CLEAR`, sets the high-water mark to what is held now (Linux 4.0)."""

GAUSSIANS, WIDTH = 50_000, 100
"""Many primitives on few pixels, so that the picture hardly counts."""
POINTS, SAMPLES, PIXELS = 1 << 16, 1 << 20, 800
STEPS = 4
"""Whole steps until memory has settled: Adam's moments come with the first."""


@dataclass(frozen=True)
class Subject:
    """What is run once while memory is watched.

    Attributes:
        unit: what the bytes are counted per.
        count: how many there are; for steps of a hash grid, the number is found in the run.
        kernels: implementations to measure.
    """

    unit: str
    count: int
    kernels: tuple[str, ...] = ("reference", "numba")


SUBJECTS = {
    "splats": Subject("Gaussian", GAUSSIANS),
    "hash_encode": Subject("point", POINTS),
    "composite": Subject("sample", SAMPLES),
    "ssim": Subject("pixel", PIXELS**2),
    "splat step": Subject("Gaussian", GAUSSIANS, ("numba",)),
    "hash step": Subject("sample", 0, ("numba",)),
}


def footprints(implementations: tuple[str, ...], results: Results) -> None:
    """Measure every subject by every implementation."""
    if not (STATUS.exists() and CLEAR.exists()):
        results.skipped.append(Skipped("memory", "this system keeps no high-water mark that can be put back (Linux does)"))
        return
    for name, subject in SUBJECTS.items():
        for kernels in subject.kernels:
            if kernels not in implementations:
                continue
            command = [sys.executable, "-m", __name__, name, kernels]
            done = subprocess.run(command, capture_output=True, text=True, check=False, env=dict(os.environ))
            if done.returncode:
                why = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
                results.skipped.append(Skipped(f"memory of {name} ({kernels})", why))
            else:
                total, count = (int(word) for word in done.stdout.split()[-2:])
                results.footprints.append(Footprint(f"{name}, forward and backward", kernels, count, subject.unit, total))


def measure(name: str, kernels: str) -> tuple[int, int]:
    """Bytes held at the peak beyond what was held before, and the number of primitives or samples."""
    from invgraphics.kernels import dispatch

    dispatch.use(kernels)
    dispatch.warm_up()
    run = _PREPARE[name]()
    before = held("VmRSS")
    CLEAR.write_text(PEAK_TO_NOW)
    count = run()
    return held("VmHWM") - before, count


def held(entry: str) -> int:
    """Bytes that the system's status of this process gives for an entry."""
    found = re.search(rf"^{entry}:\s+(\d+) kB", STATUS.read_text(), re.MULTILINE)
    assert found is not None, entry
    return int(found.group(1)) * 1024


def _splats() -> Callable[[], int]:
    from invgraphics.bench.splat_cases import both_ways, splat_pipeline
    from invgraphics.bench.subject import activated, camera, gaussian_field, leaves

    gaussians, seen_by = activated(gaussian_field(GAUSSIANS)), camera(WIDTH)
    return _counted(both_ways(lambda: splat_pipeline(gaussians, seen_by), leaves(gaussians)), GAUSSIANS)


def _case(operation: str, count: int, **sizes: int) -> Callable[[], Callable[[], int]]:
    """The forward and backward pass of a benchmark's case, without a look at its limits."""

    def prepare() -> Callable[[], int]:
        from invgraphics.bench import sample_cases, splat_cases
        from invgraphics.bench.results import BOTH

        generators = (sample_cases.hash_encode, sample_cases.composite, splat_cases.ssim)
        for case in (case for generator in generators for case in generator(False)):
            if case.operation == operation and sizes.items() <= case.sizes.items():
                return _counted(case.prepare()[BOTH].run, count)
        raise LookupError(operation)

    return prepare


def _counted(run: Callable[[], object], count: int) -> Callable[[], int]:
    def once() -> int:
        kept = run()  # the gradients are part of what is held
        del kept
        return count

    return once


def _splat_step() -> Callable[[], int]:
    from invgraphics.bench.iterations import VIEWS, splat_fit
    from invgraphics.bench.subject import gaussian_field, scene

    pictures = scene(gaussian_field(GAUSSIANS), VIEWS, WIDTH)

    def run() -> int:
        fit = splat_fit(gaussian_field(GAUSSIANS), pictures)
        for _ in range(STEPS):
            fit.step()
        return GAUSSIANS

    return run


def _hash_step() -> Callable[[], int]:
    from invgraphics.bench.iterations import NERF_GATE, WARM_STEPS, nerf_fit, nerf_scene

    pictures = nerf_scene()

    def run() -> int:
        running = nerf_fit(pictures, **NERF_GATE, warm_steps=WARM_STEPS)
        for _ in range(STEPS):
            running.fit.step()
        return max(running.counter.samples)

    return run


_PREPARE: dict[str, Callable[[], Callable[[], int]]] = {
    "splats": _splats,
    "hash_encode": _case("hash_encode", POINTS, log2_size=15, points=POINTS),
    "composite": _case("composite", SAMPLES, samples=SAMPLES),
    "ssim": _case("ssim", PIXELS**2, width=PIXELS),
    "splat step": _splat_step,
    "hash step": _hash_step,
}


if __name__ == "__main__":
    print(*measure(sys.argv[1], sys.argv[2]))
