"""``invgraphics import``: make a run of a file of Gaussians that was trained elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from invgraphics.cli.arguments import parse_size, parse_views
from invgraphics.cli.output import show_scores
from invgraphics.errors import InputError
from invgraphics.recipes.recipe import presets


@dataclass(frozen=True, kw_only=True)
class ImportFile:
    """Make a run of a file of 3D Gaussians that any tool trained, then render and score its test views like any other run's.

    Attributes:
        file: A .ply of 3DGS, a compressed .ply, a .splat or a .spz (see `invgraphics list model-formats`).
        scene: The scene that it was trained on: built-in, or the path of a data set.
        out: Folder of the run.
        method: A method of Gaussians, whose renderer shows the model.
        overrides: Change one value of the recipe, for instance --set renderer.dilation=0.1.
        frame: Where the file's +x, +y, +z point: opencv is right, down, forward; opengl right, up, back; z-up right, forward,
            up; or three letters. Files that do not say (all but spz) are taken to be in the data set's world.
        world: Where the axes of the data set's world point, for files with certain axes; opencv fits what converters write.
        transform: Similarity from the data set's world to the file's frame: the dataparser_transforms.json that nerfstudio
            writes beside its models (`transform`, 3 x 4, and `scale`), which its exported splats have had.
        size: Size of the pictures; one number is the longest side.
        test_views: How many test views are scored: of a built-in scene the first N, which are evenly distributed; of a data set
            N evenly spaced ones.
        device: Device that computes.
        kernels: Force an implementation of the hot operations: numba, reference (plain torch), or cuda with --device cuda.
        protocol: How pictures are scored: default (rounded to 8 bits), or float.
    """

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    scene: Annotated[str, arg(metavar="SCENE")]
    out: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint="(default: runs/SCENE-FILE)")] = None
    method: Annotated[str, arg(metavar="METHOD")] = "splatting/gaussians"
    overrides: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE")] = ()
    frame: Annotated[str | None, arg(metavar="opencv|opengl|z-up|RDF", help_behavior_hint="(default: as the file says)")] = None
    world: Annotated[str, arg(metavar="opencv|opengl|z-up|RDF")] = "opencv"
    transform: Annotated[str | None, arg(metavar="FILE.json", help_behavior_hint="(default: the same frame)")] = None
    size: Annotated[str | None, arg(metavar="WIDTHxHEIGHT|N", help_behavior_hint="(default: the scene's own)")] = None
    test_views: Annotated[str, arg(metavar="N|all")] = "16"
    device: Annotated[str | None, arg(metavar="cpu|cuda", help_behavior_hint="(default: cpu)")] = None
    kernels: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: the fastest here)")] = None
    protocol: Annotated[str, arg(metavar="NAME")] = "default"

    def run(self) -> int:
        """Import and evaluate the file; prints scores and run folder. Returns exit status 0."""
        size = None if self.size is None else parse_size(self.size)
        views = parse_views(self.test_views)
        presets(self.method)  # refuses an unknown method before torch is imported
        if not self.file.is_file():
            raise InputError(f"There is no file '{self.file}'.")

        from invgraphics.experiments.request import FitRequest
        from invgraphics.runs.folder import RunFolder
        from invgraphics.tools.import_gaussians import ImportRequest, import_run

        out = self.out or Path("runs") / f"{Path(self.scene).resolve().name}-{self.file.name}"
        run = FitRequest(
            scene=self.scene,
            out=str(out),
            method=self.method,
            overrides=tuple(self.overrides),
            size=size,
            test_views=views,
            device=self.device,
            kernels=self.kernels,
            protocol=self.protocol,
        )
        request = ImportRequest(file=str(self.file), run=run, frame=self.frame, world=self.world, transform=self.transform)
        folder = import_run(request)
        show_scores(RunFolder(folder).read_scores())
        print(folder)
        return 0
