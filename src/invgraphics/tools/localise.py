"""Camera localisation: a photograph's pose by gradient descent in a fitted scene, from several starts, coarse to fine."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8

from invgraphics.core import Camera, Scene, View
from invgraphics.core.transforms import apply_similarity, focal_from_fov, se3_exp
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import display
from invgraphics.experiments.fitted import Fitted, open_fitted
from invgraphics.experiments.posed import transform_camera, world_to_fit
from invgraphics.experiments.progress import Reporter, warn
from invgraphics.files import write_picture
from invgraphics.metrics.poses import Similarity, rotation_angle
from invgraphics.runs.folder import output_file
from invgraphics.runs.location import Location, PoseError, Start
from invgraphics.scenes.pictures.images import read_pixels
from invgraphics.scenes.pictures.views import make_view
from invgraphics.training.localise import PoseDescent, photometric_error, refine_pose

COARSEST = 32
"""Longest side in pixels at which all starts are compared."""
LEVELS = ((0.25, 0.5, 2e-2, 4e-3), (0.5, 0.25, 6e-3, 1e-3), (1.0, 0.25, 2e-3, 1e-4))
"""Image scale, share of the steps, learning rate at the start and at the end, of each round."""
SPREAD = 10.0
"""Of random starts around the training views: degrees, and per cent of the scene's extent."""
SAME = 2.5
"""Mean difference in 8-bit steps up to which the photograph is taken for one of the test views."""


@dataclass(frozen=True)
class LocateRequest:
    """Photograph to localise, and where the search begins.

    Attributes:
        run: folder of the fit.
        photo: the photograph's file.
        out: JSON file to write; the pictures lie beside it, as ``.png``.
        near: training view to start from, by name or number; ``None`` compares all.
        start: ``views`` begins at training views, ``random`` at random poses around them.
        starts: how many of the most promising starts are followed.
        steps: of gradient descent, over all scales.
        fov: horizontal field of view of the photograph in degrees; ``None`` takes the scene's lens.
        scene: another copy of the run's scene.
        seed: of random starts.
    """

    run: Path
    photo: Path
    out: Path
    near: str | None = None
    start: Literal["views", "random"] = "views"
    starts: int = 4
    steps: int = 300
    fov: float | None = None
    scene: str | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.starts < 1 or self.steps < 1:
            raise InputError("--starts and --steps must be at least 1.")
        if self.fov is not None and not 1 <= self.fov <= 170:
            raise InputError(f"--fov cannot be {self.fov:g}.", "Expected the horizontal field of view in degrees, 1 to 170.")
        if self.photo.resolve() in (self.out.resolve(), self.pictures.resolve()):
            raise InputError(f"--out cannot be '{self.out}': the photograph would be overwritten.", "Choose another --out.")

    @property
    def pictures(self) -> Path:
        """File of the pictures that compare the photograph with the start and the result."""
        return self.out.with_suffix(".png")


def locate(request: LocateRequest) -> Location:
    """Estimate a photograph's camera pose in a fitted scene; writes and returns the location, with comparison pictures.

    Raises:
        InputError: the run or the photograph cannot be used, there is no such view, or the files cannot be written.
    """
    pixels = read_pixels(request.photo)  # before the run is opened, which takes longer
    fitted = open_fitted(request.run, request.scene)
    views = fitted.scene.train + fitted.scene.test
    if own := [view.camera for view in views if Path(view.name).name in (request.photo.name, request.photo.stem)]:
        pixels = read_pixels(request.photo, (own[0].width, own[0].height))  # the data set's own: as its pictures were read
    with output_file(request.out):
        return _locate(request, pixels, fitted)


def _locate(request: LocateRequest, pixels: UInt8[np.ndarray, "h w c"], fitted: Fitted) -> Location:
    drift = Similarity(1.0, torch.eye(3).double(), torch.zeros(3).double())
    if fitted.poses is not None:
        drift = world_to_fit(fitted.poses, fitted.scene)
    if request.fov is None and "undistortion" in fitted.scene.notes:
        warn("The scene's photographs were straightened; this one is taken as it is, as if by the lens of theirs.")
    photo = _photo(pixels, request, fitted.scene)
    starts = [replace(photo, camera=photo.camera.moved(pose)) for pose in _starts(request, fitted.scene)]
    with Reporter(f"locate {request.photo.name}") as reporter:
        found, tried = _search(
            fitted, [replace(v, camera=transform_camera(v.camera, drift)) for v in starts], request, reporter
        )
    return _location_record(request, fitted, found, tried, drift.inverse())


def _photo(pixels: UInt8[np.ndarray, "h w c"], request: LocateRequest, scene: Scene) -> View:
    """Read the photograph as a view of the scene's size, with intrinsics but no pose.

    With the scene's own lens it is cropped to the shape of the scene's pictures; with a field of view it keeps its shape.
    """
    lens = scene.train[0].camera
    height, width = pixels.shape[:2]
    if request.fov is None:
        wide = min(width, round(height * lens.width / lens.height))
        high = min(height, round(width * lens.height / lens.width))
        left, top = (width - wide) // 2, (height - high) // 2
        pixels = np.ascontiguousarray(pixels[top : top + high, left : left + wide])
        camera = lens.resized(wide, high)
    else:
        focal = focal_from_fov(math.radians(request.fov), width)
        camera = Camera(lens.cam_to_world, torch.full((2,), focal), torch.tensor([width / 2, height / 2]), width, height)
    longest = max(lens.width, lens.height)
    if max(pixels.shape[:2]) < COARSEST // 4:
        raise InputError(f"{request.photo} is too small to be located ({width}x{height}).")
    return make_view(camera, pixels, request.photo.stem, longest)


def _starts(request: LocateRequest, scene: Scene) -> list[torch.Tensor]:
    """Initial poses of the search, in the scene's frame."""
    poses = [view.camera.cam_to_world for view in scene.train]
    if request.near is not None:
        names = [view.name for view in scene.train]
        index = names.index(request.near) if request.near in names else -1
        if index < 0 and request.near.isdecimal() and int(request.near) < len(names):
            index = int(request.near)
        if index < 0:
            raise InputError(
                f"There is no training view '{request.near}'.", f"Expected a number, 0 to {len(names) - 1}, or a view's name."
            )
        poses = [poses[index]]
    if request.start == "random":
        generator = torch.Generator().manual_seed(request.seed)
        size = torch.tensor([math.radians(SPREAD)] * 3 + [scene.extent * SPREAD / 100] * 3)
        repeated = poses * math.ceil(max(2 * request.starts, len(poses)) / len(poses))
        poses = [pose @ se3_exp(size * torch.randn(6, generator=generator)) for pose in repeated]
    return poses


def _search(fitted: Fitted, starts: list[View], request: LocateRequest, reporter: Reporter) -> tuple[View, list[Start]]:
    """Optimise poses in coarse-to-fine rounds, each keeping the better half; returns the best view, and all starts' results."""
    model, scene = fitted.model, fitted.scene
    coarse = min(1.0, COARSEST / max(starts[0].camera.width, starts[0].camera.height))
    losses = [photometric_error(model, view, scene, coarse) for view in starts]
    order = sorted(range(len(starts)), key=losses.__getitem__)[: request.starts]
    kept = [(starts[i], i) for i in order]
    rounds: dict[int, dict[str, float]] = {i: {} for i in order}
    for number, (scale, share, lr, final) in enumerate(LEVELS):
        fine = max(scale, coarse)
        descent = PoseDescent(max(1, round(request.steps * share)), lr, final, fine)
        kept = [(replace(view, camera=refine_pose(model, view, scene, descent)), i) for view, i in kept]
        ranked = sorted((photometric_error(model, view, scene, fine), place) for place, (view, _) in enumerate(kept))
        for loss, place in ranked:
            rounds[kept[place][1]][f"{fine:g}"] = loss
        kept = [kept[place] for _, place in ranked[: max(1, len(ranked) // 2)]]
        reporter.show((number + 1) / len(LEVELS), f"round {number + 1}, loss {ranked[0][0]:.5f}")
    return kept[0][0], [Start(start=i, loss_at_start=losses[i], rounds=rounds[i]) for i in order]


def _location_record(request: LocateRequest, fitted: Fitted, found: View, tried: list[Start], back: Similarity) -> Location:
    scene = fitted.scene
    loss = photometric_error(fitted.model, found, scene)
    pose = transform_camera(found.camera, back).cam_to_world
    truth, error = _test_view_like(found, scene), None
    if truth is not None:
        turn = rotation_angle(pose[:3, :3], truth.camera.cam_to_world[:3, :3])
        shift = (pose[:3, 3] - truth.camera.position).norm()
        error = PoseError(rotation_deg=float(turn), translation_percent=100 * float(shift) / scene.extent)
    first, second, third, last = (tuple(row) for row in apply_similarity(scene.world_from_local, pose).tolist())
    fx, fy = found.camera.focal.tolist()
    record = Location(
        photo=str(request.photo),
        run=str(request.run),
        method=fitted.method.name,
        cam_to_world=(first, second, third, last),
        focal=(fx, fy),
        size=(found.camera.width, found.camera.height),
        loss=loss,
        psnr=-10 * math.log10(max(loss, 1e-10)),
        starts=tuple(tried),
        test_view=None if truth is None else truth.name,
        error=error,
    )
    record.write(request.out)
    _draw(request.pictures, fitted, found)
    return record


def _test_view_like(found: View, scene: Scene) -> View | None:
    """Find the test view with the same pixels as the photograph; ``None`` without one."""
    shown = display(found.over(scene.background), scene).float()
    for view in scene.test:
        if view.image.shape[:2] == found.image.shape[:2]:
            gap = (display(view.over(scene.background), scene).float() - shown).abs().mean()
            if float(gap) < SAME:
                return view
    return None


def _draw(path: Path, fitted: Fitted, found: View) -> None:
    """Draw the photograph, the rendering at the estimated pose, and four times their difference, side by side."""
    from PIL import Image

    scene = fitted.scene
    picture = fitted.model.render(found.camera, normals=False)
    photo, shown = (display(colour, scene) for colour in (found.over(scene.background), picture.over(scene.background)))
    gap = ((photo.float() - shown.float()).abs() * 4).clamp(0, 255).to(torch.uint8)
    edge = torch.full((photo.shape[0], 4, 3), 255, dtype=torch.uint8)
    write_picture(path, Image.fromarray(torch.cat([photo, edge, shown, edge, gap], dim=1).numpy()))
