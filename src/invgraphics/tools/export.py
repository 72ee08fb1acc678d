"""Export of a run's model to files of other programs, with a report of what the file format loses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from invgraphics import plugins
from invgraphics.core import Camera, Gaussians, Quantity, Renderer, harmonics
from invgraphics.errors import InputError
from invgraphics.experiments.fitted import Fitted, open_fitted
from invgraphics.experiments.progress import Reporter
from invgraphics.fields.gaussian import FixedGaussians
from invgraphics.fields.similarity import transform_gaussians
from invgraphics.formats.base import ANTIALIASED, DILATION, Splats, read_gaussians, write_gaussians
from invgraphics.formats.spz import WRITTEN
from invgraphics.renderers.splatting import FLATNESS, Splatting, SplattingConfig
from invgraphics.runs.folder import output_file
from invgraphics.tools.file_frames import WORLD, file_from_local, local_from_file

RESOLUTION, RESOLUTIONS = 192, (8, 512)
"""Voxels along a mesh's longest edge: usual, fewest and most (for which fused pictures take 6 GB of memory)."""
PLANES, PLANES_RANGE = 32, (2, 512)
"""Planes of a multi-plane image: usual, fewest and most."""


@dataclass(frozen=True)
class ExportRequest:
    """What to write.

    Attributes:
        run: folder of the run.
        to: a name in `invgraphics.tools.EXPORTERS`.
        out: the file.
        scene: another copy of the run's scene.
        world: how the axes of the data set's world point, for formats that want certain axes; ``None`` for the
            format's default.
        level: density or signed distance of a mesh's surface; ``None`` for the default.
        resolution: voxels along the longest edge that a mesh is made from; ``None`` for `RESOLUTION`.
        sh_degree: degree of the spherical harmonics that are written, zeros where the run has fewer bands; ``None`` for what
            readers of the format expect: 3 for PLY, elsewhere the run's own.
        planes: number of planes that a density is sliced into; ``None`` for `PLANES`.
        view: training view whose camera is the reference of a multi-plane image; ``None`` for the mean of all.
        spz_version: of an SPZ file, 3 or 4; ``None`` for 4.
    """

    run: Path
    to: str
    out: Path
    scene: str | None = None
    world: str | None = None
    level: float | None = None
    resolution: int | None = None
    sh_degree: int | None = None
    planes: int | None = None
    view: str | None = None
    spz_version: int | None = None

    def __post_init__(self) -> None:
        low, high = PLANES_RANGE
        if self.planes is not None and not low <= self.planes <= high:
            raise InputError(f"--planes cannot be {self.planes}.", f"Expected {low} to {high}.")
        if self.sh_degree is not None and not 0 <= self.sh_degree <= harmonics.MAX_DEGREE:
            raise InputError(f"--sh-degree cannot be {self.sh_degree}.", f"Expected 0 to {harmonics.MAX_DEGREE}.")
        if self.spz_version is not None and self.spz_version not in WRITTEN:
            raise InputError(f"--spz-version cannot be {self.spz_version}.", f"Expected {' or '.join(map(str, WRITTEN))}.")
        low, high = RESOLUTIONS
        if self.resolution is not None and not low <= self.resolution <= high:
            raise InputError(f"--resolution cannot be {self.resolution}.", f"Expected a number of voxels, {low} to {high}.")


@dataclass(frozen=True)
class Exported:
    """Result of an export: the file, and facts about it, name -> value in words."""

    path: Path
    facts: dict[str, str]


def export_run(request: ExportRequest) -> Exported:
    """Export a run's model as the request says; returns the file and facts about it.

    Raises:
        InputError: the run cannot be opened, its model cannot be written in this way, or the file cannot be written.
    """
    fitted = open_fitted(request.run, request.scene).in_its_frame()
    with output_file(request.out):
        return plugins.load("exporters", request.to)(fitted, request)


def export_gaussians(fitted: Fitted, request: ExportRequest) -> Exported:
    """Write a run's Gaussians in world coordinates, and compare renderings of the file with the run's.

    Raises:
        InputError: the model has no Gaussians, or they do not fit into the format.
    """
    if Quantity.GAUSSIANS not in fitted.model.field.provides:
        raise InputError(
            f"The model of '{request.run}' ({fitted.method.name}) has no Gaussians to write as {request.to}.",
            f"Runs of splatting methods have some; or make them: invgraphics convert {request.run} --to gaussians --out RUN.",
        )
    scene = fitted.scene
    axes = plugins.load("formats", request.to).axes
    local = on_cpu(fitted.model.gaussians())
    world = request.world or WORLD
    placed = on_cpu(transform_gaussians(_solid(local, fitted), file_from_local(scene, axes, world).float()))
    expected = getattr(plugins.load("formats", request.to), "sh_degree", None)
    placed = with_degree(placed, expected if request.sh_degree is None else request.sh_degree)
    shown = "" if scene.colour == "srgb" else f"; colours are {scene.colour}, not display sRGB"
    viewer = splatter_of(fitted)
    antialiased, dilation = viewer.config.antialiased, viewer.config.dilation
    flagged = getattr(plugins.load("formats", request.to), "flags_antialiasing", False)
    shown += f"; {ANTIALIASED}" if antialiased else ""
    filtered = dilation != SplattingConfig.dilation
    shown += f"; {DILATION}{dilation:g}" if filtered else ""
    note = f"invgraphics: {fitted.method.name} on {scene.name}, in the axes of the data set's world{shown}"
    settings = {} if request.spz_version is None else {"version": request.spz_version}
    write_gaussians(request.out, request.to, Splats(placed, axes, antialiased, (note,)), **settings)

    _, written = read_gaussians(request.out)
    back = transform_gaussians(written.gaussians, local_from_file(scene, written.axes, world).float())
    loss = psnr_between(*(on_device(each, fitted.model.device) for each in (local, back)), fitted=fitted, viewer=viewer)
    degree = harmonics.degree_of(written.gaussians.sh.shape[1])
    had = harmonics.degree_of(local.sh.shape[1])
    return Exported(
        request.out,
        {
            "Gaussians": str(len(written.gaussians)),
            "bytes": str(request.out.stat().st_size),
            "SH degree": str(degree) if degree == had else f"{degree} (the run has {had})",
            "axes": axes or "the data set's world",
            **({"opacity compensation": "must be on where it is shown"} if antialiased and not flagged else {}),
            **({"2D filter": f"{dilation:g} px² where it is shown, not {SplattingConfig.dilation:g}"} if filtered else {}),
            **_drawn_by(viewer, fitted),
            "PSNR to the run's own pictures": decibels(loss),
        },
    )


def with_degree(gaussians: Gaussians, degree: int | None) -> Gaussians:
    """Pad with zeros or truncate the Gaussians' spherical harmonics to ``degree``; ``None`` changes nothing."""
    if degree is None:
        return gaussians
    wanted, (count, have, _) = harmonics.count(degree), gaussians.sh.shape
    sh = torch.cat([gaussians.sh[:, :wanted], gaussians.sh.new_zeros(count, max(0, wanted - have), 3)], dim=1)
    return replace(gaussians, sh=sh)


def splatter_of(fitted: Fitted) -> Splatting:
    """The run's renderer, where it splats ellipsoids; else what viewers draw files with, of the run's 2D filter."""
    renderer = fitted.model.renderer
    if isinstance(renderer, Splatting) and not renderer.config.flat:
        return renderer
    config = SplattingConfig(dilation=renderer.config.dilation) if isinstance(renderer, Splatting) else SplattingConfig()
    return config.build(fitted.scene)


def _solid(gaussians: Gaussians, fitted: Fitted) -> Gaussians:
    """The run's Gaussians as ellipsoids: of discs, whose third scale is not drawn, that one is made negligible."""
    renderer = fitted.model.renderer
    if not (isinstance(renderer, Splatting) and renderer.config.flat):
        return gaussians
    third = FLATNESS * gaussians.scales[:, :2].amin(dim=1, keepdim=True)
    return replace(gaussians, scales=torch.cat([gaussians.scales[:, :2], third], dim=1))


def _drawn_by(viewer: Splatting, fitted: Fitted) -> dict[str, str]:
    """The fact that the file is drawn otherwise than the run, where it is."""
    if viewer is fitted.model.renderer:
        return {}
    return {"drawn by": f"plain splatting, as in viewers ({viewer.config.dilation:g} px²), not by the run's renderer"}


def psnr_between(gaussians: Gaussians, others: Gaussians, fitted: Fitted, viewer: Renderer) -> list[float]:
    """PSNR in dB, for each test view, between a run's Gaussians and a file's; infinite where equal.

    Args:
        gaussians: drawn by the run's own renderer.
        others: drawn by ``viewer``.
        fitted: the run.
        viewer: renderer of the file.
    """
    pairs = (gaussians, fitted.model.renderer), (others, viewer)
    psnr = []
    with Reporter("comparing") as reporter:
        for index, view in enumerate(fitted.scene.test):
            ours, theirs = (render_gaussians(each, renderer, fitted, view.camera) for each, renderer in pairs)
            error = float((ours - theirs).square().mean())
            psnr.append(-10 * math.log10(error) if error else math.inf)
            reporter.show((index + 1) / len(fitted.scene.test), f"view {index + 1} of {len(fitted.scene.test)}")
    return psnr


def render_gaussians(gaussians: Gaussians, renderer: Renderer, fitted: Fitted, camera: Camera) -> Tensor:
    """Render Gaussians in a run's scene: colours over its background, in [0, 1], (height, width, 3)."""
    picture = replace(fitted.model, field=FixedGaussians(gaussians), renderer=renderer).render(camera, normals=False)
    return picture.over(fitted.scene.background).clamp(0, 1)


def decibels(values: list[float]) -> str:
    """Format the PSNR of the mean squared error and the lowest of several PSNRs (dB, infinite without error) in words."""
    if math.isinf(min(values)):
        return "equal"
    error = sum(10 ** (-value / 10) for value in values) / len(values)
    return f"{-10 * math.log10(error):.1f} dB on average over {len(values)} test views, {min(values):.1f} dB at worst"


def on_device(gaussians: Gaussians, device: torch.device) -> Gaussians:
    """Detach all tensors and move them to a device."""
    names = ("means", "quaternions", "scales", "opacities", "sh")
    return replace(gaussians, **{name: getattr(gaussians, name).detach().to(device) for name in names})


def on_cpu(gaussians: Gaussians) -> Gaussians:
    """Detach all tensors and move them to the CPU."""
    return on_device(gaussians, torch.device("cpu"))
