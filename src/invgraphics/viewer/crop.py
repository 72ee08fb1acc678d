"""Crop box: limits what is rendered, without changing the model."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.core import Context, Field, FieldValues, Gaussians, Model, Quantity, RayRenderer, Renderer, Samples
from invgraphics.core.transforms import transform_points


@dataclass(frozen=True)
class CropBox:
    """An axis-aligned box in a run's local frame.

    Attributes:
        lo: lowest corner.
        hi: highest corner.
    """

    lo: tuple[float, float, float]
    hi: tuple[float, float, float]

    @property
    def corners(self) -> Float[Tensor, "8 3"]:
        """All corners, float64; neighbours differ in one bit of the index, x in the highest."""
        return torch.tensor(list(itertools.product(*zip(self.lo, self.hi, strict=True))), dtype=torch.float64)

    def transformed(self, similarity: Float[Tensor, "4 4"]) -> CropBox:
        """The axis-aligned box around the box after ``similarity``."""
        corners = transform_points(similarity.double(), self.corners)
        (x0, y0, z0), (x1, y1, z1) = corners.amin(dim=0).tolist(), corners.amax(dim=0).tolist()
        return CropBox((x0, y0, z0), (x1, y1, z1))

    def contains(self, position: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Whether each position is inside."""
        lo, hi = position.new_tensor(self.lo), position.new_tensor(self.hi)
        return ((position >= lo) & (position <= hi)).all(dim=-1)


class CroppedGaussians(Field):
    """A field without the Gaussians whose centres are outside a box.

    Args:
        field: provides Gaussians.
        crop: in its frame.
    """

    def __init__(self, field: Field, crop: CropBox) -> None:
        super().__init__()
        self.field, self.crop = field, crop
        self.provides = field.provides

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`; not cropped."""
        return self.field.query(samples, want)

    def primitives(self, want: Quantity, ctx: Context) -> Gaussians:
        """The Gaussians inside the box; other primitives as they are."""
        found = self.field.primitives(want, ctx)
        if want != Quantity.GAUSSIANS:
            return found
        inside = self.crop.contains(found.means)
        return Gaussians(*(getattr(found, name)[inside] for name in ("means", "quaternions", "scales", "opacities", "sh")))


def crop_obstacle(renderer: Renderer) -> str:
    """Why images of a renderer cannot be cropped, as a sentence; empty if they can."""
    if Quantity.GAUSSIANS in renderer.requires:
        return ""
    if isinstance(renderer, RayRenderer):
        if Quantity.FEATURES in renderer.requires:
            return f"{type(renderer).__name__} cannot be cropped: it has learnt from rays through all of the scene's box."
        return ""
    return f"{type(renderer).__name__} cannot be cropped: it renders {renderer.requires.words()}, neither Gaussians nor rays."


def crop_note(renderer: Renderer) -> str:
    """How a renderer is cropped, as a sentence."""
    if obstacle := crop_obstacle(renderer):
        return obstacle
    if Quantity.GAUSSIANS in renderer.requires:
        return "Cropped: Gaussians with centres outside are left out; those inside may extend beyond the box."
    return "Cropped: rays are sampled inside the box only."


def crop_model(model: Model, crop: CropBox) -> Model:
    """The model inside a box: Gaussians with centres outside are culled, rays end at the box."""
    culled = Quantity.GAUSSIANS in model.renderer.requires
    corners = model.bounds.lo.new_tensor(crop.lo), model.bounds.lo.new_tensor(crop.hi)
    field = CroppedGaussians(model.field, crop) if culled else model.field
    return Model(field, model.renderer, replace(model.bounds, crop=corners))
