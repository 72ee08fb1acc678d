"""A kernel on one size of input, ready to be timed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from invgraphics.bench.limits import Limit

Run = Callable[[], object]

SLOW = "the plain reference would take minutes at this size"
LARGE = "the plain reference would need gigabytes at this size"


@dataclass(frozen=True)
class Pass:
    """One direction of a kernel.

    Attributes:
        run: one call, by whichever kernels are chosen while it runs.
        amount: work of one call, in the units of ``limit``; 0 where it cannot be counted.
        limit: what bounds its rate; ``None`` where that cannot be measured here.
        unit: what is counted.
    """

    run: Run
    amount: float = 0.0
    limit: Limit | None = None
    unit: str = ""


@dataclass(frozen=True)
class Case:
    """A kernel on one size.

    Attributes:
        operation: the kernel's name.
        sizes: what its time depends on.
        prepare: makes the input, and one `Pass` per direction.
        without_reference: why the reference is not measured; empty if it is.
    """

    operation: str
    sizes: dict[str, int]
    prepare: Callable[[], Mapping[str, Pass]]
    without_reference: str = ""

    def __str__(self) -> str:
        return " ".join([self.operation, *(f"{key}={value}" for key, value in self.sizes.items())])
