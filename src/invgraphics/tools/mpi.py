"""Export of a run's model as a multi-plane image, with what that loses against the run's own pictures."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from invgraphics.core import Camera, Context, Planes, Quantity, Scene
from invgraphics.core.planes import WIDEST, widest_angle
from invgraphics.core.transforms import apply_similarity
from invgraphics.errors import InputError
from invgraphics.experiments.fitted import Fitted
from invgraphics.experiments.progress import Reporter
from invgraphics.fields.planes import FixedPlanes, PlanesConfig
from invgraphics.fields.slicing import slice_density
from invgraphics.formats.mpi import PlaneFile, read_mpi, write_mpi
from invgraphics.renderers.planes import PlaneRenderer
from invgraphics.tools.export import PLANES, Exported, ExportRequest, decibels


def export_mpi(fitted: Fitted, request: ExportRequest) -> Exported:
    """Write the model's planes, or slices of its density before a reference camera, in world coordinates.

    The reference camera is the mean of the training cameras where they look one way, else that of the view ``request.view``.

    Raises:
        InputError: the model has neither planes nor density, or a reference camera must be named.
    """
    scene = fitted.scene
    planes, how = planes_of(fitted, request)
    plain = replace(planes, coefficients=None, basis=None)
    note = f"invgraphics: {fitted.method.name} on {scene.name}, in the data set's world; {how}"
    write_mpi(request.out, PlaneFile(moved(plain, scene.world_from_local, scene.scale), scene.colour, note))
    back = moved(read_mpi(request.out).planes, torch.linalg.inv(scene.world_from_local.double()).float(), 1 / scene.scale)
    facts = {
        "planes": f"{len(planes)} of {planes.camera.width} x {planes.camera.height} texels",
        "depths": f"{float(planes.depths[0]) * scene.scale:.4g} to {float(planes.depths[-1]) * scene.scale:.4g} world units",
        "made of": how,
        "bytes": str(request.out.stat().st_size),
    }
    if planes.coefficients is not None:
        facts["left out"] = "view dependence, which the format does not have"
    if request.view is None:
        facts["PSNR to the run's own pictures"] = decibels(_psnr(fitted, back, [view.camera for view in scene.test]))
    else:
        facts["PSNR to the run's own picture"] = (
            f"{decibels(_psnr(fitted, back, [_named(scene, request.view)]))}, from {request.view}"
        )
    return Exported(request.out, facts)


def planes_of(fitted: Fitted, request: ExportRequest) -> tuple[Planes, str]:
    """A run's own planes, or slices of its density; and how they were made, in words.

    Raises:
        InputError: as `export_mpi`.
    """
    model, scene = fitted.model, fitted.scene
    if Quantity.PLANES in model.field.provides:
        given = {"--planes": request.planes, "--view": request.view}
        if idle := [option for option, value in given.items() if value is not None]:
            sentence = f"The model of '{request.run}' ({fitted.method.name}) has planes of its own."
            raise InputError(sentence, f"Leave {' and '.join(idle)} out.")
        with torch.no_grad():
            own: Planes = model.field.primitives(Quantity.PLANES, model.context())
        stored = {name: getattr(own, name).cpu() for name in ("depths", "rgb", "alpha")}
        return replace(own, camera=own.camera.to("cpu"), **stored), "the run's own planes"
    if Quantity.DENSITY | Quantity.RADIANCE not in model.field.provides:
        raise InputError(
            f"The model of '{request.run}' ({fitted.method.name}) has no density that could be sliced.",
            "Runs of volumetric methods, of Gaussians and of planes can be written as a multi-plane image.",
        )
    config = PlanesConfig(count=request.planes or PLANES)
    if request.view is not None:
        scene = scene.with_views(train=tuple(view for view in scene.train if view.name == request.view))
        if not scene.train:
            raise InputError(f"Scene '{scene.name}' has no training view '{request.view}'.", "Names are those of its files.")
    elif widest_angle([view.camera for view in scene.train]) > WIDEST:
        raise InputError(
            f"The cameras of scene '{scene.name}' look all ways, so that none of them is the reference of a multi-plane image.",
            f"Name one with --view, for instance {scene.train[0].name}.",
        )
    camera, depths = config.placed(scene)
    return slice_density(model.field, camera, depths, model.bounds), f"density in slabs around {len(depths)} planes"


def moved(planes: Planes, similarity: torch.Tensor, scale: float) -> Planes:
    """Planes in another frame."""
    camera = planes.camera.to(torch.float64)
    camera = camera.moved(apply_similarity(similarity.double(), camera.cam_to_world)).to(planes.camera.focal.dtype)
    return replace(planes, camera=camera, depths=planes.depths * scale)


def _named(scene: Scene, name: str) -> Camera:
    return next(view.camera for view in scene.train if view.name == name)


def _psnr(fitted: Fitted, planes: Planes, cameras: list[Camera]) -> list[float]:
    """PSNR in dB between pictures of the planes and of the model; infinite where equal."""
    background, context, psnr = fitted.scene.background, Context(fitted.scene.bounds), []
    with Reporter("comparing") as reporter, torch.no_grad():
        for index, camera in enumerate(cameras):
            ours = PlaneRenderer().render_image(FixedPlanes(planes), camera, context)[0].over(background)
            error = float((ours - fitted.model.render(camera, normals=False).over(background)).square().mean())
            psnr.append(-10 * math.log10(error) if error else math.inf)
            reporter.show((index + 1) / len(cameras), f"view {index + 1} of {len(cameras)}")
    return psnr
