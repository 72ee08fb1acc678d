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
    """Film a finished run: around the scene, within the photographs' window, from one to the next, or the fit itself.

    Attributes:
        folder: The folder of a run.
        out: File to write.
        path: The camera's path: orbit where photographs surround the subject, spiral where they face one way, else interpolate
            from photograph to photograph; or a file that `invgraphics view` saved. A timelapse stands still and shows the
            states that `fit --snapshots N` kept; of Gaussians also the ellipsoids.
        show: What the pictures show; depth in world units, which are printed, and in one range for all.
        frames: Pictures of a path; a timelapse has one of each state.
        fps: Pictures per second.
        size: Size of the pictures; one number is the longest side.
        view: Test view that a timelapse shows; for --path timelapse only.
        scene: Another copy of the scene, for instance where the data set has moved.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    out: Annotated[Path, arg(metavar="FILM.mp4")]
    path: Annotated[
        str | None,
        arg(metavar="orbit|spiral|interpolate|timelapse|FILE.json", help_behavior_hint="(default: what suits the capture)"),
    ] = None
    show: Literal["prediction", "depth", "normal"] = "prediction"
    frames: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 90, or the duration of FILE.json)")] = None
    fps: Annotated[int, arg(metavar="N")] = 15
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT|N", help_behavior_hint="(default: the run's own)")] = None
    view: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 0)")] = None
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: the run's own)")] = None

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
