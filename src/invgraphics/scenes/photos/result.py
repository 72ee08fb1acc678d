"""Output of a photo import: undistorted pictures and the COLMAP model of their pinhole cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from invgraphics.core import Camera, View
from invgraphics.errors import InputError
from invgraphics.files import copy_file, write_picture
from invgraphics.scenes.colmap_sizes import check_sizes
from invgraphics.scenes.photos.prepare import OWN_MASKS, PHOTOS, Prepared
from invgraphics.scenes.pictures.images import read_pixels
from invgraphics.scenes.pictures.lens import Lens, Straight, straighten
from invgraphics.scenes.pictures.masks import FOLDER
from invgraphics.scenes.pictures.views import make_view
from invgraphics.scenes.process import Progress

STRAIGHT = 0.25
"""A lens that moves no pixel farther than this many pixels is taken for a pinhole: resampling would cost more than it mends."""


MAPS_BACK = 0.01
"""Largest round-trip error, in pixels, of a pixel's ray: beyond it the undistortion has not converged, and there is none."""


def write_scene(model: Any, photos: Sequence[Prepared], work: Path, result: Path, progress: Progress) -> float:
    """Write ``images`` and ``sparse/0`` for the photographs that ``model`` places; the model itself is changed on the way.

    Returns:
        The largest distance that a lens moves a pixel of a picture that is written.
    """
    (result / "images").mkdir(parents=True, exist_ok=True)
    by_name = {image.name: image for image in model.images.values() if image.has_pose}
    kept = [photo for photo in photos if photo.name in by_name]
    used = {by_name[photo.name].camera_id for photo in kept}
    lenses = {camera_id: lens_of(model.cameras[camera_id]) for camera_id in used}
    bends = {camera_id: max_distortion(lens) for camera_id, lens in lenses.items()}
    for index, photo in enumerate(kept):
        progress(index, len(kept), f"straightening {photo.name}")
        image = by_name[photo.name]
        lens = lenses[image.camera_id] if bends[image.camera_id] > STRAIGHT else None
        _write_picture(work / PHOTOS / photo.name, result / "images" / photo.name, lens)
        if photo.own_mask:
            (result / FOLDER).mkdir(exist_ok=True)
            _write_mask(work / OWN_MASKS / f"{photo.name}.png", result / FOLDER / f"{photo.name}.png", lens)
    for camera_id, camera in model.cameras.items():
        # A camera of removed photographs may have a lens that nothing straightens; no picture of it is written.
        straight = straighten(lenses[camera_id]) if bends.get(camera_id, 0.0) > STRAIGHT else None
        if straight is not None:
            for image in model.images.values():
                if image.camera_id == camera_id:
                    _move_points(image, camera, straight)
        _make_pinhole(camera, straight)
    (result / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    _write_model(model, result / "sparse" / "0")
    return max(bends.values(), default=0.0)


def _write_model(model: Any, folder: Path) -> None:
    """Write a COLMAP model; the library does not report incomplete writes."""
    model.write(str(folder))
    try:
        check_sizes(folder)
    except InputError as error:
        raise InputError(f"'{folder}' was not written whole.", "The disk may be full: free some space there.") from error


def max_distortion(lens: Lens) -> float:
    """Largest displacement in pixels by the lens distortion, on a lattice over the picture.

    Where the lens has no inverse, as in the corners of strong barrel distortion, nothing is measured; if that is
    everywhere, the result is the longest side of the picture.
    """
    if lens.is_pinhole():
        return 0.0
    camera = lens.colmap()
    x, y = np.linspace(0, lens.width, 33), np.linspace(0, lens.height, 33)
    border = np.array([[u, v] for u in x for v in y])
    plane = camera.cam_from_img(border)
    back = camera.img_from_cam(np.concatenate([plane, np.ones((len(plane), 1))], axis=1))
    known = np.abs(back - border).max(axis=1) < MAPS_BACK  # not so of NaN
    straight = plane * (camera.focal_length_x, camera.focal_length_y) + (camera.principal_point_x, camera.principal_point_y)
    moved = np.linalg.norm(straight - border, axis=1)[known]
    return float(moved.max()) if len(moved) else float(max(lens.width, lens.height))


def lens_of(camera: Any) -> Lens:
    """Lens of a ``pycolmap.Camera``."""
    return Lens(camera.model_name, tuple(float(value) for value in camera.params), camera.width, camera.height)


def _write_picture(source: Path, target: Path, lens: Lens | None) -> None:
    from PIL import Image

    if lens is None:
        copy_file(source, target)
        return
    view = _straight_view(source, lens)
    alpha = [] if view.alpha is None else [view.alpha[..., None].numpy()]
    write_picture(target, Image.fromarray(np.concatenate([view.image.numpy(), *alpha], axis=-1)), compress_level=1)


def _write_mask(source: Path, target: Path, lens: Lens | None) -> None:
    """A mask, straight as its picture; a pixel counts where all that it is made of do."""
    from PIL import Image

    if lens is None:
        copy_file(source, target)
        return
    counts = _straight_view(source, lens).image[..., 0].numpy() == 255
    write_picture(target, Image.fromarray(255 * counts.astype(np.uint8)), compress_level=1)


def _straight_view(source: Path, lens: Lens) -> View:
    unit = torch.ones(2, dtype=torch.float64)  # replaced by the lens's own
    camera = Camera(torch.eye(4, dtype=torch.float64), unit, unit, lens.width, lens.height)
    return make_view(camera, read_pixels(source), source.name, lens=lens)


def _move_points(image: Any, camera: Any, straight: Straight) -> None:
    """Move a picture's features to where its undistorted copy shows them."""
    if image.num_points2D() == 0:
        return
    plane = camera.cam_from_img(np.array([point.xy for point in image.points2D]))
    moved = plane * straight.focal + straight.principal_point
    moved[~np.isfinite(moved).all(axis=1)] = -1  # outside: the undistorted picture does not show what has no ray
    for point, xy in zip(image.points2D, moved, strict=True):
        point.xy = xy


def _make_pinhole(camera: Any, straight: Straight | None) -> None:
    from invgraphics.scenes.colmap_library import pycolmap

    focal = (camera.focal_length_x, camera.focal_length_y) if straight is None else straight.focal
    centre = (camera.principal_point_x, camera.principal_point_y) if straight is None else straight.principal_point
    camera.model = pycolmap.CameraModelId.PINHOLE
    camera.params = [*focal, *centre]
