"""``invgraphics bench``: time the kernels against the plain reference, the machine's limits and peers."""

from __future__ import annotations

import os
import shlex
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from invgraphics.bench import PARTS, QUICK
from invgraphics.cli.arguments import parse_list
from invgraphics.cli.output import show_table
from invgraphics.errors import InputError

if TYPE_CHECKING:
    from invgraphics.bench.plots import PlotStyle
    from invgraphics.bench.results import Results
    from invgraphics.bench.run import BenchRequest


@dataclass(frozen=True)
class Bench:
    """Measure every kernel against the plain reference and against the machine's limits, in one run; write tables and a page.

    Ratios are taken within the run, those to the reference, limits and peers from calls in alternation; close other programs
    for times that mean something.

    Attributes:
        quick: Only small sizes and those that promises are made for (under two minutes).
        kernels: Measure one implementation only: numba, or reference (plain torch).
        out: Folder of the tables and the page.
        check: Exit with status 1 if a promise is missed or was not measured.
    """

    quick: bool = False
    only: Annotated[
        str | None,
        arg(metavar="A,B,C", help=f"Parts to measure: {', '.join(PARTS)}.", help_behavior_hint="(default: everything)"),
    ] = None
    kernels: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: all in alternation)")] = None
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: reports/bench[-quick|-PARTS])")] = None
    check: bool = False

    def run(self) -> int:
        """Measure; prints the gates and the page's path. Returns the exit status.

        Interrupted, it prints and writes what it has measured.
        """
        parts = self.parts()

        from invgraphics.bench.results import Results
        from invgraphics.bench.run import bench
        from invgraphics.runs.folder import output_folder

        request, out = self.request(parts), self.out or self._default_folder()
        with output_folder(out):
            began, record, results = time.perf_counter(), self._record(), Results()
            try:
                bench(request, results)
            except KeyboardInterrupt:
                record["interrupted"] = "yes"
                if results.measurements:
                    self._publish(results, record, began, out)
                raise
            return self._publish(results, record, began, out)

    def _publish(self, results: Results, record: dict[str, object], began: float, out: Path) -> int:
        """Print the tables, then write them and the page; returns the exit status."""
        from invgraphics.bench.gates import gates
        from invgraphics.bench.page import headline, write
        from invgraphics.bench.tables import gate_table, kernel_table, step_table

        record |= {"seconds": round(time.perf_counter() - began), "load at the end": _load()}
        for title, table in (("Kernels", kernel_table(results)), ("Whole steps", step_table(results))):
            if table.rows:
                show_table(title, table.columns, table.rows)
        for skipped in results.skipped:
            print(f"left out: {skipped.what} ({skipped.why})")
        found = gates(results)
        promises = gate_table(found)
        show_table(headline(found), promises.columns, promises.rows)
        print(f"Page: {write(results, record, out, _plot_style())}")
        return int(self.check and any(gate.verdict != "PASS" for gate in found))

    def _default_folder(self) -> Path:
        """Folder by what is measured, so that a part does not replace the page of a whole run."""
        some = "-".join(parse_list(self.only, "--only")) if self.only else ""
        return Path("reports") / "-".join(filter(None, ("bench", "quick" if self.quick else "", some)))

    def parts(self) -> tuple[str, ...]:
        """Names of the parts to measure, in order.

        Raises:
            InputError: there is no such part.
        """
        if self.only is None:
            return QUICK if self.quick else PARTS
        parts = parse_list(self.only, "--only")
        for part in parts:
            if part not in PARTS:
                raise InputError(f"--only: there is no part '{part}'.", f"Parts: {', '.join(PARTS)}.")
        return parts

    def request(self, parts: tuple[str, ...]) -> BenchRequest:
        """Convert the options to a validated request.

        Raises:
            InputError: the kernels are unknown, or do not work here.
        """
        from invgraphics import kernels
        from invgraphics.bench.run import BenchRequest
        from invgraphics.errors import InputError
        from invgraphics.kernels.dispatch import cpu_implementations

        with kernels.using(self.kernels):  # refuses what cannot be used
            if self.kernels not in (None, *cpu_implementations()):
                raise InputError(f"The {self.kernels} kernels do not run on a CPU, and that is what `bench` measures.")
            return BenchRequest(parts, self.quick, self.kernels, lambda sentence: print(sentence, file=sys.stderr, flush=True))

    def _record(self) -> dict[str, object]:
        import torch

        from invgraphics.experiments.environment import environment

        command = shlex.join(["invgraphics", "bench", *sys.argv[2:]])
        return {**environment(torch.device("cpu")).facts(), "load at the start": _load(), "command": command}


def _load() -> str:
    """System load: mean number of runnable processes over the last minute."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def _plot_style() -> PlotStyle:
    """Plot style of the reports."""
    from importlib.resources import files

    from invgraphics.bench.plots import PlotStyle
    from invgraphics.report.figures import style

    sheet = files("invgraphics.report").joinpath("templates", "style.css").read_text(encoding="utf-8")
    return PlotStyle(style.canvas, style.save, style.series_style, sheet)
