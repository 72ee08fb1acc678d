"""``invgraphics fit``: fit one method to one scene, and evaluate it."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from invgraphics.cli.arguments import Shared, check_seed, refuse_idle
from invgraphics.cli.output import show_scores
from invgraphics.errors import InputError
from invgraphics.experiments.request import FitRequest
from invgraphics.recipes.recipe import presets
from invgraphics.runs.folder import RunFolder
from invgraphics.text import slug


@dataclass(frozen=True, kw_only=True)
class Fit(Shared):
    """Fit one method to one scene, then render and score its test views.

    Attributes:
        method: renderer/recipe (see `invgraphics list methods`), or the path of a recipe.
        scene: A built-in scene (see `invgraphics list scenes`), or the path of a data set.
        seed: Seed of the initial values and of the fit.
        out: Folder of the run.
        snapshots: Keep N states of the model, evenly over the fit, besides the first, for `invgraphics render RUN --path
            timelapse`.
        resume: Continue the run in --out from its last checkpoint.
        keep: With --resume: continue although the code, of invgraphics or of a plug-in, has changed since; the record says so.
    """

    method: Annotated[Positional[str], arg(metavar="METHOD")]
    scene: Annotated[Positional[str], arg(metavar="SCENE")]
    seed: int = 0
    out: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint="(default: runs/SCENE-METHOD-seed-N)")] = None
    snapshots: Annotated[int, arg(metavar="N")] = 0
    resume: bool = False
    keep: bool = False

    def run(self) -> int:
        """Run the fit; prints its scores and its folder. Returns exit status 0."""
        request = self.request()
        presets(self.method)  # refuses an unknown method before torch is imported
        self.check_primitives([self.method])

        from invgraphics.experiments.run import fit_run

        try:
            folder = fit_run(request)
        except KeyboardInterrupt:
            if RunFolder(Path(request.out)).checkpoint.is_file():
                print(f"{request.out} holds the last checkpoint; --resume continues from there.", file=sys.stderr)
            raise
        show_scores(RunFolder(folder).read_scores())
        print(folder)
        return 0

    def request(self) -> FitRequest:
        """Convert the options to a validated request, without opening any data."""
        seed = check_seed(self.seed)
        name = f"{Path(self.scene).resolve().name}-{slug(self.method)}-seed-{seed}"
        out = Path("runs") / name if self.out is None else self.out
        existing = "resume" if self.resume else "refuse"
        if not self.resume:
            refuse_idle({"--keep": self.keep or None}, "without --resume")
        if self.snapshots < 0:
            raise InputError(f"--snapshots cannot be {self.snapshots}.", "Expected a number of states, 0 or more.")
        settings: dict[str, Any] = self.settings() | {"snapshots": self.snapshots, "keep": self.keep}
        return FitRequest(method=self.method, scene=self.scene, seed=seed, out=str(out), existing=existing, **settings)
