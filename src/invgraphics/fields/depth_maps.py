"""The training views with their depth maps as a field: nothing is fitted, other views are warped from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Camera, Context, Field, FieldValues, Quantity, Rays, Samples, Scene, View
from invgraphics.core.bounds import Bounds
from invgraphics.core.scene import DepthMaps
from invgraphics.errors import InputError, NotComposableError
from invgraphics.fields.convert import require_density, uniform_rendering_weights

MIN_ALPHA = 0.5
"""Opacity of a ray from which on a fitted field has a depth there (CONVENTIONS.md)."""
RAYS = 2048


@dataclass(frozen=True)
class DepthMapsConfig:
    """Settings of the training views' depth maps.

    Attributes:
        depth: ``scene`` takes the depth that the data set has (for built-in scenes, the truth's); ``field`` renders that of the
            run that ``source`` names.
        source: folder of a run of a density field on the same scene; for ``depth = "field"``.
    """

    title: ClassVar[str] = "photographs with depth"

    depth: Literal["scene", "field"] = "scene"
    source: str = ""

    def __post_init__(self) -> None:
        if (self.depth == "field") != bool(self.source):
            raise ValueError("depth = 'field' needs the folder of a run as 'source', and nothing else does.")

    def build(self, scene: Scene) -> DepthMapField:
        """Take over the training views; with ``depth = "field"`` they show nothing until `converted` is given the field.

        Raises:
            InputError: a training view has no depth, or they differ in size.
        """
        if self.depth == "field":
            return DepthMapField(scene.train, [torch.zeros(view.image.shape[:2]) for view in scene.train])
        missing = [view.name for view in scene.train if view.depth is None]
        if missing:
            raise InputError(
                f"{len(missing)} training views of scene '{scene.name}' have no depth, the first of them {missing[0]}.",
                "Set field.depth = 'field' and field.source to a run of a density field on this scene.",
            )
        return DepthMapField(scene.train, [view.depth for view in scene.train if view.depth is not None])

    def converted(self, source: Field, scene: Scene) -> DepthMapField:
        """The training views with the depth that the density field ``source`` has there.

        Raises:
            InputError: it has no density and radiance.
        """
        require_density(source)
        return DepthMapField(scene.train, [field_depth(source, view.camera, scene.bounds) for view in scene.train])


@torch.no_grad()
def field_depth(field: Field, camera: Camera, bounds: Bounds) -> Float[Tensor, "h w"]:
    """Mean distance at which a density stops the light of each pixel's ray; infinite where alpha is below `MIN_ALPHA`."""
    device = next((parameter.device for parameter in field.parameters()), torch.device("cpu"))
    parts = []
    for rays in camera.rays().chunks(RAYS):
        parts.append(_depth_along(field, rays.to(device), bounds.to(device)).cpu())
    return torch.cat(parts).view(camera.height, camera.width)


def _depth_along(field: Field, rays: Rays, bounds: Bounds) -> Float[Tensor, " n"]:
    samples, weights = uniform_rendering_weights(field, rays, bounds)
    middle = ((samples.t0 + samples.t1) / 2).view_as(weights)
    alpha = weights.sum(dim=1)
    return torch.where(alpha >= MIN_ALPHA, (weights * middle).sum(dim=1) / alpha.clamp_min(MIN_ALPHA), torch.inf)


class DepthMapField(Field):
    """Photographs with depth, all of one size; without parameters. Colour and alpha stay the bytes that most photographs have.

    Args:
        views: the photographs.
        depths: distance along the unit ray of each pixel, infinite or 0 where nothing is hit.

    Attributes:
        depth: these, 0 where nothing is hit or the pixel does not count: what is not finite in a field stops a fit.

    Raises:
        InputError: the photographs differ in size.
    """

    provides = Quantity.DEPTH_MAPS
    rgb: Tensor
    alpha: Tensor
    depth: Tensor
    poses: Tensor
    focal: Tensor
    centre: Tensor

    def __init__(self, views: Sequence[View], depths: Sequence[Float[Tensor, "h w"]]) -> None:
        super().__init__()
        sizes = {view.image.shape[:2] for view in views}
        if len(sizes) > 1:
            remedy = "Give one size with --size WIDTHxHEIGHT."
            raise InputError("Warping by depth needs training views of one size; these differ.", remedy)
        opaque = torch.tensor(255, dtype=torch.uint8).expand(views[0].image.shape[:2])
        self.register_buffer("rgb", _stacked([view.image for view in views]))
        self.register_buffer("alpha", _stacked([opaque if view.alpha is None else view.alpha for view in views]))
        self.register_buffer("depth", torch.stack([_finite(*pair) for pair in zip(views, depths, strict=True)]))
        for name, values in (("poses", "cam_to_world"), ("focal", "focal"), ("centre", "principal_point")):
            self.register_buffer(name, torch.stack([getattr(view.camera, values) for view in views]).detach().clone())

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """Refuse pointwise queries: this field has photographs only."""
        raise NotComposableError(f"DepthMapField has no {want.words()} at points.", "It provides depth_maps.")

    def primitives(self, want: Quantity, ctx: Context) -> DepthMaps:
        """The photographs, each with its depth."""
        if want != Quantity.DEPTH_MAPS:
            return super().primitives(want, ctx)
        height, width = self.depth.shape[1:]
        lenses = zip(self.poses, self.focal, self.centre, strict=True)
        cameras = tuple(Camera(pose, focal, centre, width, height) for pose, focal, centre in lenses)

        def view(index: int) -> View:
            depth = torch.where(self.depth[index] > 0, self.depth[index], torch.inf)
            return View(cameras[index], self.rgb[index], str(index), alpha=self.alpha[index], depth=depth)

        return DepthMaps(cameras, view)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Load tensors, as many photographs as the checkpoint holds: a fit may have seen only some of the scene's.

        Those of earlier versions are floats.
        """
        for name, value in list(self.named_buffers()):
            given = state_dict.get(prefix + name)
            if given is not None and given.ndim == value.ndim:
                setattr(self, name, torch.empty_like(given, device=value.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def stored_bytes(views: Sequence[View]) -> int:
    """Bytes of a `DepthMapField` of photographs, before it is made."""
    each = 1 if all(view.image.dtype == torch.uint8 for view in views) else 4
    return sum((4 * each + 4) * view.camera.width * view.camera.height for view in views)


def _stacked(pictures: Sequence[Tensor]) -> Tensor:
    """Pictures as bytes where all of them are, else as floats in [0, 1]."""
    if all(picture.dtype == torch.uint8 for picture in pictures):
        return torch.stack(list(pictures))
    return torch.stack([picture / 255 if picture.dtype == torch.uint8 else picture.float() for picture in pictures])


def _finite(view: View, depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """A view's depth, 0 where nothing is hit or the pixel does not count."""
    return torch.where(depth.isinf() | ~view.valid(), 0.0, depth)
