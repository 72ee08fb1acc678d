"""``invgraphics export``: write a run's model as a file for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from invgraphics import plugins
from invgraphics.cli.arguments import refuse_idle
from invgraphics.cli.output import show_table
from invgraphics.errors import InputError, did_you_mean
from invgraphics.runs.folder import check_run
from invgraphics.tools import EXPORTERS

FOR = {
    "world": ("spz", "mesh"),
    "level": ("mesh",),
    "resolution": ("mesh",),
    "sh_degree": ("ply", "spz"),
    "planes": ("mpi",),
    "view": ("mpi",),
    "spz_version": ("spz",),
}
"""Option -> what can be written that it does something for; exporters of other packages may take any."""
IN_THE_WORLD = (".ply", ".obj")
"""Meshes that are written in the data set's world, whose axes do not matter."""


@dataclass(frozen=True)
class Export:
    """Write a run's model, in the coordinates of the data set's world, as a file that other programs read.

    Files of Gaussians are read back and rendered from the run's test cameras, to report the loss as PSNR.

    Attributes:
        folder: The folder of a run.
        to: What to write: of Gaussians ply (3DGS's own, without loss), splat (32 bytes per Gaussian, no view dependence) or spz
            (smallest); of any model mesh, a surface with coloured vertices as GLB, PLY or OBJ; of planes and densities mpi, a
            zip archive of PNG layers and their JSON description.
        out: The file to write; one that exists is replaced. Its ending is the format's (.ply, .splat, .spz); a mesh is written
            as its ending says: .glb, .ply or .obj.
        scene: Another copy of the scene, for instance where the data set has moved.
        world: Where the world's +x, +y, +z point, for formats that want certain axes (spz, glb: right, up, back): opencv is
            right, down, forward; opengl right, up, back; z-up right, forward, up. Built-in and Blender scenes are z-up.
        level: For mesh: the density per local unit (or the signed distance) of the surface; Gaussians have none.
        resolution: For mesh: voxels along the longest edge of the scene's box.
        sh_degree: For ply and spz: degree of the spherical harmonics in the file; bands that the run does not have are zeros.
        planes: For mpi of a density: number of planes that it is sliced into, evenly spaced in inverse depth.
        view: For mpi of a density: training view whose camera is the reference.
        spz_version: For spz: version of the format; many viewers read up to 3 only.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    to: Annotated[str, arg(metavar="NAME")]
    out: Annotated[Path, arg(metavar="FILE")]
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: the run's own)")] = None
    world: Annotated[
        str | None, arg(metavar="opencv|opengl|z-up|RDF", help_behavior_hint="(default: opencv; for glb z-up)")
    ] = None
    level: Annotated[float | None, arg(metavar="X", help_behavior_hint="(default: alpha 1/2 in 1% of the scene)")] = None
    resolution: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 192)")] = None

    sh_degree: Annotated[
        int | None, arg(metavar="0..3", help_behavior_hint="(default: ply 3, as most loaders insist; else the run's own)")
    ] = None
    planes: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 32)")] = None
    view: Annotated[
        str | None, arg(metavar="NAME", help_behavior_hint="(default: the mean of all, where they look one way)")
    ] = None
    spz_version: Annotated[int | None, arg(metavar="3|4", help_behavior_hint="(default: 4)")] = None

    def run(self) -> int:
        """Write the file and print facts about it; returns exit status 0."""
        known = plugins.names("exporters")
        if self.to not in known:
            raise InputError(
                f"--to cannot be '{self.to}'.{did_you_mean(self.to, known)}", f"Expected one of: {', '.join(known)}."
            )
        given = {name: getattr(self, name) for name in FOR if getattr(self, name) is not None}
        self._refuse_idle(given)
        check_run(self.folder)

        from invgraphics.tools.export import ExportRequest, export_run

        exported = export_run(ExportRequest(self.folder, self.to, self.out, self.scene, **given))
        show_table(f"Exported {self.folder} as {self.to}", ("fact", "value"), exported.facts.items())
        print(exported.path)
        return 0

    def _refuse_idle(self, given: Mapping[str, Any]) -> None:
        """Refuse options that belong to other formats; a degree of 0 is that of a format without view dependence."""
        if self.to not in EXPORTERS:
            return
        for name, value in given.items():
            if self.to not in FOR[name] and not (name == "sh_degree" and value == 0 and self.to == "splat"):
                refuse_idle({option(name): value}, f"with --to {self.to}", f": it is for --to {' and '.join(FOR[name])}")
        if self.to == "mesh" and self.out.suffix.lower() in IN_THE_WORLD:
            why = f"in a mesh that ends in {self.out.suffix}, which is written as the data set's world has it"
            refuse_idle({"--world": self.world}, why)


def option(name: str) -> str:
    """Option of the command line that sets a field of a command."""
    return f"--{name.replace('_', '-')}"
