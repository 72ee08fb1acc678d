"""Output files of a benchmark run: CSV tables, JSON record, plots and the HTML page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from invgraphics.bench import plots, tables
from invgraphics.bench.gates import Gate, gates
from invgraphics.bench.growth import growths
from invgraphics.bench.plots import PlotStyle
from invgraphics.bench.results import Results, write_tables
from invgraphics.bench.tables import Table, kernels_of
from invgraphics.files import write_text

FIGURES = "figures"
"""Folder of the plots."""


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        anchor: HTML id.
        title: heading.
        text: introduction.
        table: measurements.
        plots: figures.
    """

    anchor: str
    title: str
    text: str
    table: Table
    plots: tuple[plots.Plot, ...] = ()


def write(results: Results, record: Mapping[str, object], folder: Path, style: PlotStyle) -> Path:
    """Write ``results.csv``, ``memory.csv``, ``bench.json``, plots and ``index.html``; returns the page's path.

    Args:
        results: measurements.
        record: provenance: machine, versions, load, command.
        folder: output folder, created if needed.
        style: style of plots and page.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for figure in (folder / FIGURES).glob("*.svg"):  # of an earlier run, which measured other parts
        figure.unlink()
    write_tables(results, folder)
    found, power_laws = gates(results), growths(kernels_of(results))
    whole = {
        "record": dict(record),
        "gates": [{**asdict(gate), "verdict": gate.verdict} for gate in found],
        "growth": [asdict(growth) for growth in power_laws],
        "skipped": [asdict(skipped) for skipped in results.skipped],
    }
    write_text(folder / "bench.json", json.dumps(whole, indent=2) + "\n")
    return _write_page(results, record, found, folder, style)


def _write_page(results: Results, record: Mapping[str, object], found: list[Gate], folder: Path, style: PlotStyle) -> Path:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("invgraphics.bench"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = folder / "index.html"
    context = {
        "stylesheet": style.stylesheet,
        "record": {name: str(value) for name, value in record.items() if name != "command"},
        "command": record.get("command", ""),
        "gates": tables.gate_table(found),
        "headline": headline(found),
        "sections": [section for section in _sections(results, folder / FIGURES, style) if section.table.rows],
        "skipped": results.skipped,
        "url": lambda path: path.relative_to(folder).as_posix(),
    }
    write_text(page, environment.get_template("bench.html").render(context))
    return page


def headline(found: list[Gate]) -> str:
    """Summary of the gates in a sentence."""
    verdicts = [gate.verdict for gate in found]
    kept, missed, unknown = (verdicts.count(verdict) for verdict in ("PASS", "MISS", "-"))
    summary = f"{kept} of {len(found)} promises kept, {missed} missed"
    return f"{summary}, {unknown} not measured." if unknown else f"{summary}."


def _sections(results: Results, figures: Path, style: PlotStyle) -> list[Section]:
    drawn = {
        name: (plot,) if (plot := draw(results, figures, style)) else ()
        for name, draw in (("shares", plots.share_plot), ("gather", plots.gather_plot), ("threads", plots.thread_plot))
    }
    return [
        Section("kernels", "Kernels", _KERNELS, tables.kernel_table(results), drawn["shares"]),
        Section("steps", "Whole steps", _STEPS, tables.step_table(results)),
        Section(
            "growth",
            "Growth of cost",
            _GROWTH,
            tables.growth_table(growths(kernels_of(results))),
            tuple(plots.growth_plots(results, figures, style)),
        ),
        Section("threads", "Threads", _THREADS, tables.thread_table(results), drawn["threads"]),
        Section("memory", "Memory", _MEMORY, tables.memory_table(results.memory)),
        Section("peers", "Peers", _PEERS, tables.peer_table(results)),
        Section("limits", "Limits of this machine", _LIMITS, tables.limit_table(results), drawn["gather"]),
    ]


_KERNELS = (
    "Median time and quartiles of one call; the first call of each is discarded, then two to nine count in a quick run, three "
    "to fifteen in a whole one, fewest of slow ones (results.csv counts them). The reference (plain torch), Numba and the "
    "limit take turns, call by call, so a disturbance meets all of them. Splats count the alphas that the rasteriser evaluates "
    "(16 for every visit of a footprint to a block of 4 x 4 pixels; the backward pass visits again) against exponentials per "
    "second; hash encoding counts 8 look-ups per level and point and pass against random reads in a table of one level's size, "
    "lattices the cache lines that a point reads against random reads among all their features; what streams through memory is "
    "compared with the triad, SSIM's filters with the matrix product."
)
_STEPS = (
    "A whole step of a fit (draw, render, compare, differentiate, Adam; for the hash grid also its share of an update of the "
    "occupancy grid) beside what it cannot do without: project, bin and rasterise there and back on the same pictures, or the "
    "two networks alone on as many samples in the same chunks. The rate ratio compares Gaussians or samples per second."
)
_GROWTH = "The exponent p of time ~ size^p, fitted where one size varies and all else stays: 1 is proportional."
_THREADS = "One size of each kernel, forward and backward, with fewer threads."
_MEMORY = (
    "High-water mark of the resident set in a process of its own, beyond what it held with its input made and its code "
    "loaded; whole steps include parameters, gradients and Adam's moments."
)
_PEERS = (
    "Other people's code, in alternation with ours. A torch-only tile rasteriser is our own reference, above. Mitsuba traces "
    "one ray per pixel through the same Gaussians. torch's grid_sample gets TensoRF's own layout: lattices with as many axes "
    "are one batch, channels first, lines of width 1, and their products are torch's. It shares out a batch, not the points, "
    "so voxels keep one core busy and factors three at most. Only its ratio is gated, by layout: products of factors promise "
    "less, because a factor's gradient needs the values of the others, which are looked up again."
)
_LIMITS = (
    "sgemm: torch.mm of 2048 x 2048 float32. triad: a = b + s c on arrays larger than the caches. exp2: the kernels' own "
    "polynomial on data in the L1 cache. gather: random reads of 8-byte entries."
)
