"""Writing of scenes as one ``.npz`` file with the keys of `invgraphics.scenes.npz`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from invgraphics.core import Bounds, Scene
from invgraphics.errors import InputError
from invgraphics.files import write_arrays
from invgraphics.scenes.border import background_of
from invgraphics.scenes.npz import MOST_CHARACTERS

MESH = "a mesh"
"""What keeps a scene that was rendered from being written, in words."""


def save_npz(scene: Scene, path: Path) -> None:
    """Write a scene as one ``.npz`` file that `load_scene` reads as the same, in the same units; colours of points have 8 bits.

    Not kept: names of views, spread of exposures, noise level, and which photographs show which points.

    Raises:
        InputError: it holds what the convention does not: no box, linear or unrounded colours, masks, a mesh,
            another background, pictures of several sizes; the sentence says what. Nothing is written then.
    """
    if beyond := unsupported_parts(scene):
        raise InputError(
            f"The scene '{scene.name}' cannot be kept as a data set: it has {beyond}.",
            "Leave it out by dataclasses.replace(scene, mesh=None)."
            if beyond == MESH
            else "Write it in a format that `load_scene` reads, and load it from there.",
        )
    views = [*scene.train, *scene.val, *scene.test, *scene.observed]
    ends = np.cumsum([len(split) for split in (scene.train, scene.val, scene.test, scene.observed)])
    split = np.searchsorted(ends, np.arange(len(views)), side="right")
    arrays: dict[str, np.ndarray] = {
        "images": np.stack([view.image.cpu().numpy() for view in views]),
        "cam_to_world": np.stack([view.camera.cam_to_world.cpu().numpy() for view in views]),
        "focal": np.stack([view.camera.focal.cpu().numpy() for view in views]),
        "centre": np.stack([view.camera.principal_point.cpu().numpy() for view in views]),
        "test": split == 2,
        "bounds": torch.stack([scene.bounds.lo, scene.bounds.hi]).cpu().numpy(),
        "own_units": np.array(True),
    }
    if scene.name.isprintable() and 0 < len(scene.name) <= MOST_CHARACTERS:
        arrays["name"] = np.array(scene.name)
    for key in ("alpha", "depth", "normal"):
        values = [getattr(view, key) for view in views]
        if all(value is not None for value in values):
            arrays[key] = np.stack([value.cpu().numpy() for value in values])
    arrays |= {"val": split == 1} if scene.val else {}
    if scene.is_class:
        arrays |= {"subject": np.array([view.subject for view in views]), "observed": split == 3}
    if scene.points is not None:
        arrays |= {"points": scene.points.position.cpu().numpy(), "points_rgb": scene.points.rgb.clamp(0, 1).cpu().numpy()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_arrays(path, arrays)


def unsupported_parts(scene: Scene) -> str:
    """List what a scene has that the format cannot store, in words; empty for nothing."""
    views = [*scene.train, *scene.val, *scene.test, *scene.observed]
    cameras = [view.camera for view in views]
    mixed = [key for key in ("alpha", "depth", "normal") if len({getattr(view, key) is None for view in views}) > 1]
    found = {
        "no box around it": scene.bounds.space != "box",
        "a near distance of its own": scene.bounds.near != Bounds.near,
        "a frame of its own": not torch.equal(scene.world_from_local, torch.eye(4)),
        "linear colours": scene.colour != "srgb",
        "colours or an alpha that are not bytes": any(
            values.dtype != torch.uint8 for view in views for values in (view.image, view.alpha) if values is not None
        ),
        "masks": any(view.mask is not None for view in views),
        MESH: scene.mesh is not None,
        f"{' and '.join(mixed)} for some views only": bool(mixed),
        "pictures of several sizes": len({(camera.width, camera.height) for camera in cameras}) > 1,
        "a background other than the default": not torch.equal(scene.background, background_of(views)),
        "poses that are degraded on purpose": any(view.ground_truth_pose is not None for view in views),
    }
    return next((what for what, present in found.items() if present), "")
