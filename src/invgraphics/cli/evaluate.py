"""``invgraphics evaluate``: render and score a finished run again from its model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from invgraphics.cli.output import show_scores
from invgraphics.runs.folder import check_run


@dataclass(frozen=True)
class Evaluate:
    """Render the test views of a finished run again from its model, and score them.

    Attributes:
        folder: The folder of a run.
        scene: Another copy of the scene, for instance where the data set has moved.
        protocol: How pictures are scored: default (rounded to 8 bits), or float.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    scene: Annotated[Positional[str | None], arg(metavar="[SCENE]", help_behavior_hint="(default: the run's own)")] = None
    protocol: Annotated[str, arg(metavar="NAME")] = "default"

    def run(self) -> int:
        """Score the run and print the scores; returns exit status 0."""
        check_run(self.folder)

        from invgraphics.experiments.evaluate import evaluate_run

        show_scores(evaluate_run(self.folder, self.scene, self.protocol))
        return 0
