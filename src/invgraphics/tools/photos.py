"""Import of photographs as a scene by structure from motion, scored against true poses where those are known."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera, Scene
from invgraphics.core.transforms import apply_similarity, axes_to_opencv
from invgraphics.errors import InputError
from invgraphics.files import write_text
from invgraphics.metrics.poses import pose_errors
from invgraphics.scenes.open import SceneOptions, find_loader
from invgraphics.scenes.photos import PhotoJob, reconstruct
from invgraphics.scenes.photos.job import QUALITY
from invgraphics.scenes.photos.maker import result_folder, writing
from invgraphics.scenes.process import Progress

STORED_AXES = {1: "RDF", 3: "LUF", 6: "DLF", 8: "URF"}
"""EXIF orientation -> where +x, +y and +z of the stored picture point in the upright one; mirrored ones are left out."""

_LEAST = 3  # cameras: with two, a similarity explains everything
_SMALL = 32  # longest side in pixels of pictures whose poses alone count: at full size, hundreds of them fill the memory


def import_photos(job: PhotoJob, out: Path, truth: Path | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Reconstruct cameras and points from photographs, and compare the cameras with known poses.

    Args:
        job: which photographs, and how.
        out: folder of the scene.
        truth: a data set with the true poses of these photographs, matched by file name. Without it, the folder of the
            photographs and the one above are searched for one.
        progress: called with (done, in all, what is being done).

    Returns:
        The content of the scene's quality.json, with ``truth`` if poses could be compared.

    Raises:
        InputError: see `invgraphics.scenes.photos.reconstruct`; or ``truth`` does not know these photographs.
    """
    if truth is not None:
        find_loader(truth)  # refuses before the work what it would refuse after it
    with writing(out):
        quality = reconstruct(job, out, progress)
        quality.pop("truth", None)
        if truth is not None:
            quality["truth"] = compare(job.path, quality, truth)
        else:
            quality |= _found_truth(job.path, quality)
        write_text(result_folder(out, quality) / QUALITY, json.dumps(quality, indent=1))
    return quality


def compare(folder: Path, quality: dict[str, Any], truth: Path) -> dict[str, Any]:
    """Errors of the recovered cameras after a similarity alignment.

    Recovered cameras are of upright pictures, a data set's as a rule of pictures as they are stored: see `_pose_of_stored`.

    Args:
        folder: of the photographs.
        quality: report of their reconstruction.
        truth: data set with poses.

    Returns:
        ``source``, and the summary of `invgraphics.metrics.poses.PoseErrors`.

    Raises:
        InputError: the data set cannot be read, or has fewer than three of the photographs.
    """
    known = true_cameras(find_loader(truth).load(truth, SceneOptions(size=_SMALL, test_views=None)))
    estimated, true = [], []
    for camera in quality["cameras"]:
        true_camera = _lookup(known, folder, camera["source"])
        if true_camera is not None and camera.get("orientation", 1) in STORED_AXES:
            estimated.append(_pose_of_stored(camera, true_camera))
            true.append(true_camera.cam_to_world)
    if len(true) < _LEAST:
        raise InputError(
            f"{truth} has poses of {len(true)} of the {len(quality['cameras'])} placed photographs of {folder}.",
            "Photographs are matched by file name, for instance 0001.jpg, or train/0001.png where splits share names.",
        )
    errors = pose_errors(torch.stack(estimated), torch.stack(true))
    return {"source": str(truth), **errors.summary()}


def _pose_of_stored(camera: Mapping[str, Any], true_camera: Camera) -> Float[Tensor, "4 4"]:
    """Recovered pose of a photograph in the orientation that the data set's camera has.

    Its pictures count as stored, unless their shape is that of the upright one alone.
    """
    pose, orientation = torch.tensor(camera["cam_to_world"], dtype=torch.float64), camera.get("orientation", 1)
    width, height = camera.get("size", (0, 0))
    quarter_turn = STORED_AXES[orientation][0] in "UD"
    is_upright = quarter_turn and (width - height) * (true_camera.width - true_camera.height) > 0
    return pose if is_upright else upright_to_stored(pose, orientation)


def upright_to_stored(pose: Float[Tensor, "4 4"], orientation: int) -> Float[Tensor, "4 4"]:
    """Pose of the camera of a picture as it is stored, from that of the picture turned upright by its EXIF orientation.

    The camera is turned about its optical axis; orientations are those of `STORED_AXES`.
    """
    return pose @ axes_to_opencv(STORED_AXES[orientation]).to(pose)


def true_cameras(scene: Scene) -> dict[str, Camera | None]:
    """Map view names, without suffix, alone and after the split, to cameras in the world; ``None`` where views share a name."""
    world = scene.world_from_local.double()
    known: dict[str, Camera | None] = {}
    for split in ("train", "val", "test"):
        for view in getattr(scene, split):
            camera = replace(view.camera, cam_to_world=apply_similarity(world, view.camera.cam_to_world.double()))
            name = Path(view.name).stem
            for label in {name, f"{split}/{name}", f"{split}-{name}"}:
                known[label] = None if label in known else camera
    return known


def _lookup(known: Mapping[str, Camera | None], folder: Path, source: str) -> Camera | None:
    name = Path(source).stem
    return known.get(f"{folder.resolve().name}/{name}") or known.get(name)


def _found_truth(folder: Path, quality: dict[str, Any]) -> dict[str, Any]:
    """Compare the cameras with the data set that contains the photographs, if any."""
    for place in (folder, folder.resolve().parent):
        try:
            return {"truth": compare(folder, quality, place)}
        except InputError:
            continue
    return {}
