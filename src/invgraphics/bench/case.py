"""Benchmark cases: one kernel on one input size, with the work and the hardware limit of each direction."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from invgraphics.bench.limits import Limit

Run = Callable[[], object]

SLOW = "the plain reference would take minutes at this size"
LARGE = "the plain reference would need gigabytes at this size"


@dataclass(frozen=True)
class KernelPass:
    """One direction of a kernel, forward or forward and backward.

    Attributes:
        run: one call, with the kernels selected by `kernels.using`.
        amount: work of one call, in the unit of ``limit``; 0 where it cannot be counted.
        limit: hardware limit of its throughput; ``None`` where that cannot be measured here.
        unit: unit of work.
    """

    run: Run
    amount: float = 0.0
    limit: Limit | None = None
    unit: str = ""


@dataclass(frozen=True)
class Case:
    """A kernel on one input size.

    Attributes:
        operation: the kernel's name.
        sizes: problem size.
        prepare: builds the input, and one `KernelPass` per direction.
        without_reference: why the reference is not measured; empty if it is.
    """

    operation: str
    sizes: dict[str, int]
    prepare: Callable[[], Mapping[str, KernelPass]]
    without_reference: str = ""

    def __str__(self) -> str:
        return " ".join([self.operation, *(f"{key}={value}" for key, value in self.sizes.items())])
