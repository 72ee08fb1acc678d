"""The folder of a rendered scene: what the rendering process writes and `invgraphics.scenes.truth` reads."""

from __future__ import annotations

import json
import math
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from invgraphics.core import Camera
from invgraphics.core.colour import linear_to_srgb, quantise
from invgraphics.core.transforms import opencv_to_opengl
from invgraphics.files import write_arrays, write_picture, write_text
from invgraphics.scenes.mitsuba.cache import REQUEST, SCHEMA, TRUTH
from invgraphics.scenes.mitsuba.gbuffer import GBuffer
from invgraphics.scenes.mitsuba.job import Job
from invgraphics.scenes.mitsuba.rig import Split


def straight_srgb(linear: Float[np.ndarray, "h w 4"]) -> Float[torch.Tensor, "h w 4"]:
    """Display colour and alpha, not premultiplied, of linear premultiplied values; black where alpha is 0."""
    rgba = torch.from_numpy(linear).double()
    alpha = rgba[..., 3:].clamp(0, 1)
    return torch.cat([linear_to_srgb(rgba[..., :3] / alpha.clamp_min(1e-9)) * (alpha > 0), alpha], dim=-1)


def psnr(first: Float[np.ndarray, "h w 4"], second: Float[np.ndarray, "h w 4"], background: tuple[float, ...] | None) -> float:
    """PSNR in dB between two linear renderings in display sRGB over the background; infinite when they are equal."""
    behind = torch.tensor(background or (0.0, 0.0, 0.0)).double()
    shown = [rgba[..., :3] * rgba[..., 3:] + behind * (1 - rgba[..., 3:]) for rgba in map(straight_srgb, (first, second))]
    error = float((shown[0] - shown[1]).square().mean())
    return -10 * math.log10(error) if error > 0 else math.inf


def view_paths(folder: Path, split: Split, index: int) -> tuple[Path, Path]:
    """The picture and the arrays of a view."""
    return folder / split / f"{index:04d}.png", folder / split / f"{index:04d}.npz"


def write_view(
    folder: Path, split: Split, index: int, linear: Float[np.ndarray, "h w 4"], gbuffer: GBuffer, half_psnr: float
) -> None:
    """Write a view; its arrays appear last and at once, so that their presence means that the view is complete."""
    from PIL import Image

    picture, arrays = view_paths(folder, split, index)
    picture.parent.mkdir(parents=True, exist_ok=True)
    write_picture(picture, Image.fromarray(quantise(straight_srgb(linear)).numpy(), "RGBA"))
    content = {"linear": linear, "depth": gbuffer.depth, "normal": gbuffer.normal, "alpha": gbuffer.alpha}
    write_arrays(arrays, content | {"half_psnr": np.float64(half_psnr)})


def write_transforms(folder: Path, split: Split, cameras: tuple[Camera, ...]) -> None:
    """The NeRF-synthetic ``transforms_<split>.json``, for other programs (OpenGL axes)."""
    first = cameras[0]
    angle = 2 * math.atan(first.width / (2 * float(first.focal[0])))
    frames = [
        {"file_path": f"./{split}/{i:04d}", "transform_matrix": opencv_to_opengl(camera.cam_to_world).tolist()}
        for i, camera in enumerate(cameras)
    ]
    text = json.dumps({"camera_angle_x": angle, "frames": frames}, indent=1)
    write_text(folder / f"transforms_{split}.json", text)


def write_truth(folder: Path, job: Job, cameras: dict[Split, tuple[Camera, ...]], half_psnr: list[float]) -> None:
    """Write ``truth.json``, last of all: what the folder holds, how it was made, and the size of every file."""
    spec = job.spec
    files = {
        path.relative_to(folder).as_posix(): path.stat().st_size
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in (TRUTH, REQUEST)
    }
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "key": job.key(),
        "name": spec.name,
        "summary": spec.summary,
        "stresses": spec.stresses,
        "size": list(job.size),
        "background": list(spec.background) if spec.background else None,
        "bounds": {"lo": list(spec.lo), "hi": list(spec.hi)},
        "rig": dict(spec.rig),
        "samples_per_pixel": {"train": job.samples.train, "val": job.samples.val, "test": job.samples.test},
        "seed": job.seed,
        "variant": job.variant,
        "versions": {package: version(package) for package in ("mitsuba", "drjit", "numpy", "torch", "invgraphics")},
        "noise_ceiling": mean if math.isfinite(mean := float(np.mean(half_psnr))) else None,
        "cameras": {split: [_camera_table(camera) for camera in views] for split, views in cameras.items()},
        "files": files,
    }
    write_text(folder / TRUTH, json.dumps(content, indent=1))


def _camera_table(camera: Camera) -> dict[str, Any]:
    return {
        "cam_to_world": camera.cam_to_world.tolist(),
        "focal": camera.focal.tolist(),
        "centre": camera.principal_point.tolist(),
        "width": camera.width,
        "height": camera.height,
    }
