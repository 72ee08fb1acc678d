"""``invgraphics compare``: fit, evaluate and report several methods on one scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from invgraphics.cli.arguments import Shared, parse_list, parse_seeds
from invgraphics.cli.report import write_report
from invgraphics.experiments.request import CompareRequest
from invgraphics.interruption import Terminated
from invgraphics.recipes.recipe import expand, presets
from invgraphics.runs.comparison import ComparisonRecord
from invgraphics.runs.folder import RUNS, RunFolder


@dataclass(frozen=True, kw_only=True)
class Compare(Shared):
    """Fit several methods to one scene under one budget, each in its own process; score them; write a report.

    The same command again keeps finished runs and continues the others. On a rendered scene, methods that start from points
    start from those found in the training photographs, unless --set data.init says otherwise. Exit status 1: some fits failed.

    Attributes:
        scene: A built-in scene (see `invgraphics list scenes`), or the path of a data set.
        methods: Methods with commas between them (see `invgraphics list methods`); METHOD:key=value changes a value of the
            recipe. `all`, or a pattern such as `volumetric/*`, takes those that go with the scene.
        seeds: Each method is fitted once per seed.
        keep: Keep finished runs whose recipe, scene and request are the same although the code has changed since.
        out: Folder of the report and its runs.
    """

    scene: Annotated[Positional[str], arg(metavar="SCENE")]
    methods: Annotated[str | None, arg(metavar="A,B,C", help_behavior_hint="(default: those that suit the scene)")] = None
    seeds: Annotated[str, arg(metavar="0,1,2")] = "0"
    keep: bool = False
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: reports/compare-SCENE)")] = None

    def run(self) -> int:
        """Run the comparison; prints the table and the page's path. Returns the exit status, 1 if fits failed."""
        request = self.request()
        for method in request.methods:
            presets(method)  # refuses an unknown method before torch is imported
        self.check_primitives(request.methods)

        from invgraphics.experiments.compare import compare

        try:
            folder, failures = compare(request)
        except Terminated:
            raise
        except KeyboardInterrupt:
            _report_what_is_finished(Path(request.out))
            raise
        write_report(folder)
        return 1 if failures else 0

    def request(self) -> CompareRequest:
        """Convert the options to a validated request, without opening any data."""
        out = Path("reports") / f"compare-{Path(self.scene).resolve().name}" if self.out is None else self.out
        methods, optional = (
            expand(parse_list(self.methods, "--methods")) if self.methods is not None else ((), frozenset[str]())
        )
        request = CompareRequest(
            scene=self.scene,
            methods=methods,
            seeds=parse_seeds(self.seeds),
            optional=optional,
            out=str(out),
            keep=self.keep,
            **self.settings(),
        )
        return replace(request, requested=self.methods or "") if optional else request


def _report_what_is_finished(folder: Path) -> None:
    if RunFolder(folder).has(ComparisonRecord) and any(RunFolder(run).finished for run in folder.glob(f"{RUNS}/*/*")):
        write_report(folder)
