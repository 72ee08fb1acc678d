"""Tight box: the end of a coarse stage, after which a field's lattices span only what is not empty (DVGO, Sun et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import cast

import torch
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Bounds, Field, Quantity, Renderer, Samples
from invgraphics.core.lattice import LatticeField
from invgraphics.errors import InputError
from invgraphics.training.hooks import FitState
from invgraphics.training.milestones import MilestoneHook
from invgraphics.training.penalties import LATTICES
from invgraphics.training.upsample import Moments, change_lattices, resize_lattices


@dataclass(frozen=True)
class TightBoxConfig:
    """One move of a field's region to the bounding box of all voxels that are not empty (DVGO, Sun et al. 2022).

    Contracted space, whose outer voxels reach to infinity, stays whole: there only resolution, moments and rates change.

    Attributes:
        at: progress at which it happens.
        threshold: opacity above which a voxel is not empty.
        scale: edges of the new box over those of the bounding box.
        resolution: vertices along an edge afterwards, in a box of other proportions as many in all; 0: as many as before.
        moments: what becomes of the optimiser's moments: ``drop`` those of lattices, or ``drop_all`` (DVGO: a new optimiser).
        restart_rates: whether all learning rates go back to their start, and take the rest of the fit for their schedules.
    """

    at: float
    threshold: float = 1e-3
    scale: float = 1.05
    resolution: int = 0
    moments: Moments = "drop_all"
    restart_rates: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.at < 1 or not 0 < self.threshold < 1:
            raise ValueError("'at' and 'threshold' lie between 0 and 1.")
        if self.scale < 1 or self.resolution == 1 or self.resolution < 0:
            raise ValueError("'scale' is at least 1, and 'resolution' at least 2 vertices, or 0.")
        if self.moments == "keep":
            raise ValueError("moments of lattices that are elsewhere afterwards cannot be kept: 'drop' or 'drop_all'.")

    def build(self) -> TightBox:
        """The hook."""
        return TightBox(self)


class TightBox(MilestoneHook):
    """Crops the field once; a field that is empty everywhere stays as it is."""

    name = "tight_box"
    requires = LATTICES

    def __init__(self, config: TightBoxConfig) -> None:
        super().__init__((config.at,))
        self._config = config

    @override
    def check_fit(self, field: Field, renderer: Renderer) -> None:
        lattices = cast(LatticeField, field)
        if "geometry" not in lattices.lattice_encodings():
            raise InputError(f"The hook '{self.name}' needs a geometry made of lattices, which this field does not have.")
        if Quantity.DENSITY not in field.provides:
            raise InputError(f"The hook '{self.name}' needs a density, which {type(field).__name__} does not have.")
        if lattices.bounds.space == "box" and not lattices.croppable:
            sentence = f"The hook '{self.name}' crops encodings made of lattices, which the appearance's is not."
            raise InputError(sentence, "Choose another field.appearance.type, or leave the hook out.")

    @override
    def act(self, state: FitState, due: int) -> None:
        field, config = cast(LatticeField, state.field), self._config
        x, y, z = field.lattice_encodings()["geometry"].resolution
        resolution = config.resolution or (x * y * z) ** (1 / 3)
        if field.bounds.space == "box":
            box = occupied_box(state.field, field.bounds, (x, y, z), config.threshold, state.ctx.chunk)
            if box is None:
                return
            change = partial(field.crop, *enlarged(box, config.scale, field.bounds), resolution)
        else:
            change = partial(resize_lattices, field, [resolution] * len(field.lattice_encodings()))
        change_lattices(state, change, config.moments)
        if config.restart_rates:
            state.optimiser.restart(state.ctx.progress)


Box = tuple[Tensor, Tensor]
"""Lowest and highest corner, each (3,), local frame."""


@torch.no_grad()
def occupied_box(field: Field, bounds: Bounds, resolution: tuple[int, int, int], threshold: float, chunk: int) -> Box | None:
    """Bounding box of the voxels at one of whose vertices the opacity along a voxel's edge exceeds ``threshold``.

    Args:
        field: with a density.
        bounds: a box, whose corners the outermost vertices are.
        resolution: vertices along x, y and z.
        threshold: of 1 - exp(-density * edge), with the voxels' geometric mean edge.
        chunk: most points of one query.

    Returns:
        Lowest and highest corner, within ``bounds``; ``None`` where there is no such voxel.
    """
    position = bounds.vertices(resolution)
    density = torch.cat([field.density_no_grad(Samples.at(part)) for part in position.split(chunk)])
    cells = torch.tensor([size - 1 for size in resolution], device=position.device)
    voxel = 2 * bounds.half / cells
    opaque = position[-torch.expm1(-density * voxel.prod().pow(1 / 3)) > threshold]
    if len(opaque) == 0:
        return None
    return (opaque.amin(dim=0) - voxel).maximum(bounds.lo), (opaque.amax(dim=0) + voxel).minimum(bounds.hi)


def enlarged(box: Box, scale: float, within: Bounds) -> Box:
    """Scale a box about its middle, and cut off what leaves ``within``."""
    middle, half = (box[0] + box[1]) / 2, scale * (box[1] - box[0]) / 2
    return (middle - half).maximum(within.lo), (middle + half).minimum(within.hi)
