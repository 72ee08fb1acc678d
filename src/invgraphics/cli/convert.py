"""``invgraphics convert``: make a run of another parameterisation of a finished one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from invgraphics.cli.output import show_table
from invgraphics.recipes.recipe import presets
from invgraphics.runs.folder import check_run
from invgraphics.tools import CONVERSION_SIZES

SIZES = ", ".join(f"{count} {what}" for count, what in CONVERSION_SIZES.values())
"""The default sizes in words, without commas in the numbers: help texts are wrapped there."""


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Convert a run's model to another kind of scene, score it, refit it briefly, and keep it as a run like any other.

    Attributes:
        folder: The folder of a run.
        to: What to make: Gaussians or neural points on the surfaces that training views see; a voxel grid of density and
            spherical harmonics; the mesh of an isosurface; or a multi-plane image, for scenes seen from one side. All but
            Gaussians and points need a density, or a mesh a distance.
        out: Folder of the new run.
        method: Method whose field is made, and which refits it.
        refit: Budget of the refit.
        size: Gaussians and points: how many. Lattice: vertices along the longest edge. Mesh: voxels along the longest edge of
            the grid that the surface is extracted from.
        overrides: Change one value of the method's recipe.
        seed: Seed of the sampling and of the refit.
        scene: Another copy of the scene, for instance where the data set has moved.
        kernels: Force an implementation of the hot operations: numba, reference (plain torch), or cuda with --device cuda.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    to: Annotated[str, arg(metavar="gaussians|lattice|mesh|mpi|points")]
    out: Annotated[Path, arg(metavar="RUN2")]
    method: Annotated[str, arg(metavar="METHOD", help_behavior_hint="(default: one that suits the target)")] = ""
    refit: Annotated[str, arg(metavar="10s|500steps")] = "10s"
    size: Annotated[int | None, arg(metavar="N", help_behavior_hint=f"(default: {SIZES})")] = None
    overrides: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE")] = ()
    seed: int = 0
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: the run's own)")] = None
    kernels: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="(default: the fastest here)")] = None

    def run(self) -> int:
        """Convert, refit and score; prints the three scores and the new folder. Returns exit status 0."""
        if self.method:
            presets(self.method)  # refuses an unknown method before torch is imported
        check_run(self.folder)

        from invgraphics.tools.convert import ConvertRequest, convert_run

        done = convert_run(
            ConvertRequest(
                run=self.folder,
                to=self.to,
                out=self.out,
                method=self.method,
                refit=self.refit,
                size=self.size,
                overrides=tuple(self.overrides),
                seed=self.seed,
                scene=self.scene,
                kernels=self.kernels,
            )
        )
        columns = (
            (f"{done.native.method}", done.native),
            ("converted", done.converted),
            (f"after {self.refit}", done.refitted),
        )
        rows = [
            (metric, *(_value(scores.quality[metric].mean) for _, scores in columns), quality.unit)
            for metric, quality in done.refitted.quality.items()
            if all(metric in scores.quality for _, scores in columns)
        ]
        rows.append(("size", *(_megabytes(scores.cost.get("model_bytes")) for _, scores in columns), "MB"))
        show_table(f"Converted {self.folder} to {self.to}", ("metric", *(name for name, _ in columns), "unit"), rows)
        print(done.folder.root)
        return 0


def _value(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _megabytes(value: float | None) -> str:
    return "-" if value is None else f"{value / 1e6:.3g}"
