"""Loader of a rendered scene: the folder that `invgraphics.scenes.mitsuba.make` fills and ``truth.json`` describes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from invgraphics.arrays import read_arrays
from invgraphics.core import Bounds, Camera, Mesh, Points, Scene, View
from invgraphics.core.believable import FARTHEST
from invgraphics.errors import InputError
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.mitsuba import cache, ply
from invgraphics.scenes.npz import Npz
from invgraphics.scenes.pictures.images import Photo
from invgraphics.scenes.pictures.resize import RESIZE
from invgraphics.scenes.pictures.views import load_view
from invgraphics.scenes.poses import pose
from invgraphics.scenes.region import near_plane

LINEAR_RESIZE = "area average of linear light"
"""The filter from a larger rendering to the folder's pictures, see `invgraphics.scenes.mitsuba.average`."""

POINTS = "exact surface points that the training views see, with true colours: better than any method could find"
"""What a rendered scene's points are, in its notes."""

_DAMAGED = "Make the scene again: `invgraphics make-scene`."


class Truth:
    """Loader of rendered scenes; the local frame is the renderer's world, +z up."""

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is a folder with a ``truth.json``."""
        return (path / cache.TRUTH).is_file()

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load a rendered scene: pictures with alpha, depth, normals, points and mesh.

        Another size than the rendered is area-averaged; depth and normals, which belong to pixel centres, are then left out.

        Raises:
            InputError: a file is missing, cut short or inconsistent.
        """
        truth = cache.read_truth(path)
        if truth is None:
            raise InputError(f"{path} is not a whole rendered scene: truth.json or a file it lists is damaged.", _DAMAGED)
        try:
            return _class_scene(path, truth, options) if cache.INSTANCES in truth else self._scene(path, truth, options)
        except (AttributeError, IndexError, KeyError, OSError, OverflowError, RuntimeError, TypeError, ValueError) as error:
            raise InputError(f"{path} is damaged: {type(error).__name__} {error}.", _DAMAGED) from error

    def _scene(self, path: Path, truth: Mapping[str, Any], options: SceneOptions) -> Scene:
        wanted = {"train": options.train_views, "val": None, "test": options.test_views}
        # The first ones, which lie evenly (`mitsuba.rig.cameras`): those that a rendering of fewer would have.
        views = {
            split: tuple(
                _view(path, split, index, table, options) for index, table in enumerate(truth["cameras"][split][:count])
            )
            for split, count in wanted.items()
        }
        # Points are made from the depth of all training views: with fewer, they would leak views that are left out.
        known = _points(path / "points.npz")
        points = known if len(views["train"]) == len(truth["cameras"]["train"]) else None
        return Scene(
            name=truth["name"],
            train=views["train"],
            val=views["val"],
            test=views["test"],
            background=torch.tensor(truth["background"] or [0.0, 0.0, 0.0]),
            bounds=_bounds(path, truth, known),
            points=points,
            mesh=_mesh(path / "mesh.ply"),
            noise_ceiling=_noise_ceiling(truth, views["train"][0].camera),
            notes=_notes(truth, views["train"][0]) | ({"points": POINTS} if points is not None else {}),
        )


def _bounds(path: Path, truth: Mapping[str, Any], points: Points | None) -> Bounds:
    """The described box; if all training cameras are in it, with a near plane before the nearest points.

    Of all cameras, however many are loaded: a near plane belongs to a data set, as its lenses do.
    """
    bounds = Bounds(torch.tensor(truth["bounds"]["lo"]), torch.tensor(truth["bounds"]["hi"]))
    if points is None:
        return bounds
    poses = torch.stack([pose(camera["cam_to_world"], f"{path}") for camera in truth["cameras"]["train"]]).float()
    near = near_plane(poses, points.position) if bool(bounds.contains(poses[:, :3, 3]).all()) else None
    return bounds if near is None else replace(bounds, near=near)


def _class_scene(path: Path, truth: Mapping[str, Any], options: SceneOptions) -> Scene:
    """The scene of a class of objects: its data set, under the name and with the notes of its description."""
    scene = Npz().load(path / cache.VIEWS, options)
    count = truth[cache.INSTANCES]
    notes = _notes(truth, scene.train[0]) | {
        key: scene.notes[key] for key in ("train_views", "test_views", "geometry") if key in scene.notes
    }
    notes["instances"] = f"{count['train']} to fit, {count['unseen']} unseen with {count['observed']} observed views each"
    background = scene.background if truth["background"] is None else torch.tensor(truth["background"])
    return replace(scene, name=truth["name"], background=background, noise_ceiling=truth["noise_ceiling"], notes=notes)


def _noise_ceiling(truth: Mapping[str, Any], camera: Camera) -> float | None:
    """Noise level of pictures of a camera's size: noise of rendered pixels is independent, so that averages have less."""
    rendered = truth["cameras"]["train"][0]
    if truth["noise_ceiling"] is None:
        return None
    return truth["noise_ceiling"] + 10 * math.log10(rendered["width"] * rendered["height"] / (camera.width * camera.height))


def _view(path: Path, split: str, index: int, table: Mapping[str, Any], options: SceneOptions) -> View:
    name = f"{index:04d}"
    picture = path / split / f"{name}.png"
    focal, centre = (torch.tensor(table[key], dtype=torch.float64) for key in ("focal", "centre"))
    camera = Camera(pose(table["cam_to_world"], f"{picture}"), focal, centre, table["width"], table["height"])
    view = load_view(Photo(picture, camera, name), options.size)
    if (view.camera.width, view.camera.height) != (camera.width, camera.height):
        return view
    shape, file = (camera.height, camera.width), picture.with_suffix(".npz")
    arrays = read_arrays(file)
    depth, normal = (
        _floats(arrays["depth"], shape, f"depth of {file}"),
        _floats(arrays["normal"], (*shape, 3), f"normal of {file}"),
    )
    # Fog has no surface: its truth is in the pictures only.
    return replace(view, depth=depth, normal=normal) if bool(depth.isfinite().any()) else view


def _points(path: Path) -> Points | None:
    if not path.is_file():
        return None
    arrays = read_arrays(path)
    position = _floats(arrays["position"], (len(arrays["position"]), 3), f"position of {path}")
    rgb = _floats(arrays["rgb"], (len(position), 3), f"rgb of {path}")
    if not bool(((rgb >= 0) & (rgb <= 1)).all()):
        raise ValueError(f"colours of {path} are not in [0, 1]")
    return Points(position, rgb)


def _mesh(path: Path) -> Mesh | None:
    if not path.is_file():
        return None
    vertices, faces = ply.read(path)
    if not (np.abs(vertices) <= FARTHEST).all() or (len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices)):
        raise ValueError(f"{path} has vertices that are not finite, or faces without vertices")
    return Mesh(torch.from_numpy(vertices), torch.from_numpy(faces))


def _floats(values: np.ndarray, shape: tuple[int, ...], what: str) -> torch.Tensor:
    """An array of floating-point numbers of a shape, as float32."""
    if values.dtype.kind != "f" or values.shape != shape:
        raise ValueError(f"the {what} is {values.dtype} of shape {values.shape}")
    return torch.from_numpy(values).float()


def _notes(truth: Mapping[str, Any], view: View) -> dict[str, str]:
    final = (view.camera.width, view.camera.height)
    samples = ", ".join(f"{split} {count}" for split, count in truth["samples_per_pixel"].items())
    if cache.AVERAGED_FROM in truth:
        own = ", ".join(f"{split} {count}" for split, count in truth[cache.AVERAGED_FROM]["samples_per_pixel"].items())
        samples += f" (averaged; of each rendered pixel: {own})"
    return {
        "loader": "truth",
        "summary": truth["summary"],
        "stresses": truth["stresses"],
        "renderer": f"Mitsuba {truth['versions']['mitsuba']} ({truth['variant']}), seed {truth['seed']}",
        "samples_per_pixel": samples,
        "rig": truth["rig"]["kind"],
        "resize": "; then ".join(_resizes(truth, final)) or "none",
    }


def _resizes(truth: Mapping[str, Any], final: tuple[int, int]) -> list[str]:
    """Describe how pictures were resized: from a larger rendering to the folder's size, and to the view's."""
    width, height = truth["size"]
    source = truth.get(cache.AVERAGED_FROM)
    steps = [] if source is None else [f"{LINEAR_RESIZE}, {source['size'][0]}x{source['size'][1]} to {width}x{height}"]
    return steps if final == (width, height) else [*steps, f"{RESIZE}, {width}x{height} to {final[0]}x{final[1]}"]
