"""Validation of a scene, loaded or made in Python: types, sizes, ranges, poses, and that no test view is fitted."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from invgraphics.core import Scene, View
from invgraphics.core.believable import check_scene, principal_point_far_outside
from invgraphics.errors import InputError
from invgraphics.scenes.poses import poses

SPLITS = ("train", "val", "test", "observed")
SAME_POSE = 1e-6
"""Entries of two poses that are closer than this are one camera's."""
ROUNDING = 1e-3
"""How far a display colour or an alpha may leave [0, 1], as resampling filters make them."""


def validate(scene: Scene) -> Scene:
    """Validate a scene's poses, pixels, splits and ranges; returns the scene, in float32 where parts of it were float64.

    Raises:
        InputError: a part is no tensor, a pose is not rigid, pixels are not finite, out of range or not of the camera's size, a
            split is empty, a test camera is also a training camera, or something is not believable (`core.believable`). The
            sentence names the view.
    """
    for split in ("train", "test"):
        if not getattr(scene, split):
            raise InputError(
                f"The scene '{scene.name}' has no {split} views.", "At least one to fit and one to score is needed."
            )
    scene = _in_single_precision(scene)
    for split in SPLITS:
        views = getattr(scene, split)
        names = [f"{split} view '{view.name}' of '{scene.name}'" for view in views]
        if views:
            poses(torch.stack([view.camera.cam_to_world for view in views]), names.__getitem__)
        for view, name in zip(views, names, strict=True):
            _validate_view(view, name, scene.colour)
    scene = without_blank_views(scene)
    check_scene(scene)
    if off := [view.name for view in scene.train if principal_point_far_outside(view.camera)]:
        message = f"'{off[0]}' has its principal point far outside the picture: a crop, or resized without its calibration?"
        print(f"Warning: {message}", file=sys.stderr)
    for split in ("train", "observed"):
        _check_apart(scene, split)
    return _with_val_apart(scene)


def without_blank_views(scene: Scene) -> Scene:
    """Leave out views to fit, monitor and score of which masks leave no pixel, as they may once a picture is small.

    Raises:
        InputError: none is left to fit, or to score.
    """
    kept, blank = {}, []
    for split, what in (("train", "training"), ("val", ""), ("test", "test")):
        views = getattr(scene, split)
        valid = [view.mask is None or bool(view.mask.any()) for view in views]
        kept[split] = tuple(itertools.compress(views, valid))
        blank += [view.name for view, one in zip(views, valid, strict=True) if not one]
        if what and not kept[split]:
            raise InputError(f"The masks of '{scene.name}' leave no pixel of any {what} view.", "True marks valid pixels.")
    if not blank:
        return scene
    shown = ", ".join(blank[:5]) + (", ..." if len(blank) > 5 else "")
    note = {"masked_views": f"{len(blank)} without a valid pixel are left out: {shown}"}
    return replace(scene, **kept, notes=scene.notes | note)


def _with_val_apart(scene: Scene) -> Scene:
    """Leave out validation views that are test views, too, as where a data set has one list for both."""
    val = tuple(view for view in scene.val if not _of_its_camera(scene.test, view))
    left = len(scene.val) - len(val)
    note = {"val_views": f"{left} that are test views, too, are left out"} if left else {}
    return replace(scene, val=val, notes=scene.notes | note) if left else scene


def _of_its_camera(views: Sequence[View], view: View) -> list[View]:
    """Views that have a view's pose."""
    gap = torch.stack([one.camera.cam_to_world for one in views]) - view.camera.cam_to_world
    return [views[index] for index in (gap[:, :3].abs().amax(dim=(1, 2)) < SAME_POSE).nonzero()[:, 0].tolist()]


def _check_apart(scene: Scene, split: str) -> None:
    views: tuple[View, ...] = getattr(scene, split)
    if not views:
        return
    for test in scene.test:
        if same := _of_its_camera(views, test):
            sentence = f"The {split} view '{same[0].name}' and the test view '{test.name}' of '{scene.name}' share a camera."
            raise InputError(sentence)


def _in_single_precision(scene: Scene) -> Scene:
    """The scene with float32 cameras, pictures, background and bounds, as NumPy does not make them; itself where they are."""
    tensors = dict(_tensors(scene))
    for what, values in tensors.items():
        if not isinstance(values, Tensor):
            message = f"The {what} of '{scene.name}' is a {type(values).__name__}, not a tensor."
            raise InputError(message, "torch.as_tensor makes one of an array or a list.")
    if not any(values.dtype == torch.float64 for values in tensors.values()):
        return scene
    views = {split: tuple(_view_in_single_precision(view) for view in getattr(scene, split)) for split in SPLITS}
    return replace(scene, **views, background=scene.background.float(), bounds=scene.bounds.to(torch.float32))


def _tensors(scene: Scene) -> Iterator[tuple[str, Tensor]]:
    """Names and values of a scene's tensors: pictures, cameras, background and bounds."""
    for split in SPLITS:
        for view in getattr(scene, split):
            for name in ("image", "alpha", "depth", "normal", "mask"):
                if (values := getattr(view, name)) is not None:
                    yield f"{name} of {split} view '{view.name}'", values
            for name in ("cam_to_world", "focal", "principal_point"):
                yield f"{name} of the camera of {split} view '{view.name}'", getattr(view.camera, name)
    yield "background", scene.background
    yield "lowest corner of the bounds", scene.bounds.lo
    yield "highest corner of the bounds", scene.bounds.hi


def _view_in_single_precision(view: View) -> View:
    parts = {name: getattr(view, name) for name in ("image", "alpha", "depth", "normal")}
    single = {name: values.float() for name, values in parts.items() if values is not None and values.dtype == torch.float64}
    return replace(view, camera=view.camera.to(torch.float32), **single)


def _validate_view(view: View, what: str, colour: str) -> None:
    camera = view.camera
    for name in ("width", "height"):
        if not isinstance(getattr(camera, name), int):
            raise InputError(f"The {name} of the camera of {what} is {getattr(camera, name)!r}, not a whole number.")
    channels = {"image": (3,), "alpha": (), "depth": (), "normal": (3,), "mask": ()}
    for name, last in channels.items():
        values = getattr(view, name)
        if values is None:
            continue
        if tuple(values.shape[:2]) != (camera.height, camera.width):
            height, width = values.shape[:2]
            raise InputError(f"The {name} of {what} has {width}x{height} pixels, its camera {camera.width}x{camera.height}.")
        if tuple(values.shape[2:]) != last:
            expected = f"height x width{' x 3' if last else ''}"
            remedy = "An alpha has its own place: View(..., alpha=...)." if name == "image" else ""
            raise InputError(f"The {name} of {what} has the shape {tuple(values.shape)}; expected: {expected}.", remedy)
        _validate_values(name, values, what, colour)


def _validate_values(name: str, values: Tensor, what: str, colour: str) -> None:
    if name == "mask":
        if values.dtype != torch.bool:
            raise InputError(f"The mask of {what} is {values.dtype}, not torch.bool.", "True marks valid pixels.")
        return
    if values.dtype == torch.uint8:
        return
    if bool(values.isnan().any()) or (name != "depth" and not bool(values.isfinite().all())):
        raise InputError(f"The {name} of {what} has pixels that are not finite.")
    if name not in ("image", "alpha"):
        return
    low, high = float(values.min()), float(values.max())
    most = math.inf if name == "image" and colour == "linear" else 1.0
    if low < -ROUNDING or high > most + ROUNDING:
        allowed = "from 0 up" if most == math.inf else "in [0, 1], or bytes"
        raise InputError(f"The {name} of {what} has values from {low:.4g} to {high:.4g}.", f"Expected: floats {allowed}.")
