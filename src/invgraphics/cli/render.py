"""``invgraphics render``: a film of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from invgraphics.cli.arguments import parse_size
from invgraphics.runs.folder import check_run


@dataclass(frozen=True)
class Render:
    """Film a finished run: around the scene, within the photographs' window, from one to the next, or the fit itself."""

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of a run."""
    out: Annotated[Path, arg(metavar="FILM.mp4")]
    """File to write."""
    path: Annotated[
        Literal["orbit", "spiral", "interpolate", "timelapse"] | None,
        arg(help_behavior_hint="(default: what suits the capture)"),
    ] = None
    """The camera's path: orbit where photographs surround the subject, spiral where they face one way, else interpolate from
    photograph to photograph. A timelapse stands still and shows the states that `fit --snapshots N` kept; of Gaussians also the
    ellipsoids."""
    frames: Annotated[int, arg(metavar="N")] = 90
    """Pictures of a path."""
    fps: Annotated[int, arg(metavar="N")] = 15
    """Pictures per second."""
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT|N", help_behavior_hint="(default: the run's own)")] = None
    """Size of the pictures; one number is the longest side."""
    view: Annotated[int, arg(metavar="N")] = 0
    """Test view that a timelapse shows."""
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: the run's own)")] = None
    """Another copy of the scene, for instance where the data set has moved."""

    def run(self) -> int:
        """Film; print the file."""
        size = None if self.size is None else parse_size(self.size)
        check_run(self.folder)

        from invgraphics.tools.film import FilmRequest, film

        print(film(FilmRequest(self.folder, self.out, self.path, self.frames, self.fps, size, self.view, self.scene)))
        return 0
