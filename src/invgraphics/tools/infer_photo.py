"""Inference of an instance of a class from one photograph, from a known or a given viewpoint."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from invgraphics.core import Camera, Conditional, Rendering, Scene, View
from invgraphics.core.transforms import look_at
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import display
from invgraphics.files import write_arrays, write_picture
from invgraphics.runs.folder import output_file
from invgraphics.scenes.pictures.images import read_pixels
from invgraphics.scenes.pictures.views import make_view
from invgraphics.tools.class_runs import open_class_runs
from invgraphics.tools.inference_pictures import shown_normals
from invgraphics.training.codes.inference import CodeInference, infer_codes
from invgraphics.training.localise import photometric_error

TURNS = 4
"""Pictures around the instance."""


@dataclass(frozen=True)
class PhotoRequest:
    """An instance in a photograph. Its camera has the class's lens, and is the one of ``view``, or looks at the middle of the
    class's box from ``azimuth`` and ``elevation``, at the training cameras' mean distance.

    Attributes:
        run: folder of a fit to a class.
        photo: the photograph; one without alpha shows the object in front of the scene's background. It is cropped to the
            shape of the class's pictures.
        out: picture to write, ``.png``; the code lies beside it, as ``.npz``.
        view: name of one of the class's views that shares the camera; ``None`` for the angles.
        azimuth: around the vertical axis, from +x towards +y, degrees.
        elevation: above the horizon, degrees.
        steps: of the inference.
        scene: another copy of the class.
    """

    run: Path
    photo: Path
    out: Path
    view: str | None = None
    azimuth: float = -60.0
    elevation: float = 25.0
    steps: int = CodeInference.steps
    scene: str | None = None

    def __post_init__(self) -> None:
        if self.out.suffix != ".png":
            raise InputError(f"--out cannot be '{self.out}'.", "Expected a file name that ends in .png.")
        if self.photo.resolve() == self.out.resolve():
            raise InputError(f"--out cannot be '{self.out}': the photograph would be overwritten.", "Choose another --out.")
        if self.code.exists() and not self.out.exists():
            raise InputError(f"--out cannot be '{self.out}': '{self.code}', beside it, exists.", "Choose another --out.")
        if not -90 < self.elevation < 90:
            raise InputError(f"--elevation cannot be {self.elevation:g}.", "Expected degrees between -90 and 90.")

    @property
    def code(self) -> Path:
        """File of the inferred code."""
        return self.out.with_suffix(".npz")


def infer_photo(request: PhotoRequest) -> float:
    """Infer the instance, draw it from its own viewpoint and from around; returns the PSNR of the photograph in dB.

    Raises:
        InputError: the run or the photograph cannot be used, or there is no such view.
    """
    pixels = read_pixels(request.photo)
    (fitted,) = open_class_runs([request.run], request.scene)
    scene, model = fitted.scene, fitted.model
    assert isinstance(model.field, Conditional)
    camera = _camera(request, scene)
    high, wide = pixels.shape[:2]
    width = min(wide, round(high * camera.width / camera.height))
    height = min(high, round(wide * camera.height / camera.width))
    left, top = (wide - width) // 2, (high - height) // 2
    cut = np.ascontiguousarray(pixels[top : top + height, left : left + width])
    photo = make_view(camera.resized(width, height), cut, request.photo.stem, (camera.width, camera.height))
    with output_file(request.out):
        (code,) = infer_codes(model, scene, [[photo]], CodeInference(steps=request.steps))
        inferred = replace(model, field=model.field.at(code))
        _draw(request.out, scene, photo, [inferred.render(one) for one in (camera, *_around(camera, scene))])
        write_arrays(request.code, {"code": code.cpu().numpy()})
    return -10 * math.log10(max(photometric_error(inferred, photo, scene), 1e-10))


def _camera(request: PhotoRequest, scene: Scene) -> Camera:
    lens = scene.train[0].camera
    if request.view is None:
        return lens.moved(_pose(scene, math.radians(request.azimuth), math.radians(request.elevation)))
    views = {view.name: view for view in (*scene.train, *scene.val, *scene.observed, *scene.test)}
    if request.view not in views:
        known = [view.name for view in scene.observed]
        raise InputError(f"'{scene.name}' has no view '{request.view}'.", f"Observed views: {known[0]} to {known[-1]}.")
    return views[request.view].camera


def _pose(scene: Scene, azimuth: float, elevation: float) -> Float[torch.Tensor, "4 4"]:
    """Pose on the training cameras' mean sphere around the box, looking at its middle."""
    positions = torch.stack([view.camera.position for view in scene.train])
    middle = scene.bounds.centre
    radius = float((positions - middle).norm(dim=1).mean())
    flat = math.cos(elevation)
    away = torch.tensor([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    return look_at(middle + radius * away, middle, torch.tensor([0.0, 0.0, 1.0]))


def _around(camera: Camera, scene: Scene) -> list[Camera]:
    """Cameras at the same elevation, a quarter of a turn apart, the first a quarter on."""
    away = camera.position - scene.bounds.centre
    elevation = math.asin(float(away[2] / away.norm()))
    azimuth = math.atan2(float(away[1]), float(away[0]))
    return [camera.moved(_pose(scene, azimuth + turn * 2 * math.pi / TURNS, elevation)) for turn in range(1, TURNS)]


def _draw(path: Path, scene: Scene, photo: View, pictures: Sequence[Rendering]) -> None:
    """Draw the photograph, then the instance from its viewpoint and from around; below them normals."""
    from PIL import Image

    shown = [photo.over(scene.background), *(picture.over(scene.background) for picture in pictures)]
    normals = [shown_normals(normal, shown[0]) for normal in (None, *(picture.normal for picture in pictures))]
    upper = torch.cat([display(one, scene) for one in shown], dim=1)
    lower = torch.cat([(one * 255).round().to(torch.uint8) for one in normals], dim=1)
    write_picture(path, Image.fromarray(torch.cat([upper, lower]).numpy()))
