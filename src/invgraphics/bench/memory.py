"""Peak memory per primitive and per sample, each operation in a process of its own.

Torch and Numba allocate outside of Python, so the operating system's peak resident set is read. It is reset
(``/proc/self/clear_refs``) once input and code are loaded; the peak of ``getrusage`` is inherited and cannot be reset.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass

from invgraphics.bench.results import PeakMemory, Results, Skipped
from invgraphics.memory import peak_resident_bytes, reset_peak, resident_bytes

GAUSSIANS, WIDTH = 50_000, 100
"""Many primitives on few pixels, so that the image's memory is negligible."""
POINTS, SAMPLES, PIXELS = 1 << 16, 1 << 20, 800
STEPS = 4
"""Training steps until memory is stationary: Adam's moments are allocated in the first."""


@dataclass(frozen=True)
class MemoryCase:
    """An operation whose peak memory is measured.

    Attributes:
        unit: unit that bytes are reported per.
        count: number of units; 0 where the run determines it (samples of a hash-grid step).
        kernels: implementations to measure.
    """

    unit: str
    count: int
    kernels: tuple[str, ...] = ("reference", "numba")


MEMORY_CASES = {
    "splats": MemoryCase("Gaussian", GAUSSIANS),
    "hash_encode": MemoryCase("point", POINTS),
    "composite": MemoryCase("sample", SAMPLES),
    "ssim": MemoryCase("pixel", PIXELS**2),
    "splat step": MemoryCase("Gaussian", GAUSSIANS, ("numba",)),
    "hash step": MemoryCase("sample", 0, ("numba",)),
}


def measure_memory(implementations: tuple[str, ...], results: Results) -> None:
    """Measure every case with every implementation, into ``results.memory``."""
    if not reset_peak():
        results.skipped.append(Skipped("memory", "this system keeps no high-water mark that can be put back (Linux does)"))
        return
    for name, case in MEMORY_CASES.items():
        for kernels in case.kernels:
            if kernels not in implementations:
                continue
            command = [sys.executable, "-m", __name__, name, kernels]
            done = subprocess.run(command, capture_output=True, text=True, check=False, env=dict(os.environ))
            if done.returncode:
                why = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
                results.skipped.append(Skipped(f"memory of {name} ({kernels})", why))
            else:
                total, count = (int(word) for word in done.stdout.split()[-2:])
                results.memory.append(PeakMemory(f"{name}, forward and backward", kernels, count, case.unit, total))


def measure(name: str, kernels: str) -> tuple[int, int]:
    """Peak resident bytes above the level before the call, and the number of primitives or samples."""
    from invgraphics.kernels import dispatch

    dispatch.use(kernels)
    dispatch.warm_up()
    run = _PREPARE[name]()
    before = resident_bytes()
    reset_peak()
    count = run()
    peak = peak_resident_bytes()
    assert peak is not None
    return peak - before, count


def _splats() -> Callable[[], int]:
    from invgraphics.bench.splat_cases import forward_backward, splat_pipeline
    from invgraphics.bench.workload import activated, camera, gaussian_field, leaves

    gaussians, viewpoint = activated(gaussian_field(GAUSSIANS)), camera(WIDTH)
    return _counted(forward_backward(lambda: splat_pipeline(gaussians, viewpoint), leaves(gaussians)), GAUSSIANS)


def _case(operation: str, count: int, **sizes: int) -> Callable[[], Callable[[], int]]:
    """The forward and backward pass of a benchmark case, without its limit."""

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
        kept = run()  # the gradients are part of what is measured
        del kept
        return count

    return once


def _splat_step() -> Callable[[], int]:
    from invgraphics.bench.iterations import VIEWS, splat_fit
    from invgraphics.bench.workload import gaussian_field, scene

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
