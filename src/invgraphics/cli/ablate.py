"""``invgraphics ablate``: run a study with factors, levels and seeds, and write its report."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from invgraphics.cli.arguments import parse_samples, parse_seeds, parse_size, parse_views, refuse_idle
from invgraphics.errors import InputError
from invgraphics.experiments.request import AblateRequest
from invgraphics.studies.reading import locate, name_of, read_study, with_request
from invgraphics.training.budget import Budget

if TYPE_CHECKING:
    from invgraphics.studies.forecast import Forecast

MOST_HOURS = 4.0
"""A longer study is not started without asking."""


@dataclass(frozen=True, kw_only=True)
class Ablate:
    """Run a study: methods and scenes under every level of its factors, with several seeds; then write its report.

    The same command again keeps finished runs and continues the others. Exit status 1: some runs failed.

    Attributes:
        study: A built-in study (see `invgraphics list studies`), or the path of a study.toml.
        out: Folder of the report and its runs.
        executor: What runs the fits: this machine, or a Ray cluster, which must share its files.
        jobs: Fits that share a machine; each gets an equal part of its cores. One at a time keeps timings fair.
        gpus: GPUs of each fit; for a cluster only.
        address: The Ray cluster; with --executor ray only.
        yes: Start a study of more than four hours without asking.
        seeds: Each cell is fitted once per seed.
        budget: How long each fit may optimise.
        size: Size of the pictures; one number is the longest side.
        test_views: How many test views are scored: of a built-in scene the first N, which are evenly distributed; of a data set
            N evenly spaced ones.
        spp: Samples per pixel of the training views of scenes that are rendered.
        device: Device that computes.
        kernels: Force an implementation of the hot operations: numba, reference (plain torch), or cuda with --device cuda.
        checkpoint_every: Interval between checkpoints, the most work that an interruption costs.
        keep: Keep finished cells whose recipe, scene and request are the same although the code has changed since.
        cells: Run only the cells whose label METHOD SCENE@SIZE BUDGET seed=N fits, for instance 'splatting/* fence@400 *'.
        most_seconds: Leave fits with a longer budget for later.
    """

    study: Annotated[Positional[str], arg(metavar="STUDY")]
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: reports/STUDY)")] = None
    executor: Annotated[str, arg(metavar="local|ray")] = "local"
    jobs: Annotated[int, arg(metavar="N")] = 1
    gpus: Annotated[float | None, arg(metavar="N", help_behavior_hint="(default: 1 with --device cuda)")] = None
    address: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="(default: one started for this study)")] = None
    yes: bool = False
    seeds: Annotated[str | None, arg(metavar="0,1,2", help_behavior_hint="(default: the study's)")] = None
    budget: Annotated[str | None, arg(metavar="60s|5000steps", help_behavior_hint="(default: the study's)")] = None
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT|N", help_behavior_hint="(default: the study's)")] = None
    test_views: Annotated[str | None, arg(metavar="N|all", help_behavior_hint="(default: the study's)")] = None
    spp: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: the study's)")] = None
    device: Annotated[str | None, arg(metavar="cpu|cuda", help_behavior_hint="(default: cpu)")] = None
    kernels: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: the fastest here)")] = None
    checkpoint_every: Annotated[str, arg(metavar="30s|5m|100steps")] = "30s"
    keep: bool = False
    cells: Annotated[str | None, arg(metavar="PATTERN", help_behavior_hint="(default: all)")] = None
    most_seconds: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="(default: no limit)")] = None

    def run(self) -> int:
        """Run the missing cells; prints failures and the page's path. Returns the exit status, 1 if cells failed."""
        request = self.request()
        with_request(read_study(locate(request.study)), request)  # refuses most mistakes before torch is imported

        from invgraphics.studies.ablate import ablate

        folder, failed = ablate(request, self._confirm)
        for cell in failed:
            print(f"{cell.run} failed: {(cell.error or 'no message').splitlines()[0]}")

        from invgraphics.report.study import build_study_report

        print(build_study_report(folder))
        return 1 if failed else 0

    def request(self) -> AblateRequest:
        """Convert the options to a validated request, without opening any data."""
        if self.budget is not None:
            Budget.parse(self.budget)
        if self.jobs < 1:
            raise InputError(f"--jobs cannot be {self.jobs}.", "Expected a number of fits, 1 or more.")
        if self.most_seconds is not None and not self.most_seconds > 0:
            raise InputError(f"--most-seconds cannot be {self.most_seconds:g}.", "Expected seconds of optimisation, above 0.")
        local = self.executor == "local"
        if local:
            refuse_idle({"--gpus": self.gpus, "--address": self.address}, "on this machine", ", or add --executor ray")
        gpus = float(self.device == "cuda" and not local) if self.gpus is None else self.gpus
        views = None if self.test_views is None else parse_views(self.test_views) or "all"
        return AblateRequest(
            study=self.study,
            out=str(Path("reports") / name_of(locate(self.study)) if self.out is None else self.out),
            executor=self.executor,
            jobs=self.jobs,
            gpus=gpus,
            address=self.address,
            seeds=None if self.seeds is None else parse_seeds(self.seeds),
            budget=self.budget,
            size=None if self.size is None else parse_size(self.size),
            test_views=views,
            spp=parse_samples(self.spp),
            device=self.device,
            kernels=self.kernels,
            checkpoint_every=self.checkpoint_every,
            keep=self.keep,
            cells=self.cells,
            most_seconds=self.most_seconds,
        )

    def _confirm(self, forecast: Forecast) -> None:
        """Print the forecast, and ask for confirmation where it is long.

        Raises:
            InputError: the answer was no, or no terminal could give one.
        """
        print(forecast, file=sys.stderr, flush=True)
        if self.yes or forecast.hours <= MOST_HOURS:
            return
        advice = "Fewer --seeds or a smaller --budget make it shorter."
        if not sys.stdin.isatty():
            raise InputError(
                f"The study needs about {forecast.hours:.2g} h, and there is no terminal to confirm it.", f"Add --yes. {advice}"
            )
        print("Start it? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() not in ("y", "yes"):
            raise InputError("The study was not started.", advice)
