"""COLMAP reconstructions, in any of the folders of a workspace."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from invgraphics.core import Camera, Points, Scene
from invgraphics.core.believable import LONGEST_SIDE
from invgraphics.core.transforms import colmap_to_opencv
from invgraphics.errors import InputError
from invgraphics.scenes.colmap_workspace import Model, find_model, model_folders, parents_in_workspace
from invgraphics.scenes.layout import SceneOptions, compose, every_eighth, existing_photos, scene_name
from invgraphics.scenes.photos.exposures import exposure_spread
from invgraphics.scenes.photos.notes import pose_notes
from invgraphics.scenes.pictures.images import Photo
from invgraphics.scenes.pictures.lens import Lens
from invgraphics.scenes.pictures.masks import with_masks_beside
from invgraphics.scenes.poses import pose
from invgraphics.scenes.region import photo_frame


class Colmap:
    """Loader of a COLMAP model, binary or text, with any perspective camera model and one camera per image if need be.

    The scene is unbounded, its SfM points are kept, and every eighth photograph by name is scored. Registered images whose
    files do not exist are skipped and named in the scene's notes, as is what an import of photographs found suspicious. Of
    several models the one with the most photographs is taken, and the notes say so.
    """

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is a COLMAP workspace or one of its usual folders."""
        return bool(model_folders(path))

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load a reconstruction as an unbounded scene: poses, photographs and SfM points.

        Raises:
            InputError: the model is unusable or its photographs are missing.
        """
        model = find_model(path)
        folder = model.images or path
        listed = with_masks_beside([_photo(image, folder) for image in model.registered], folder)
        photos, notes = existing_photos(listed, model.folder)
        notes |= {
            "loader": "colmap",
            "points": f"{model.reconstruction.num_points3D()} from SfM on all photographs, those that are scored too",
        } | pose_notes(parents_in_workspace(model.folder))
        notes |= {"model": model.note} if model.note else {}
        frame = photo_frame(photos, _points(model.reconstruction))
        return _with_tracks(compose(scene_name(path), every_eighth(photos), frame, options, notes), model)


def _with_tracks(scene: Scene, model: Model) -> Scene:
    """Add to a scene and its notes what tracks give for training photographs: landmarks, and the spread of exposures."""
    if scene.points is None:
        return scene
    rows = {number: row for row, number in enumerate(model.reconstruction.points3D)}
    images = {image.name: image for image in model.registered}
    observed = []
    for view in scene.train:
        seen = {rows[point.point3D_id] for point in images[view.name].points2D if point.point3D_id in rows}
        observed.append(torch.tensor(sorted(seen), dtype=torch.int64))
    position = scene.points.position
    train = tuple(replace(view, landmarks=position[rows]) for view, rows in zip(scene.train, observed, strict=True))
    seen = sum(len(rows) for rows in observed)
    notes = {"landmarks": f"{seen:,} views of points of structure from motion by the training photographs"}
    scene = replace(scene, train=train, notes=scene.notes | notes)
    spread = exposure_spread(scene.train, position, observed)
    if spread is None:
        return scene
    differ = f"of the training photographs differ by {math.expm1(spread):.0%}"
    words = f"{differ} (standard deviation), by what they show of the same points"
    return replace(scene, exposure_spread=spread, notes=scene.notes | {"exposures": words})


def _photo(image: Any, folder: Path) -> Photo:
    where = f"image '{image.name}'"
    lens = Lens(image.camera.model_name, tuple(float(v) for v in image.camera.params), image.camera.width, image.camera.height)
    # First: it refuses models without a focal length, and pycolmap ends the process when it is asked for theirs.
    pinhole = lens.is_pinhole()
    if not np.isfinite(lens.params).all() or image.camera.focal_length_x <= 0 or image.camera.focal_length_y <= 0:
        raise InputError(f"The camera of {where} has parameters {lens.params}, which no lens has.")
    world_to_cam = torch.from_numpy(np.array(image.cam_from_world().matrix(), dtype=np.float64))
    norm = float(np.linalg.norm(image.cam_from_world().rotation.quat))
    if abs(norm - 1) > 1e-3:  # COLMAP normalises what it reads, and what it cannot normalise counts as no rotation
        raise InputError(f"The rotation of {where} is a quaternion of norm {norm:.2g}.")
    if not (1 <= lens.width <= LONGEST_SIDE and 1 <= lens.height <= LONGEST_SIDE):
        raise InputError(f"The camera of {where} has {lens.width}x{lens.height} pixels.")
    camera = Camera(
        cam_to_world=pose(colmap_to_opencv(world_to_cam), where),
        focal=torch.tensor([image.camera.focal_length_x, image.camera.focal_length_y], dtype=torch.float64),
        principal_point=torch.tensor([image.camera.principal_point_x, image.camera.principal_point_y], dtype=torch.float64),
        width=lens.width,
        height=lens.height,
    )
    return Photo(folder / image.name, camera, image.name, None if pinhole else lens)


def _points(reconstruction: Any) -> Points | None:
    points = list(reconstruction.points3D.values())
    if not points:
        return None
    position = np.stack([point.xyz for point in points])
    rgb = np.stack([point.color for point in points]).astype(np.float32) / 255
    return Points(torch.from_numpy(position), torch.from_numpy(rgb))
