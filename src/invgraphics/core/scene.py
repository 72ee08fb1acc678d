"""A scene: views with known cameras, and what is known about the world they show."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import Camera
from invgraphics.core.colour import linear_to_srgb
from invgraphics.core.compositing import straight_over
from invgraphics.core.display import contact_sheet, encode_png, figure_html
from invgraphics.core.mesh import Mesh
from invgraphics.core.scan import Scan

Pixels = UInt8[Tensor, "h w c"] | Float[Tensor, "h w c"]

LEAST_SPREAD = 0.01
"""Spread of cameras over the bounds' radius up to which they stand in one place."""


@dataclass(frozen=True, eq=False)
class View:
    """One photograph with its camera.

    Attributes:
        camera: pose in the scene's local frame.
        image: straight (not premultiplied) colour; bytes for 8-bit photographs, float32 for linear scenes.
        name: what the data set calls it.
        alpha: coverage in [0, 1] or bytes; ``None`` means opaque everywhere.
        depth: true distance along the unit ray, local units, inf where nothing is hit; one ray per pixel centre.
        normal: true unit normal, local frame, facing the camera; zero where nothing is hit.
        mask: True where the pixel counts; ``None`` means everywhere.
        ground_truth_pose: the camera's pose before it was degraded on purpose; ``None`` where it was not. For scores only.
        subject: which instance of a class of objects it shows; ``None`` in scenes of one subject.
        landmarks: surface points that it shows, local frame: those of structure from motion whose tracks name it; ``None``
            where nothing is known.
    """

    camera: Camera
    image: Pixels
    name: str
    alpha: UInt8[Tensor, "h w"] | Float[Tensor, "h w"] | None = None
    depth: Float[Tensor, "h w"] | None = None
    normal: Float[Tensor, "h w 3"] | None = None
    mask: Bool[Tensor, "h w"] | None = None
    ground_truth_pose: Float[Tensor, "4 4"] | None = None
    subject: int | None = None
    landmarks: Float[Tensor, "k 3"] | None = None

    @property
    def true_pose(self) -> Float[Tensor, "4 4"]:
        """The best that is known of the camera's pose; fits see ``camera`` only."""
        return self.camera.cam_to_world if self.ground_truth_pose is None else self.ground_truth_pose

    def colour(self, index: Tensor | None = None) -> Float[Tensor, "*p 3"]:
        """Straight colour as floats: the whole image, or the pixels with flat indices ``index`` only."""
        return _floats(self.image.reshape(-1, 3)[index] if index is not None else self.image)

    def opacity(self, index: Tensor | None = None) -> Float[Tensor, "*p"]:
        """Alpha as floats: the whole image, or the pixels with flat indices ``index`` only."""
        if self.alpha is None:
            shape = self.image.shape[:2] if index is None else index.shape
            return torch.ones(shape, device=self.image.device)
        return _floats(self.alpha.reshape(-1)[index] if index is not None else self.alpha)

    def valid(self) -> Bool[Tensor, "h w"]:
        """Which pixels count: the mask, or True everywhere."""
        if self.mask is not None:
            return self.mask
        return torch.ones(self.image.shape[:2], dtype=torch.bool, device=self.image.device)

    def over(self, background: Float[Tensor, 3], index: Tensor | None = None) -> Float[Tensor, "*p 3"]:
        """The photograph in front of ``background``."""
        if self.alpha is None:
            return self.colour(index)
        return straight_over(self.colour(index), self.opacity(index), background)

    def _repr_png_(self) -> bytes:
        """The photograph in a notebook, over white, taken as display sRGB."""
        return encode_png(self.over(torch.ones(3, device=self.image.device)))


def _floats(values: Tensor) -> Tensor:
    return values.float() / 255 if values.dtype == torch.uint8 else values.float()


@dataclass(frozen=True, eq=False)
class DepthMaps:
    """Photographs with depth, each made when it is requested: of many, a picture is warped from a few.

    Attributes:
        cameras: of all of them.
        view: the photograph with an index, and its depth.
    """

    cameras: tuple[Camera, ...]
    view: Callable[[int], View]


@dataclass(frozen=True, eq=False)
class Points:
    """A coloured point cloud, local frame.

    Attributes:
        position: of each point.
        rgb: colours in [0, 1], display sRGB in a `Scene`, the scene's colour space in a field.
        normal: unit normals of the surface; ``None`` where they are not known.
        features: learnt by a field; ``None`` for points that are measured.
        confidence: how sure it is that a surface is there, in [0, 1]; ``None`` where nothing is known.
    """

    position: Float[Tensor, "n 3"]
    rgb: Float[Tensor, "n 3"]
    normal: Float[Tensor, "n 3"] | None = None
    features: Float[Tensor, "n f"] | None = None
    confidence: Float[Tensor, " n"] | None = None

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, rows: Tensor | slice) -> Points:
        """Some of the points, by index or mask."""
        known = {name: value[rows] for name, value in vars(self).items() if value is not None}
        return Points(**known)

    def joined(self, others: Points) -> Points:
        """These points, then the others, with what is known of both."""
        pairs = {name: (value, getattr(others, name)) for name, value in vars(self).items()}
        return Points(**{name: torch.cat(pair) for name, pair in pairs.items() if pair[0] is not None and pair[1] is not None})


@dataclass(frozen=True, eq=False)
class Scene:
    """Posed views in splits, with bounds, background and known geometry: all that a fit and its evaluation use.

    Attributes:
        name: short name.
        train: views to fit.
        val: views to look at during a fit.
        test: views to score; never shares a camera with ``train`` or ``val``.
        observed: of a class of objects, views of the subjects of ``test`` from which these are inferred.
        background: declared background colour for scores, in the scene's colour space.
        bounds: the region to describe, local frame.
        points: known surface points, if any.
        mesh: known surface, if any.
        scan: measured points of the surface, in the data set's world, if any.
        colour: the space of the pixels, in which everything is fitted and composited.
        world_from_local: similarity from the local frame (all cameras, depths, points here) to the data set's world.
        exposure_spread: standard deviation, over the training photographs, of the logarithm of their exposure (display values),
            estimated from pixels that show the same points; ``None`` where it is unknown.
        noise_ceiling: PSNR in dB between two independent half-sample renders of the truth; ``None`` for photographs.
        notes: how the pixels came about (resize filter, undistortion, files skipped), recorded in each run.
        data_bounds: those of the data set, where ``bounds`` is the part of them in which a run was fitted.
    """

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    background: Float[Tensor, 3]
    bounds: Bounds
    val: tuple[View, ...] = ()
    observed: tuple[View, ...] = ()
    points: Points | None = None
    mesh: Mesh | None = None
    scan: Scan | None = None
    colour: Literal["srgb", "linear"] = "srgb"
    world_from_local: Float[Tensor, "4 4"] = field(default_factory=lambda: torch.eye(4))
    exposure_spread: float | None = None
    noise_ceiling: float | None = None
    notes: dict[str, str] = field(default_factory=dict)
    data_bounds: Bounds | None = None

    @property
    def scale(self) -> float:
        """World length of one local unit."""
        return float(torch.linalg.det(self.world_from_local[:3, :3].double()).abs() ** (1 / 3))

    @property
    def has_alpha(self) -> bool:
        """Whether any training view has transparency, so that fits use a random background."""
        return any(view.alpha is not None for view in self.train)

    @property
    def is_interior(self) -> bool:
        """Whether it is seen from within: all training cameras are in the box, or in endless space most look outwards."""
        if not self.train:
            return False
        poses = torch.stack([view.camera.cam_to_world for view in self.train])
        if self.bounds.space == "box":
            return bool(self.bounds.contains(poses[:, :3, 3]).all())
        offset = poses[:, :3, 3] - self.bounds.centre
        outwards = (offset * poses[:, :3, 2]).sum(dim=1)
        near = offset.norm(dim=1) <= 1.001 * self.bounds.half.min()  # the farthest camera is at 1, but for rounding
        return bool(near.all()) and float(outwards.median()) > 0

    @property
    def is_class(self) -> bool:
        """Whether it shows a class of objects: its training views name their subjects."""
        return any(view.subject is not None for view in self.train)

    def of_subject(self, subject: int, views: int | None = None) -> Scene:
        """The scene of one unseen subject: its first ``views`` observed views to fit (``None``: all), its test views."""
        own = {
            split: tuple(replace(v, subject=None) for v in getattr(self, split) if v.subject == subject)
            for split in ("observed", "test")
        }
        return replace(
            self, name=f"{self.name}-{subject}", train=own["observed"][:views], test=own["test"], val=(), observed=()
        )

    @property
    def extent(self) -> float:
        """3DGS's scene extent: 1.1 times the largest distance of a training camera from their mean, local units.

        Where all stand in one place (one photograph, a panorama), it is 1.1 times the bounds' radius instead.
        """
        positions = torch.stack([view.camera.position for view in self.train])
        spread = float((positions - positions.mean(0)).norm(dim=1).max())
        return 1.1 * (spread if spread > LEAST_SPREAD * self.bounds.radius else self.bounds.radius)

    def with_views(self, **views: tuple[View, ...]) -> Scene:
        """The same scene with other views for ``train``, ``val`` or ``test``."""
        return replace(self, **views)

    def digest(self, split: Literal["train", "val", "test"]) -> str:
        """SHA-256 of the split's pixels (colour and alpha), as hexadecimal digits."""
        sha = hashlib.sha256()
        for view in getattr(self, split):
            for values in (view.image, view.alpha):
                if values is not None:
                    sha.update(repr((tuple(values.shape), str(values.dtype))).encode())
                    sha.update(np.ascontiguousarray(values.cpu().numpy()).tobytes())
        return sha.hexdigest()

    def __repr__(self) -> str:
        """The scene's facts on a line: its tensors would fill thousands."""
        return f"Scene({', '.join(f'{key}: {value}' for key, value in self._facts().items())})"

    def _repr_html_(self) -> str:
        """A contact sheet and the scene's facts, in a notebook."""
        pictures = [view.over(self.background).cpu() for view in (*self.train[:12], *self.test[:4])]
        shown = [linear_to_srgb(picture) for picture in pictures] if self.colour == "linear" else pictures
        return figure_html(contact_sheet(shown), self._facts())

    def _facts(self) -> dict[str, str]:
        sizes = {f"{view.camera.width} x {view.camera.height}" for view in (*self.train, *self.test)}
        lo, hi = ([round(value, 3) for value in corner.tolist()] for corner in (self.bounds.lo, self.bounds.hi))
        return {
            "scene": self.name,
            "views": f"{len(self.train)} to fit, {len(self.val)} to watch, {len(self.test)} to score",
            "pixels": ", ".join(sorted(sizes)),
            "bounds": f"{self.bounds.space}, {lo} to {hi}",
            "colour": f"{self.colour}, {'with alpha' if self.has_alpha else 'opaque'}",
            "points": "none" if self.points is None else f"{len(self.points):,}",
        }

    def camera_digest(self) -> str:
        """SHA-256 of all cameras, split by split, views in their order."""
        sha = hashlib.sha256()
        for split in (self.train, self.val, self.test, *([self.observed] if self.observed else [])):
            for view in split:
                camera = view.camera
                for values in (camera.cam_to_world, camera.focal, camera.principal_point):
                    sha.update(values.detach().cpu().double().numpy().tobytes())
                sha.update(f"{camera.width}x{camera.height}".encode())
            sha.update(b"|")
        return sha.hexdigest()


@dataclass(frozen=True, eq=False)
class Batch:
    """What one training step is compared with.

    Attributes:
        target: true colour, already in front of ``background``.
        alpha: true coverage.
        background: colour the prediction must be put in front of: one for all, or one per pixel.
        view: index of the training view, -1 for rays of several views.
        mask: True where the pixel counts; ``None`` where all do, as of rays, which are drawn from such pixels only.
    """

    target: Float[Tensor, "*p 3"]
    alpha: Float[Tensor, "*p"]
    background: Float[Tensor, 3] | Float[Tensor, "*p 3"]
    view: int = -1
    mask: Bool[Tensor, "*p"] | None = None

    def to(self, device: torch.device) -> Batch:
        """Move all tensors."""
        mask = None if self.mask is None else self.mask.to(device)
        return Batch(self.target.to(device), self.alpha.to(device), self.background.to(device), self.view, mask)
