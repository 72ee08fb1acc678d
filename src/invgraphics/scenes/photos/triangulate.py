"""SfM points at known poses: SIFT features of the training photographs, matched, verified and triangulated by COLMAP.

What structure from motion would know of a scene whose poses are given. Only training views are read, so that points of fewer
views know nothing of those that were left out.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from PIL import Image
from torch import Tensor

from invgraphics import locks
from invgraphics.arrays import read_arrays
from invgraphics.core import Points, Scene, View
from invgraphics.core.colour import linear_to_srgb, quantise
from invgraphics.errors import InputError
from invgraphics.files import write_arrays, write_text
from invgraphics.scenes.mitsuba import cache

NEIGHBOURS = 20
"""A photograph is matched with as many of its nearest, by position and direction of the camera."""
LONGEST_TRACK_ERROR = 2.0
"""Largest reprojection error of a point, px."""
MANY = 20
"""Number of photographs from which on a triangulation is announced: 60 of 200 px take a minute and a half of two busy cores."""
SCHEMA = 2
"""Rises where the same photographs give other points, or more is known of them."""
DATABASE, PHOTOS, MASKS, PAIRS = "features.db", "photos", "masks", "pairs.txt"


@dataclass(frozen=True, eq=False)
class Triangulated:
    """SfM points of a scene's training photographs.

    Attributes:
        points: in the local frame, with display sRGB colours; empty where nothing is matched.
        observed: of each training view, ascending rows of the points that it shows: those whose tracks name it.
    """

    points: Points
    observed: tuple[Int[Tensor, " k"], ...]

    @staticmethod
    def of(points: Points, tracks: Int[Tensor, "2 m"], views: int) -> Triangulated:
        """From pairs of a view and a point, in any order, of so many views."""
        return Triangulated(points, tuple(tracks[1, tracks[0] == view].sort().values for view in range(views)))

    def arrays(self) -> dict[str, np.ndarray]:
        """As arrays, for the cache."""
        tracks = [torch.stack([torch.full_like(rows, view), rows]) for view, rows in enumerate(self.observed)]
        joined = torch.cat(tracks, dim=1) if tracks else torch.zeros(2, 0, dtype=torch.int64)
        return {"position": self.points.position.numpy(), "rgb": self.points.rgb.numpy(), "tracks": joined.numpy()}


def triangulated(scene: Scene) -> Triangulated:
    """SfM points of a scene's training photographs, from the cache or by `triangulate`; they depend on these and on pycolmap.

    A triangulation of many photographs is announced on stderr. Of several processes that need the same one, one makes it.
    Where the cache cannot be written, stderr says so and the points are returned all the same; a damaged file is replaced.
    """
    known = f"{SCHEMA} {scene.digest('train')} {scene.background.tolist()} {scene.colour} {version('pycolmap')}"
    sha = hashlib.sha256(known.encode())
    for view in scene.train:
        for values in (view.camera.cam_to_world, view.camera.focal, view.camera.principal_point):
            sha.update(values.detach().cpu().double().numpy().tobytes())
        if view.mask is not None:
            sha.update(view.mask.cpu().numpy().tobytes())
    try:
        folder = cache.root().parent / "points"
        folder.mkdir(exist_ok=True)
    except (InputError, OSError):
        return _announced(scene, cached=False)
    path = folder / f"{sha.hexdigest()[:32]}.npz"
    found = _read(path, len(scene.train))
    if found is not None:
        return found
    with ExitStack() as stack:
        try:
            stack.enter_context(locks.locked(path, waiting=lambda holder: None))
        except (InputError, OSError):
            return _announced(scene, cached=False)
        found = _read(path, len(scene.train))
        if found is not None:
            return found
        found = _announced(scene, cached=True)
        try:
            write_arrays(path, found.arrays())
        except (InputError, OSError) as error:
            print(f"The points are not cached: {error}", file=sys.stderr)
        return found


def _read(path: Path, views: int) -> Triangulated | None:
    """Read points from the cache; ``None`` where they are not there, or damaged."""
    try:
        arrays = read_arrays(path) if path.is_file() else {}
        position, rgb, tracks = (torch.from_numpy(arrays[name]) for name in ("position", "rgb", "tracks"))
        return Triangulated.of(Points(position, rgb), tracks, views)
    except (InputError, OSError, KeyError):
        return None


def _announced(scene: Scene, cached: bool) -> Triangulated:
    """Triangulate; before that, what will take a while is printed on stderr, and whether it will be ``cached``."""
    if len(scene.train) >= MANY:
        what = f"{scene.name}: finding points in {len(scene.train)} training photographs (structure from motion)"
        after = "cached afterwards" if cached else "not cached, as the cache cannot be written"
        print(f"{what}; {after}.", file=sys.stderr, flush=True)
    return triangulate(scene)


def triangulate(scene: Scene, seed: int = 0) -> Triangulated:
    """Triangulate SfM points from the training photographs at their known poses (Schönberger & Frahm 2016, §4.3).

    Args:
        scene: with its training views; transparent photographs are put in front of the scene's background, and nothing is found
            where a mask is false.
        seed: of RANSAC.

    Returns:
        Points, their colours the mean over the photographs that see them, and which these are.
    """
    if len(scene.train) < 2:
        none = torch.zeros(2, 0, dtype=torch.int64)
        return Triangulated.of(Points(torch.zeros(0, 3), torch.zeros(0, 3)), none, len(scene.train))
    from invgraphics.scenes.colmap_library import pycolmap

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / PHOTOS).mkdir()
        names = [f"{index:05d}.png" for index in range(len(scene.train))]
        for view, file in zip(scene.train, names, strict=True):
            Image.fromarray(_bytes(view, scene).cpu().numpy()).save(folder / PHOTOS / file)
        reconstruction = _posed(scene.train, names, folder)
        write_text(folder / PAIRS, "".join(f"{names[i]} {names[j]}\n" for i, j in _pairs(scene)))
        _match(folder, seed)
        options = pycolmap.IncrementalPipelineOptions()
        # One thread, because more would add up rounding errors in another order from call to call.
        options.num_threads = 1
        options.random_seed = options.triangulation.random_seed = seed
        (folder / "model").mkdir()
        pycolmap.set_random_seed(seed)
        found = pycolmap.triangulate_points(
            reconstruction, folder / DATABASE, folder / PHOTOS, folder / "model", options=options
        )
        found.extract_colors_for_all_images(folder / PHOTOS)
    points = [found.points3D[key] for key in sorted(found.points3D)]
    points = [point for point in points if point.error <= LONGEST_TRACK_ERROR]
    position = np.array([point.xyz for point in points]).reshape(-1, 3)
    rgb = np.array([point.color for point in points]).reshape(-1, 3) / 255
    # Photographs are numbered from 1 in their order; one may show a point twice.
    seen = sorted({(part.image_id - 1, row) for row, point in enumerate(points) for part in point.track.elements})
    tracks = torch.tensor(seen, dtype=torch.int64).reshape(-1, 2).T
    return Triangulated.of(Points(torch.from_numpy(position).float(), torch.from_numpy(rgb).float()), tracks, len(scene.train))


def _bytes(view: View, scene: Scene) -> torch.Tensor:
    colour = view.over(scene.background.to(view.image.device))
    return quantise(linear_to_srgb(colour) if scene.colour == "linear" else colour)


def _posed(views: Sequence[View], names: Sequence[str], folder: Path) -> Any:
    """Write cameras, photographs and features into the data base; returns the known poses as a reconstruction."""
    from invgraphics.scenes.colmap_library import pycolmap

    with pycolmap.Database.open(folder / DATABASE):  # makes it
        pass
    reconstruction = pycolmap.Reconstruction()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = max(1, torch.get_num_threads())
    for number, (view, name) in enumerate(zip(views, names, strict=True), 1):
        camera = view.camera
        params = [*camera.focal.tolist(), *camera.principal_point.tolist()]
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model, reader.camera_params = "PINHOLE", ", ".join(map(repr, params))
        pycolmap.import_images(folder / DATABASE, folder / PHOTOS, pycolmap.CameraMode.PER_IMAGE, [name], reader)
        with pycolmap.Database.open(folder / DATABASE) as database:
            image = next(one for one in database.read_all_images() if one.name == name)
        model = pycolmap.Camera(
            model="PINHOLE", width=camera.width, height=camera.height, params=params, camera_id=image.camera_id
        )
        reconstruction.add_camera_with_trivial_rig(model)
        pose = np.linalg.inv(camera.cam_to_world.detach().cpu().double().numpy())
        rigid = pycolmap.Rigid3d(pose[:3])
        reconstruction.add_image_with_trivial_frame(pycolmap.Image(name, [], image.camera_id, image.image_id), rigid)
        assert image.image_id == number, "photographs are numbered in their order"
    reader = pycolmap.ImageReaderOptions()
    if any(view.mask is not None for view in views):
        _write_masks(views, names, folder / MASKS)
        reader.mask_path = str(folder / MASKS)
    mode = pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(folder / DATABASE, folder / PHOTOS, list(names), mode, reader, extraction)
    return reconstruction


def _write_masks(views: Sequence[View], names: Sequence[str], folder: Path) -> None:
    """Write a mask for each photograph, as COLMAP names them: white where features may be found."""
    folder.mkdir()
    for view, name in zip(views, names, strict=True):
        Image.fromarray(view.valid().cpu().numpy().astype(np.uint8) * 255).save(folder / f"{name}.png")


def _match(folder: Path, seed: int) -> None:
    from invgraphics.scenes.colmap_library import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = max(1, torch.get_num_threads())
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / PAIRS
    pycolmap.match_image_pairs(folder / DATABASE, matching, pairing, geometry)


def _pairs(scene: Scene) -> list[tuple[int, int]]:
    """Pairs of photographs whose cameras are near each other: position in units of the scene's extent, and direction."""
    poses = torch.stack([view.camera.cam_to_world.double() for view in scene.train])
    features = torch.cat([poses[:, :3, 3] / scene.extent, poses[:, :3, 2]], dim=1)
    order = torch.cdist(features, features).argsort(dim=1)[:, 1 : NEIGHBOURS + 1]
    return sorted({(min(i, j), max(i, j)) for i, row in enumerate(order.tolist()) for j in row})
