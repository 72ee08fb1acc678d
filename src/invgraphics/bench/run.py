"""The benchmark run: every part in order, every kernel in alternation with the reference and its hardware limit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

import torch

from invgraphics import kernels
from invgraphics.bench import PARTS, iterations, lattice_cases, limits, sample_cases, splat_cases, surface_cases
from invgraphics.bench.case import Case
from invgraphics.bench.memory import measure_memory
from invgraphics.bench.peers import lattice_peers, peers
from invgraphics.bench.results import BOTH, FORWARD_ONLY, MACHINE, THREADS, Measurement, Results, Skipped
from invgraphics.bench.timing import TimingBudget, alternate
from invgraphics.kernels.allocator import keep_freed_memory
from invgraphics.kernels.dispatch import IMPLEMENTATIONS, cpu_implementations, unavailable_reason

QUICK, FULL = TimingBudget(0.4, 2, 9), TimingBudget(0.6, 3, 15)
"""Measurement budget of each kernel variant."""
STEPS_QUICK, STEPS_FULL = TimingBudget(2.0, 2, 9), TimingBudget(4.0, 3, 15)
"""Measurement budget of each training step."""

_CASES: dict[str, Callable[[bool], Iterator[Case]]] = {
    "splats": splat_cases.splats,
    "hash": sample_cases.hash_encode,
    "lattice": lattice_cases.lattice_encode,
    "march": sample_cases.ray_march,
    "composite": sample_cases.composite,
    "picture": sample_cases.ngp_render,
    "trace": surface_cases.signed_distances,
    "mesh": surface_cases.meshes,
    "near": surface_cases.near_points,
    "ssim": splat_cases.ssim,
}


@dataclass(frozen=True)
class BenchRequest:
    """Options of a benchmark run.

    Attributes:
        parts: some of `PARTS`.
        quick: only small sizes and those of the gates.
        kernels: measure only this implementation; ``None`` for all available ones.
        progress: callback that receives a sentence about the next step.
    """

    parts: tuple[str, ...] = PARTS
    quick: bool = False
    kernels: str | None = None
    progress: Callable[[str], None] = field(default=lambda sentence: None)

    @property
    def implementations(self) -> tuple[str, ...]:
        """Implementations to measure, in alternation."""
        return (self.kernels,) if self.kernels else cpu_implementations()


def bench(request: BenchRequest, results: Results | None = None) -> Results:
    """Run the requested parts of the benchmark; the kernel selection is restored afterwards.

    Args:
        request: what to measure.
        results: receives every measurement as it is made, so that an interrupted run keeps what it has, and is returned.
    """
    keep_freed_memory()
    results = Results() if results is None else results
    if not request.kernels:
        missing = (name for name in IMPLEMENTATIONS if name not in cpu_implementations())
        results.skipped += [
            Skipped(f"{name} kernels", unavailable_reason(name) or "measured on a CPU only") for name in missing
        ]
    request.progress("compiling")
    with kernels.using(request.kernels):
        kernels.warm_up()
        _measure_limits(request, results)
        for part in (part for part in PARTS if part in request.parts):
            _measure_part(part, request, results)
    return results


def _measure_limits(request: BenchRequest, results: Results) -> None:
    request.progress("limits of the machine")
    for limit in limits.all_limits():
        timing = alternate({"": limit.run}, _budget(request))[""]
        sizes, threads = limit.sizes, torch.get_num_threads()
        results.measurements.append(Measurement(limit.name, MACHINE, "", sizes, threads, timing, limit.amount, limit.unit))


def _measure_part(part: str, request: BenchRequest, results: Results) -> None:
    steps = STEPS_QUICK if request.quick else STEPS_FULL
    if part in _CASES:
        for case in _CASES[part](request.quick):
            results.measurements += measure_case(case, request, results.skipped)
        if part == "lattice" and "numba" in request.implementations:  # promises are about this ratio, in quick runs too
            request.progress("torch's grid sampler")
            lattice_peers(_budget(request), results)
    elif part == "threads":
        _measure_threads(request, results)
    elif "numba" not in request.implementations:
        results.skipped.append(Skipped(part, "it is measured with the Numba kernels only"))
    elif part == "iterations":
        request.progress("whole steps")
        results.measurements += iterations.steps(request.quick, steps)
    elif part == "memory":
        request.progress("memory")
        measure_memory(request.implementations, results)
    elif part == "peers":
        request.progress("peers")
        peers(_budget(request), results)


def measure_case(case: Case, request: BenchRequest, skipped: list[Skipped]) -> list[Measurement]:
    """Measure a case in every direction: all implementations and the limit, in alternation."""
    request.progress(str(case))
    names = list(request.implementations)
    if case.without_reference and "reference" in names:
        names.remove("reference")
        skipped.append(Skipped(f"{case} by the reference", case.without_reference))
    found: list[Measurement] = []
    if not names:
        return found
    for direction, work in case.prepare().items():
        variants = {name: _with_kernels(name, work.run) for name in names}
        if work.limit:
            variants[MACHINE] = work.limit.run
        timings = alternate(variants, _budget(request))
        rate = work.limit.amount / timings[MACHINE].median if work.limit else 0.0
        label, threads = work.limit.name if work.limit else "", torch.get_num_threads()
        found += [
            Measurement(
                case.operation, name, direction, case.sizes, threads, timings[name], work.amount, work.unit, label, rate
            )
            for name in names
        ]
    return found


def _with_kernels(name: str, run: Callable[[], object]) -> Callable[[], object]:
    """``run`` with kernels ``name`` forced."""

    def forced() -> object:
        with kernels.using(name):
            return run()

    return forced


def _budget(request: BenchRequest) -> TimingBudget:
    return QUICK if request.quick else FULL


def thread_counts(most: int) -> list[int]:
    """Thread counts of a scaling run: powers of two below ``most``, and ``most``."""
    return sorted({min(1 << power, most) for power in range(most.bit_length() + 1)})


def _measure_threads(request: BenchRequest, results: Results) -> None:
    """Thread scaling: one size of each kernel with 1, 2, 4, ... threads."""
    most = torch.get_num_threads()
    if most == 1:
        results.skipped.append(Skipped("growth with threads", "there is one thread only"))
        return
    fast = [name for name in request.implementations if name != "reference"] or ["reference"]
    alone = BenchRequest(request.parts, request.quick, fast[0], request.progress)
    try:
        for count in thread_counts(most):
            torch.set_num_threads(count)
            for case in _gated():
                for m in measure_case(case, alone, results.skipped):
                    if m.direction == BOTH or case.operation in FORWARD_ONLY:
                        results.measurements.append(_renamed(m))
    finally:
        torch.set_num_threads(most)


def _renamed(m: Measurement) -> Measurement:
    """Prefix the operation, to separate it from other measurements of the same size."""
    return replace(m, operation=f"{THREADS}: {m.operation}")


def _gated() -> Iterable[Case]:
    """One benchmark case per kernel: the last of its quick sizes."""
    everything = [case for make in _CASES.values() for case in make(True)]
    last = {case.operation: case for case in everything}
    return last.values()
