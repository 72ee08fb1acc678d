"""Learning rates of voxels by the number of training views that see them (DVGO, Sun et al. 2022)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Camera
from invgraphics.core.lattice import Lattice, LatticeField
from invgraphics.errors import InputError
from invgraphics.training.hooks import FitState, Hook
from invgraphics.training.penalties import LATTICES

CHUNK = 1 << 14
"""Points that are projected into all cameras at once: few enough for the cache."""


@dataclass(frozen=True)
class ViewRatesConfig:
    """Rates of voxels in proportion to the views that see them: what few see would else overfit them first, as a fog in front
    of their cameras.

    Attributes:
        until: progress from which all voxels have the same rate again (DVGO: the fine stage).
    """

    until: float = 1.0

    def build(self) -> ViewRates:
        """The hook."""
        return ViewRates(self)


class ViewRates(Hook):
    """Sets the optimiser's rates per row for all dense voxel grids, again whenever these have changed.

    It keeps nothing: rates are part of the optimiser's state. Their groups need ``skip_zero``.
    """

    name = "view_rates"
    requires = LATTICES

    def __init__(self, config: ViewRatesConfig) -> None:
        self._config = config

    @override
    def before_step(self, state: FitState) -> None:
        field, optimiser = cast(LatticeField, state.field), state.optimiser
        grids = [lattice for encoding in field.lattice_encodings().values() for lattice in encoding.lattices()]
        if not grids or any(lattice.axes != "xyz" or lattice.links is not None for lattice in grids):
            raise InputError(f"The hook '{self.name}' needs dense voxel grids, which this field is not made of.")
        names = {id(parameter): f"field.{name}" for name, parameter in state.field.named_parameters()}
        counted: dict[tuple[int, ...], Tensor] = {}
        for lattice in grids:
            name = names[id(lattice.features)]
            if state.ctx.progress >= self._config.until:
                optimiser.set_row_rates(name, None)
            elif optimiser.row_rates(name) is None:
                size = lattice.resolution
                if size not in counted:
                    counted[size] = _rates(lattice, field, state.cameras())
                optimiser.set_row_rates(name, counted[size])


def _rates(lattice: Lattice, field: LatticeField, cameras: Sequence[Camera]) -> Float[Tensor, "x y z"]:
    x, y, z = lattice.resolution
    views = view_counts(field.bounds.vertices((x, y, z)), cameras)
    return (views / views.max().clamp_min(1)).reshape(x, y, z)


@torch.no_grad()
def view_counts(points: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Number of cameras in whose picture each point lies."""
    here = [camera.to(points.device) for camera in cameras]
    return torch.cat([_counted(part, here) for part in points.split(CHUNK)])


def _counted(points: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    counts = torch.zeros_like(points[:, 0])
    for camera in cameras:
        image, depth = camera.project(points)
        x, y = image.unbind(dim=1)
        counts += (depth > 0) & (x >= 0) & (y >= 0) & (x <= camera.width) & (y <= camera.height)
    return counts
