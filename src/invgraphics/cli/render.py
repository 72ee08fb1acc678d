"""``invgraphics render``: film a run along a camera path, or its fit over time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

from tyro.conf import Positional, arg

from invgraphics.cli.arguments import parse_size, refuse_idle
from invgraphics.errors import InputError
from invgraphics.runs.folder import check_run

if TYPE_CHECKING:
    from invgraphics.tools.film import FilmPath

NAMES = ("orbit", "spiral", "interpolate", "timelapse")


@dataclass(frozen=True)
class Render:
    """Film a finished run: around the scene, within the photographs' window, from one to the next, or the fit itself."""

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of a run."""
    out: Annotated[Path, arg(metavar="FILM.mp4")]
    """File to write."""
    path: Annotated[
        str | None,
        arg(metavar="orbit|spiral|interpolate|timelapse|FILE.json", help_behavior_hint="(default: what suits the capture)"),
    ] = None
    """The camera's path: orbit where photographs surround the subject, spiral where they face one way, else interpolate from
    photograph to photograph; or a file that `invgraphics view` saved. A timelapse stands still and shows the states that
    `fit --snapshots N` kept; of Gaussians also the ellipsoids."""
    show: Literal["prediction", "depth", "normal"] = "prediction"
    """What the pictures show; depth in world units, which are printed, and in one range for all."""
    frames: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 90, or the duration of FILE.json)")] = None
    """Pictures of a path; a timelapse has one of each state."""
    fps: Annotated[int, arg(metavar="N")] = 15
    """Pictures per second."""
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT|N", help_behavior_hint="(default: the run's own)")] = None
    """Size of the pictures; one number is the longest side."""
    view: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0)")] = None
    """Test view that a timelapse shows; for --path timelapse only."""
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: the run's own)")] = None
    """Another copy of the scene, for instance where the data set has moved."""

    def run(self) -> int:
        """Render the film and print its path; returns exit status 0."""
        size = None if self.size is None else parse_size(self.size)
        path = parse_path(self.path)
        if path == "timelapse":
            refuse_idle({"--frames": self.frames}, "with --path timelapse, which has one picture of each state")
        else:
            refuse_idle({"--view": self.view}, "along a path", ", or add --path timelapse")
        check_run(self.folder)

        from invgraphics.tools.film import FilmRequest, film

        request = FilmRequest(self.folder, self.out, path, self.frames, self.fps, size, self.view or 0, self.scene, self.show)
        print(film(request))
        return 0


def parse_path(text: str | None) -> FilmPath | Path | None:
    """Parse the name of a camera path or the file of a saved one.

    Raises:
        InputError: neither.
    """
    if text is None or text in NAMES:
        return cast("FilmPath | None", text)
    if Path(text).suffix == ".json":
        return Path(text)
    raise InputError(
        f"--path cannot be '{text}'.", f"Expected {', '.join(NAMES)}, or a .json file saved by `invgraphics view`."
    )
