"""Tables of formatted measurements, for the terminal and the page."""

from __future__ import annotations

from dataclasses import dataclass

from invgraphics.bench.gates import Gate
from invgraphics.bench.growth import Growth
from invgraphics.bench.iterations import NERF_SHARE, NERF_STEP, SPLAT_SHARE, SPLAT_STEP
from invgraphics.bench.limits import readable_bytes
from invgraphics.bench.results import MACHINE, PEERS, THREADS, Measurement, PeakMemory, Results
from invgraphics.bench.timing import Timing

STEPS = {SPLAT_STEP: SPLAT_SHARE, NERF_STEP: NERF_SHARE}
"""Training steps, and the part of each that it is compared with."""

_PREFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))


@dataclass(frozen=True)
class Table:
    """A table of formatted cells; the first ``names`` columns are labels, the others numbers."""

    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    names: int = 1


def gate_table(gates: list[Gate]) -> Table:
    """Gates: verdict, promise, target and measured ratio."""
    rows = [
        (gate.verdict, gate.name, f"{gate.bound} {gate.target:g}", "" if gate.measured is None else f"{gate.measured:.3g}")
        for gate in gates
    ]
    return Table(("", "promise", "target", "measured"), rows, names=2)


def kernel_table(results: Results) -> Table:
    """Kernels by size and direction: reference, Numba, speed-up, rate and fraction of the limit."""
    cells: dict[tuple[str, str, str], dict[str, Measurement]] = {}
    for m in kernels_of(results):
        cells.setdefault((m.operation, sizes(m.sizes), m.direction), {})[m.implementation] = m
    rows = []
    for (operation, size, direction), by in cells.items():
        plain, fast = by.get("reference"), by.get("numba")
        best = fast or plain
        assert best is not None
        ratio = f"{plain.timing.median / fast.timing.median:.3g}" if plain and fast else ""
        rows.append(
            (
                operation,
                size,
                direction,
                milliseconds(plain.timing) if plain else "",
                milliseconds(fast.timing) if fast else "",
                ratio,
                f"{quantity(best.rate)} {best.unit}/s" if best.amount else "",
                f"{percent(best.share)} of {best.limit}" if best.share is not None else "",
            )
        )
    columns = ("kernel", "size", "direction", "reference, ms", "Numba, ms", "times faster", "rate", "share of limit")
    return Table(columns, rows, names=3)


def step_table(results: Results) -> Table:
    """Training steps compared with their lower bound."""
    rows = []
    for m in results.measurements:
        part = next((x for x in results.measurements if x.operation == STEPS.get(m.operation) and x.sizes == m.sizes), None)
        if part is not None:
            name, ratio = part.operation.rpartition(": ")[2], f"{m.timing.median / part.timing.median:.3g}"
            share = percent(m.rate / part.rate)
            rows.append(
                (m.operation, sizes(m.sizes), milliseconds(m.timing), name, milliseconds(part.timing), ratio, share, m.note)
            )
    columns = ("step", "size", "ms", "yardstick", "ms", "time ratio", "rate ratio", "note")
    return Table(columns, rows, names=2)


def growth_table(growths: list[Growth]) -> Table:
    """Fitted power-law exponents."""
    rows = [
        (
            g.operation,
            g.implementation,
            g.direction,
            g.along,
            ", ".join(quantity(x) for x in g.values),
            ", ".join(number(x) for x in g.milliseconds),
            f"{g.exponent:.2f}",
        )
        for g in growths
    ]
    columns = ("kernel", "implementation", "direction", "along", "sizes", "ms", "exponent")
    return Table(columns, rows, names=4)


def thread_table(results: Results) -> Table:
    """Time by thread count, and the speed-up of the largest count over one."""
    found = [m for m in results.measurements if m.operation.startswith(THREADS)]
    counts = sorted({m.threads for m in found})
    rows = []
    for operation in dict.fromkeys(m.operation for m in found):
        by = {m.threads: m for m in found if m.operation == operation}
        first, last = by[counts[0]], by[counts[-1]]
        times = tuple(milliseconds(by[count].timing) for count in counts)
        speed_up = f"{first.timing.median / last.timing.median:.2f}"
        rows.append((operation.rpartition(": ")[2], sizes(first.sizes), *times, speed_up))
    return Table(("kernel", "size", *(f"{n} thread{'s' * (n > 1)}, ms" for n in counts), "speed-up"), rows, names=2)


def memory_table(memory: list[PeakMemory]) -> Table:
    """Peak memory, total and per primitive or sample."""
    rows = [
        (f.operation, f.implementation, quantity(f.count), readable_bytes(f.total), f"{f.each:,.0f} per {f.unit}")
        for f in memory
    ]
    return Table(("operation", "implementation", "count", "peak", "bytes"), rows, names=2)


def peer_table(results: Results) -> Table:
    """Third-party implementations compared with ours."""
    found = [m for m in results.measurements if m.operation.startswith(PEERS)]
    rows = []
    for m in found:
        ours = next(x for x in found if (x.operation, x.direction) == (m.operation, m.direction))
        name, ratio = m.operation.rpartition(": ")[2], f"{m.timing.median / ours.timing.median:.3g}"
        rows.append((name, m.direction, m.implementation, sizes(m.sizes), milliseconds(m.timing), ratio))
    return Table(("operation", "direction", "by", "size", "ms", "times our time"), rows, names=4)


def limit_table(results: Results) -> Table:
    """Measured hardware limits."""
    found = [m for m in results.measurements if m.implementation == MACHINE]
    rows = [(m.operation, str(m.threads), milliseconds(m.timing), f"{quantity(m.rate)} {m.unit}/s") for m in found]
    return Table(("limit", "threads", "ms", "rate"), rows)


def kernels_of(results: Results) -> list[Measurement]:
    """Measurements of single kernels with all threads."""
    aside = {MACHINE, "torch"}
    return [
        m
        for m in results.measurements
        if m.implementation not in aside and m.operation not in {*STEPS, *STEPS.values()} and ": " not in m.operation
    ]


def sizes(by_key: dict[str, int]) -> str:
    """Format a problem size in words."""
    return ", ".join(_size(key, value) for key, value in by_key.items())


def _size(key: str, value: int) -> str:
    words = {
        "width": f"{value} x {value}",
        "log2_size": f"2^{value} entries",
        "hidden": f"{value} wide",
        "resolution": f"{value}³ cells",
        "bytes": readable_bytes(value),
    }
    return words.get(key, f"{quantity(value)} {key}")


def milliseconds(timing: Timing) -> str:
    """Format median and quartiles in milliseconds."""
    return f"{number(1e3 * timing.median)} ({number(1e3 * timing.low)} to {number(1e3 * timing.high)})"


def number(x: float) -> str:
    """Format a number with three significant digits, without an exponent."""
    return f"{x:.0f}" if x >= 100 else f"{x:.3g}"


def quantity(x: float) -> str:
    """Format a number with a decimal prefix: ``2.1e9`` as ``2.1 G``; powers of 1000."""
    for factor, prefix in _PREFIXES:
        if x >= factor:
            return f"{x / factor:.3g} {prefix}" if prefix != "k" else f"{x / factor:.3g}k"
    return f"{x:.3g}"


def percent(share: float | None) -> str:
    """Format a fraction as a percentage with two significant digits."""
    return "" if share is None else f"{100 * share:.2g} %"
