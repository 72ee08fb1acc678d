"""Results of a benchmark run: measurements, peak memory and skipped cases, as objects and as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from invgraphics.bench.timing import Timing
from invgraphics.files import writing_text

FORWARD, BOTH = "forward", "forward+backward"
"""Directions."""
FORWARD_ONLY = (
    "ray_march", "ngp_render", "sdf_values", "sdf_radiance", "sdf_skip", "sdf_trace", "mesh_rasterise", "near_points",
)  # fmt: skip
"""Operations without a gradient."""

SIZE_KEYS = (
    "gaussians", "width", "points", "levels", "log2_size", "hidden", "resolution", "vertices", "channels", "rays", "samples",
    "triangles", "positions", "bytes",
)  # fmt: skip
"""Columns of problem sizes, in order."""

COLUMNS = (
    "operation", "implementation", "direction", *SIZE_KEYS, "threads", "median_ms", "low_ms", "high_ms", "repetitions",
    "rate", "unit", "limit", "limit_rate", "share", "note",
)  # fmt: skip

MEMORY_COLUMNS = ("operation", "implementation", "count", "unit", "peak_bytes", "bytes_per_unit")

MACHINE = "machine"
"""Implementation name of measurements of the machine's limits."""
THREADS, PEERS = "threads", "peers"
"""Prefixes of operation names in measurements of thread counts and of third-party code."""


@dataclass(frozen=True)
class Measurement:
    """One operation, timed.

    Attributes:
        operation: name of the kernel, the iteration or the limit.
        implementation: ``reference``, ``numba``, a peer, or `MACHINE`.
        direction: `FORWARD`, `BOTH`, or empty.
        sizes: problem size, by `SIZE_KEYS`.
        threads: number of threads.
        timing: seconds of one call.
        amount: work of one call, in ``unit``; 0 where it is not counted.
        unit: unit of work, for instance ``look-ups``.
        limit: hardware limit that the rate is compared with; empty for none.
        limit_rate: the limit per second, measured in alternation with the operation.
        note: remark.
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
        """Fraction of the hardware limit reached."""
        return self.rate / self.limit_rate if self.limit_rate and self.amount else None

    def row(self) -> dict[str, object]:
        """The measurement as a CSV row."""
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
class PeakMemory:
    """Peak memory of an operation, above the level before it.

    Attributes:
        operation: name of the operation, forward and backward.
        implementation: kernels that ran it.
        count: number of units.
        unit: primitive or sample.
        total: peak bytes.
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
        """The CSV row."""
        values = (self.operation, self.implementation, self.count, self.unit, self.total, f"{self.each:.5g}")
        return dict(zip(MEMORY_COLUMNS, values, strict=True))


@dataclass(frozen=True)
class Skipped:
    """A case that was not measured, and the reason."""

    what: str
    why: str


@dataclass
class Results:
    """Accumulated results of a run."""

    measurements: list[Measurement] = field(default_factory=list)
    memory: list[PeakMemory] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)

    def find(self, operation: str, implementation: str, direction: str, **sizes: int) -> Measurement | None:
        """First measurement with these keys whose sizes contain ``sizes``; else ``None``."""
        for m in self.measurements:
            named = (m.operation, m.implementation, m.direction) == (operation, implementation, direction)
            if named and sizes.items() <= m.sizes.items():
                return m
        return None


def write_tables(results: Results, folder: Path) -> None:
    """Write ``results.csv``, one line per measurement, and ``memory.csv``."""
    _write(folder / "results.csv", COLUMNS, (m.row() for m in results.measurements))
    _write(folder / "memory.csv", MEMORY_COLUMNS, (f.row() for f in results.memory))


def _write(path: Path, columns: Iterable[str], rows: Iterable[Mapping[str, object]]) -> None:
    with writing_text(path) as file:
        writer = csv.DictWriter(file, list(columns), restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
