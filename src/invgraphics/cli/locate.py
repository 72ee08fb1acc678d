"""``invgraphics locate``: find the camera pose of a photograph of a fitted scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from invgraphics.cli.arguments import check_seed
from invgraphics.errors import InputError
from invgraphics.runs.folder import check_run


@dataclass(frozen=True, kw_only=True)
class Locate:
    """Find a photograph's pose by gradient descent through a fitted scene.

    The most promising of several starts are followed from coarse to fine pictures, and the one with the smallest difference
    wins. Writes the pose as JSON and, beside it, photograph, picture and difference as PNG.

    Attributes:
        folder: The folder of a run.
        photo: The photograph; it is cropped to the shape of the scene's pictures, unless --fov is given.
        near: Start at this training view: its number or name.
        start: Start at training views, or at random poses around them.
        starts: How many of the most promising starts are followed.
        steps: Steps of gradient descent of each start that is followed to the end.
        fov: Horizontal field of view of the photograph.
        seed: Seed of random starts.
        scene: Another copy of the scene, for instance where the data set has moved.
        out: File to write.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    photo: Annotated[Positional[Path], arg(metavar="PHOTO")]
    near: Annotated[str | None, arg(metavar="VIEW", help_behavior_hint="(default: compares all)")] = None
    start: Literal["views", "random"] = "views"
    starts: Annotated[int, arg(metavar="N")] = 4
    steps: Annotated[int, arg(metavar="N")] = 300
    fov: Annotated[float | None, arg(metavar="DEGREES", help_behavior_hint="(default: the scene's lens)")] = None
    seed: int = 0
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: the run's own)")] = None
    out: Annotated[Path | None, arg(metavar="FILE.json", help_behavior_hint="(default: PHOTO-located.json)")] = None

    def run(self) -> int:
        """Search; prints the pose, the loss, and the error where the pose is known. Returns exit status 0."""
        check_run(self.folder)
        out = Path(f"{self.photo.stem}-located.json") if self.out is None else self.out
        if out.suffix != ".json":
            raise InputError(f"--out cannot be '{out}'.", "Expected a file name that ends in .json.")

        from invgraphics.tools.localise import LocateRequest, locate

        options = (self.near, self.start, self.starts, self.steps, self.fov, self.scene, check_seed(self.seed))
        found = locate(LocateRequest(self.folder, self.photo, out, *options))
        print("camera to world, OpenCV axes:")
        for row in found.cam_to_world:
            print("  " + "  ".join(f"{value:9.5f}" for value in row))
        print(f"mean squared difference {found.loss:.6f}, {found.psnr:.2f} dB")
        if found.error is not None:
            print(
                f"the photograph is test view '{found.test_view}': off by {found.error.rotation_deg:.3f} degrees"
                f" and {found.error.translation_percent:.3f} per cent of the scene"
            )
        print(out)
        return 0
