"""Scenes in one ``.npz`` file, as ``numpy.savez`` writes it.

============== ============================== =====================================================================
key            shape                          meaning
============== ============================== =====================================================================
images         (n, h, w, 3) or (n, h, w, 4)   bytes, or floats in [0, 1]; straight display sRGB, the 4th channel is alpha
cam_to_world   (n, 4, 4) or (n, 3, 4)         rigid poses, OpenCV axes (+x right, +y down, +z forward)
focal          (), (2,) or (n, 2)             focal lengths in pixels, (fx, fy)
centre         (2,) or (n, 2), optional       principal point (cx, cy) in pixels, first pixel's centre at 0.5; default: middle
alpha          (n, h, w), optional            coverage, bytes or floats in [0, 1]; instead of a 4th channel
depth          (n, h, w), optional            distance along the unit ray, world units, inf where nothing is hit
normal         (n, h, w, 3), optional         unit normals, world frame, facing the camera, zero where nothing is hit
points         (m, 3), optional               known surface points, world frame
points_rgb     (m, 3), optional               their colours, as ``images``; default: grey
test           (n,) booleans, optional        which views are scored; default: every 8th
val            (n,) booleans, optional        which views are only monitored during a fit
subject        (n,) integers, optional        of a class of objects: which one each view shows; scored ones are unseen
observed       (n,) booleans, optional        of a class: views from which the unseen instances are inferred
bounds         (2, 3), optional               lowest and highest corner of a box that holds all there is; default: unbounded
own_units      () boolean, optional           whether the box is taken as it is, however large; default: scaled to a usual size
name           () text, optional              of the scene, at most 100 characters; default: the file's
============== ============================== =====================================================================
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from invgraphics.arrays import read_arrays
from invgraphics.core import Bounds, Camera, Points, Scene, View
from invgraphics.core.transforms import apply_similarity
from invgraphics.errors import InputError, did_you_mean
from invgraphics.scenes.border import background_of, looked_at
from invgraphics.scenes.layout import HOLD_OUT, SceneOptions, evenly, local_points
from invgraphics.scenes.pictures.resize import RESIZE, wanted_size
from invgraphics.scenes.pictures.views import make_view
from invgraphics.scenes.poses import poses
from invgraphics.scenes.region import LocalFrame, box_frame, contracted_frame, object_frame

Arrays = Mapping[str, np.ndarray]
MOST_CHARACTERS = 100
"""Of a scene's name."""
_REQUIRED = ("images", "cam_to_world", "focal")


class Npz:
    """Loader of one ``.npz`` file with the keys of this module's docstring."""

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is an ``.npz`` file."""
        return path.is_file() and path.suffix == ".npz"

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load images, cameras and optional geometry; keys and shapes as in this module's docstring.

        Raises:
            InputError: it is damaged, or a key is missing or has another shape.
        """
        arrays = _read(path)
        n, height, width = arrays["images"].shape[:3]
        world = poses(torch.from_numpy(arrays["cam_to_world"].astype(np.float64)), lambda i: f"{path}, view {i}")
        frame = _frame(arrays, world, path)
        train, val, test, observed = _splits(arrays, n, path)
        if not train or not test:
            raise InputError(f"{path} has {len(train)} views to fit and {len(test)} to score; it needs at least one of each.")
        final = wanted_size(width, height, options.size)
        chosen = (evenly(train, options.train_views), val, evenly(test, options.test_views), observed)
        notes = {
            "loader": "npz",
            "train_views": f"{len(chosen[0])} of {len(train)}, evenly spaced",
            "test_views": f"{len(chosen[2])} of {len(test)}, evenly spaced",
            "resize": "none" if final == (width, height) else f"{RESIZE}, {width}x{height} to {final[0]}x{final[1]}",
        }
        if final != (width, height) and ("depth" in arrays or "normal" in arrays):
            notes["geometry"] = "depth and normals are dropped: they are one ray per pixel and cannot be averaged"
        local = torch.vmap(apply_similarity, in_dims=(None, 0))(torch.linalg.inv(frame.world_from_local), world)
        named = list(zip(_cameras(arrays, local), _names(arrays), strict=True))
        views = {i: _view(path, arrays, i, named[i], frame, final) for part in chosen for i in part}
        return Scene(
            name=_scene_name(arrays, path),
            train=tuple(views[i] for i in chosen[0]),
            val=tuple(views[i] for i in val),
            test=tuple(views[i] for i in chosen[2]),
            observed=tuple(views[i] for i in observed),
            background=background_of(list(views.values())),
            bounds=frame.bounds,
            points=local_points(frame),
            world_from_local=frame.world_from_local.float(),
            notes=notes,
        )


def _read(path: Path) -> Arrays:
    """Read all arrays, with validated shapes."""
    arrays = read_arrays(path)
    missing = [key for key in _REQUIRED if key not in arrays]
    if missing:
        raise InputError(f"{path} has no {' and no '.join(map(repr, missing))}.", f"It has: {', '.join(arrays) or 'nothing'}.")
    images = arrays["images"]
    n, h, w = images.shape[:3] if images.ndim == 4 else (0, 0, 0)
    if n == 0 or images.shape[3] not in (3, 4):
        raise InputError(f"'images' of {path} has shape {images.shape}, expected (n, h, w, 3) or (n, h, w, 4).")
    allowed = {
        "cam_to_world": [(n, 4, 4), (n, 3, 4)],
        "focal": [(), (2,), (n, 2)],
        "centre": [(2,), (n, 2)],
        "alpha": [(n, h, w)],
        "depth": [(n, h, w)],
        "normal": [(n, h, w, 3)],
        "bounds": [(2, 3)],
        "test": [(n,)],
        "val": [(n,)],
        "subject": [(n,)],
        "observed": [(n,)],
        "own_units": [()],
        "name": [()],
    }
    known = (*_REQUIRED, *allowed, "points", "points_rgb")
    if unknown := [key for key in arrays if key not in known]:
        raise InputError(f"{path} has an unknown key '{unknown[0]}'.{did_you_mean(unknown[0], known)}")
    for key, shapes in allowed.items():
        if key in arrays and arrays[key].shape not in shapes:
            expected = " or ".join(map(str, shapes))
            raise InputError(f"'{key}' of {path} has shape {arrays[key].shape}, expected {expected}.")
        if key in arrays and key != "name" and arrays[key].dtype.kind not in "fiub":
            raise InputError(f"'{key}' of {path} holds {arrays[key].dtype}, not numbers.")
    if (alpha := arrays.get("alpha")) is not None and alpha.dtype == np.uint8 and alpha.max(initial=0) == 1:  # 0, 1 are meant
        arrays["alpha"] = alpha * np.uint8(255)
    return arrays


def _frame(arrays: Arrays, world: Float[Tensor, "n 4 4"], path: Path) -> LocalFrame:
    points = None
    if "points" in arrays:
        position = arrays["points"]
        rgb = arrays.get("points_rgb", np.full(position.shape, 0.5))
        if position.ndim != 2 or position.shape[1] != 3 or rgb.shape != position.shape:
            raise InputError(f"'points' of {path} has shape {position.shape}, its colours {rgb.shape}; expected (m, 3) twice.")
        if position.dtype.kind not in "fiu" or not np.isfinite(position).all():
            raise InputError(f"'points' of {path} has entries that are not finite numbers.")
        points = Points(
            torch.from_numpy(position.astype(np.float64)), torch.from_numpy(_bytes(rgb, "points_rgb", path)).float() / 255
        )
    if "bounds" not in arrays:
        pictures = [_pixels(arrays, i, path) for i in looked_at(range(len(world)))]
        return object_frame(_cameras(arrays, world), pictures, points) or contracted_frame(world, points)
    with np.errstate(over="ignore"):  # infinite bounds are refused with the scene
        lo, hi = torch.from_numpy(arrays["bounds"].astype(np.float32)).double()
    if not bool((lo < hi).all()):
        raise InputError(f"'bounds' of {path} is {arrays['bounds'].tolist()}: the first corner must be below the second.")
    own = bool(arrays.get("own_units", False))
    return LocalFrame(Bounds(lo.float(), hi.float()), points=points) if own else box_frame(lo, hi, points)


def _splits(arrays: Arrays, n: int, path: Path) -> tuple[list[int], list[int], list[int], list[int]]:
    """Views to fit, to monitor, to score, and from which unseen instances are inferred.

    Raises:
        InputError: they overlap, or the subjects do not fit to them.
    """
    val, observed = (_booleans(arrays, key, np.zeros(n, bool), path) for key in ("val", "observed"))
    test = _booleans(arrays, "test", (np.arange(n) % HOLD_OUT == 0) & ~val & ~observed, path)
    if (test & val | test & observed | val & observed).any():
        raise InputError(f"{path} has views that are more than one of 'test', 'val' and 'observed'.")
    train = ~(test | val | observed)
    subject = arrays.get("subject")
    if subject is None:
        if observed.any():
            raise InputError(f"{path} has 'observed' views, but no 'subject' says whom they show.")
    elif subject.dtype.kind not in "iu":
        raise InputError(f"'subject' of {path} holds {subject.dtype}, expected one whole number per view.")
    elif np.isin(subject[test | observed], subject[train]).any():
        raise InputError(f"{path} scores or observes instances that are trained on, too.", "Hold out whole instances.")
    elif not np.isin(subject[test], subject[observed]).all():
        raise InputError(f"{path} scores instances without any 'observed' view.", "Give each of them one.")
    train_views, val_views, test_views, observed_views = (
        np.flatnonzero(split).tolist() for split in (train, val, test, observed)
    )
    return train_views, val_views, test_views, observed_views


def _booleans(arrays: Arrays, key: str, default: np.ndarray, path: Path) -> np.ndarray:
    if key in arrays and arrays[key].dtype != np.bool_:
        raise InputError(f"'{key}' of {path} holds {arrays[key].dtype}, expected one boolean per view.")
    return arrays.get(key, default)


def _cameras(arrays: Arrays, poses: Float[Tensor, "n 4 4"]) -> list[Camera]:
    """Cameras of all views at ``poses``, at the pictures' size."""
    n, height, width = arrays["images"].shape[:3]
    centre = arrays.get("centre", np.array([width / 2, height / 2]))
    lens = [torch.from_numpy(np.broadcast_to(values, (n, 2)).astype(np.float64)) for values in (arrays["focal"], centre)]
    return [Camera(pose, focal, middle, width, height) for pose, focal, middle in zip(poses, *lens, strict=True)]


def _scene_name(arrays: Arrays, path: Path) -> str:
    """Name of the scene in a file: its key, else that of the file."""
    if "name" not in arrays:
        return path.stem
    name = str(arrays["name"])
    if arrays["name"].dtype.kind != "U" or not name.isprintable() or not 0 < len(name) <= MOST_CHARACTERS:
        raise InputError(f"'name' of {path} is no text of 1 to {MOST_CHARACTERS} printable characters.")
    return name


def _names(arrays: Arrays) -> list[str]:
    """A view's index; of a class, its subject and its place among that subject's views."""
    if "subject" not in arrays:
        return [str(i) for i in range(len(arrays["images"]))]
    seen, names = Counter[int](), []
    for subject in arrays["subject"].tolist():
        names.append(f"{subject:04d}-{seen[subject]:02d}")
        seen[subject] += 1
    return names


def _view(path: Path, arrays: Arrays, i: int, named: tuple[Camera, str], frame: LocalFrame, final: tuple[int, int]) -> View:
    view = make_view(named[0], _pixels(arrays, i, path), named[1], final)
    if "subject" in arrays:
        view = replace(view, subject=int(arrays["subject"][i]))
    if final != (named[0].width, named[0].height):
        return view
    depth, normal = arrays.get("depth"), arrays.get("normal")
    if depth is not None:
        view = replace(view, depth=torch.from_numpy(depth[i].astype(np.float32)) / frame.scale)
    if normal is not None:
        rotation = (frame.world_from_local[:3, :3] / frame.scale).float()
        view = replace(view, normal=torch.from_numpy(normal[i].astype(np.float32)) @ rotation)
    return view


def _pixels(arrays: Arrays, i: int, path: Path) -> UInt8[np.ndarray, "h w c"]:
    """Straight colour of a view, or colour and alpha."""
    pixels, alpha = _bytes(arrays["images"][i], "images", path), arrays.get("alpha")
    return pixels if alpha is None else np.dstack([pixels[:, :, :3], _bytes(alpha[i], "alpha", path)])


def _bytes(values: np.ndarray, key: str, path: Path) -> UInt8[np.ndarray, "*shape"]:
    if values.dtype == np.uint8:
        return values
    if values.dtype.kind == "f" and np.isfinite(values).all() and (values >= 0).all() and (values <= 1).all():
        return (values * 255 + 0.5).astype(np.uint8)
    raise InputError(f"'{key}' of {path} holds neither bytes nor finite floats in [0, 1].")
