"""What a run of the benchmark hands on: measurements, memory, what was left out; as objects and as files."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from invgraphics.bench.timing import Timing

FORWARD, BOTH = "forward", "forward+backward"
"""Directions."""
FORWARD_ONLY = ("ray_march", "ngp_render")
"""Operations without a gradient."""

SIZE_KEYS = (
    "gaussians", "width", "points", "levels", "log2_size", "hidden", "resolution", "channels", "rays", "samples", "bytes",
)  # fmt: skip
"""Columns of sizes, in order."""

COLUMNS = (
    "operation", "implementation", "direction", *SIZE_KEYS, "threads", "median_ms", "low_ms", "high_ms", "repetitions",
    "rate", "unit", "limit", "limit_rate", "share", "note",
)  # fmt: skip

MEMORY_COLUMNS = ("operation", "implementation", "count", "unit", "peak_bytes", "bytes_per_unit")

MACHINE = "machine"
"""Implementation of the operations that measure the machine's limits."""
THREADS, PEERS = "threads", "peers"
"""What precedes an operation's name in measurements of other thread counts, and beside other people's code."""


@dataclass(frozen=True)
class Measurement:
    """One operation, timed.

    Attributes:
        operation: name of the kernel, the iteration or the limit.
        implementation: ``reference``, ``numba``, a peer, or `MACHINE`.
        direction: `FORWARD`, `BOTH`, or empty.
        sizes: what the time depends on, by `SIZE_KEYS`.
        threads: threads that shared the work.
        timing: seconds of one call.
        amount: work of one call, in ``unit``; 0 where it is not counted.
        unit: what is counted, for instance ``look-ups``.
        limit: the machine's limit that the rate is compared with; empty for none.
        limit_rate: that limit per second, measured in alternation with the operation.
        note: anything a reader must know.
    """

    operation: str
    implementation: str
    direction: str
    sizes: dict[str, int]
    threads: int
    timing: Timing
    amount: float = 0.0
    unit: str = ""
    limit: str = ""
    limit_rate: float = 0.0
    note: str = ""

    @property
    def rate(self) -> float:
        """Work per second, by the median."""
        return self.amount / self.timing.median

    @property
    def share(self) -> float | None:
        """Part of the limit that was reached."""
        return self.rate / self.limit_rate if self.limit_rate and self.amount else None

    def row(self) -> dict[str, object]:
        """The measurement as a line of the table."""
        t, share = self.timing, self.share
        return {
            "operation": self.operation,
            "implementation": self.implementation,
            "direction": self.direction,
            **self.sizes,
            "threads": self.threads,
            "median_ms": f"{1e3 * t.median:.5g}",
            "low_ms": f"{1e3 * t.low:.5g}",
            "high_ms": f"{1e3 * t.high:.5g}",
            "repetitions": t.repetitions,
            "rate": f"{self.rate:.5g}" if self.amount else "",
            "unit": f"{self.unit}/s" if self.amount else "",
            "limit": self.limit,
            "limit_rate": f"{self.limit_rate:.5g}" if self.limit_rate else "",
            "share": "" if share is None else f"{share:.4f}",
            "note": self.note,
        }


@dataclass(frozen=True)
class Footprint:
    """Memory that an operation holds at its peak, beyond what was there before.

    Attributes:
        operation: what was run, forward and backward.
        implementation: by which kernels.
        count: how many of ``unit`` there were.
        unit: primitive or sample.
        total: bytes at the peak.
    """

    operation: str
    implementation: str
    count: int
    unit: str
    total: int

    @property
    def each(self) -> float:
        """Bytes per unit."""
        return self.total / self.count

    def row(self) -> dict[str, object]:
        """The line of the table."""
        values = (self.operation, self.implementation, self.count, self.unit, self.total, f"{self.each:.5g}")
        return dict(zip(MEMORY_COLUMNS, values, strict=True))


@dataclass(frozen=True)
class Skipped:
    """What was not measured, and why."""

    what: str
    why: str


@dataclass
class Results:
    """Everything one run has measured so far."""

    measurements: list[Measurement] = field(default_factory=list)
    footprints: list[Footprint] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)

    def find(self, operation: str, implementation: str, direction: str, **sizes: int) -> Measurement | None:
        """The first measurement with these keys whose sizes contain ``sizes``."""
        for m in self.measurements:
            named = (m.operation, m.implementation, m.direction) == (operation, implementation, direction)
            if named and sizes.items() <= m.sizes.items():
                return m
        return None


def write_tables(results: Results, folder: Path) -> None:
    """Write ``results.csv``, one line per measurement, and ``memory.csv``."""
    _write(folder / "results.csv", COLUMNS, (m.row() for m in results.measurements))
    _write(folder / "memory.csv", MEMORY_COLUMNS, (f.row() for f in results.footprints))


def _write(path: Path, columns: Iterable[str], rows: Iterable[Mapping[str, object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns), restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
