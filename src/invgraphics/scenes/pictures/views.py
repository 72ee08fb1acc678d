"""Views from photographs: undistorted at full size, then resized, one picture at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8

from invgraphics.core import Camera, View
from invgraphics.errors import InputError
from invgraphics.scenes.pictures.images import Photo, read_pixels
from invgraphics.scenes.pictures.lens import Lens, straighten, undistort
from invgraphics.scenes.pictures.masks import brightness, read_mask
from invgraphics.scenes.pictures.resize import area_resize, wanted_size


def load_view(photo: Photo, size: int | tuple[int, int] | None = None) -> View:
    """Read, undistort and resize one photograph whose camera fits its file (see `match_sizes`), and its mask.

    A pixel is valid if all pixels that it averages are.
    """
    view = make_view(photo.camera, _with_alpha(photo), photo.name, size, photo.lens)
    if photo.mask is None:
        return view
    pixels = read_mask(photo.mask, photo.camera.width, photo.camera.height)
    mask = make_view(photo.camera, pixels, photo.name, size, photo.lens).image[..., 0] == 255
    return view if bool(mask.all()) else replace(view, mask=mask)


def make_view(
    camera: Camera,
    pixels: UInt8[np.ndarray, "h w c"],
    name: str,
    size: int | tuple[int, int] | None = None,
    lens: Lens | None = None,
) -> View:
    """Make a view from pixels in memory, undistorted and resized: 8-bit colours, float32 camera.

    Args:
        camera: of these pixels; its focal lengths and principal point are replaced if there is a ``lens``.
        pixels: straight colour, or colour and alpha.
        name: the view's name.
        size: as in `wanted_size`.
        lens: the distortion to remove.
    """
    height, width = pixels.shape[:2]
    final = wanted_size(width, height, size)
    if lens is not None or final != (width, height):
        values = _premultiplied(pixels)
        if lens is not None:
            straight = straighten(lens)
            values = undistort(values, straight)
            new = camera.focal.new_tensor
            camera = replace(camera, focal=new(straight.focal), principal_point=new(straight.principal_point))
        pixels = _straight(area_resize(values, *final))
        camera = camera.resized(*final)
    image = torch.from_numpy(np.ascontiguousarray(pixels[:, :, :3]))
    alpha = None
    if pixels.shape[2] == 4 and pixels[:, :, 3].min() < 255:
        alpha = torch.from_numpy(np.ascontiguousarray(pixels[:, :, 3]))
    return View(camera.to(torch.float32), image, name, alpha=alpha)


def _with_alpha(photo: Photo) -> UInt8[np.ndarray, "h w c"]:
    like = (photo.camera.width, photo.camera.height)
    pixels = read_pixels(photo.path, like)
    if photo.alpha is None:
        return pixels
    coverage = brightness(read_pixels(photo.alpha, like))[:, :, None]
    if coverage.shape[:2] != pixels.shape[:2]:
        (h, w), (mask_h, mask_w) = pixels.shape[:2], coverage.shape[:2]
        raise InputError(f"{photo.alpha} has {mask_w}x{mask_h} pixels, its photograph has {w}x{h}.")
    return np.concatenate([pixels[:, :, :3], coverage], axis=2)


def _premultiplied(pixels: UInt8[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    values = pixels.astype(np.float32)
    if values.shape[2] == 4:
        values[:, :, :3] *= values[:, :, 3:] / 255
    return values


def _straight(values: Float[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
    if values.shape[2] == 4:
        alpha = values[:, :, 3:]
        colour = np.divide(values[:, :, :3] * 255, alpha, out=np.zeros_like(values[:, :, :3]), where=alpha > 0)
        values = np.concatenate([colour, alpha], axis=2)
    return (values.clip(0, 255) + 0.5).astype(np.uint8)
