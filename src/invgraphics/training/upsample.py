"""Up-sampling of lattices during a fit: coarse to fine, with the optimiser behind it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, cast

from torch import nn
from typing_extensions import override

from invgraphics.core import Field, Renderer
from invgraphics.core.camera import pixel_limit
from invgraphics.core.lattice import LatticeEncoding, LatticeField, resampled, vertices_along
from invgraphics.errors import InputError
from invgraphics.training.hooks import FitState
from invgraphics.training.milestones import MilestoneHook, check_milestones
from invgraphics.training.penalties import LATTICES

Moments = Literal["keep", "drop", "drop_all"]
"""What becomes of Adam's moments when lattices change: interpolated too, dropped with the lattices, or all dropped."""


@dataclass(frozen=True)
class UpsampleConfig:
    """Finer lattices at given points of the fit (DVGO, Plenoxels, TensoRF), of about cubic voxels in the field's box.

    Attributes:
        at: progress of each up-sampling, increasing.
        resolution: vertices along an edge after the last one, in a box of other proportions as many voxels in all. Voxel
            counts grow by the same factor each time (TensoRF).
        resolutions: instead of that, one for each of ``at``.
        moments: ``keep``: the optimiser's moments are interpolated as the lattices are; ``drop``: those of lattices begin anew
            (Plenoxels); ``drop_all``: those of networks too (DVGO, TensoRF: a new optimiser).
        restart_rates: whether all learning rates go back to their start, and take the rest of the fit for their schedules.
        min_spacing: smallest distance of vertices, in pixels of the nearest training camera (`pixel_limit`): finer voxels than
            pictures resolve overfit, and fill with fog. 0: no limit. Lattices that are finer already stay as they are.
    """

    at: tuple[float, ...]
    resolution: int = 0
    resolutions: tuple[int, ...] = ()
    min_spacing: float = 0.0
    moments: Moments = "keep"
    restart_rates: bool = False

    def __post_init__(self) -> None:
        check_milestones(self.at)
        if bool(self.resolution) == bool(self.resolutions):
            raise ValueError("either 'resolution' or 'resolutions' must be given.")
        if self.resolutions and len(self.resolutions) != len(self.at):
            raise ValueError(f"'resolutions' needs one entry for each of the {len(self.at)} in 'at'.")
        if min((self.resolution or 2, *self.resolutions)) < 2:
            raise ValueError("a resolution is at least 2 vertices along an edge.")
        if self.min_spacing < 0:
            raise ValueError("'min_spacing' is a number of pixels, or 0 for no limit.")

    def build(self) -> Upsample:
        """The hook."""
        return Upsample(self)


class Upsample(MilestoneHook):
    """Resizes all lattices of a field at each milestone."""

    name = "upsample"
    requires = LATTICES

    def __init__(self, config: UpsampleConfig) -> None:
        super().__init__(config.at)
        self._config = config

    @override
    def check_fit(self, field: Field, renderer: Renderer) -> None:
        encodings = cast(LatticeField, field).lattice_encodings().values()
        if not encodings:
            raise InputError(f"The hook '{self.name}' needs encodings made of lattices, which this field does not have.")
        linked = any(lattice.links is not None for encoding in encodings for lattice in encoding.lattices())
        if linked and self._config.moments == "keep":
            sentence = "Moments of sparse lattices cannot be kept when these change."
            raise InputError(sentence, "Set moments = 'drop' in the hook.")

    @override
    def act(self, state: FitState, due: int) -> None:
        config = self._config
        field = cast(LatticeField, state.field)
        limit = pixel_limit(field.bounds, state.cameras()) / config.min_spacing if config.min_spacing else math.inf
        sizes = [self._next(encoding, due, limit) for encoding in field.lattice_encodings().values()]
        change_lattices(state, partial(resize_lattices, field, sizes), config.moments)
        if config.restart_rates:
            state.optimiser.restart(state.ctx.progress)

    def _next(self, encoding: LatticeEncoding, due: int, limit: float) -> float:
        """Vertices along an edge of a cube after the ``due``-th up-sampling; from the present ones, which a resumed fit has."""
        now = math.prod(encoding.resolution) ** (1 / 3)
        limit = max(limit, now)
        if self._config.resolutions:
            return min(self._config.resolutions[due - 1], limit)
        share = (due - self.done) / (len(self._config.at) - self.done)
        return now ** (1 - share) * min(self._config.resolution, limit) ** share


def resize_lattices(field: LatticeField, resolutions: Sequence[float]) -> None:
    """Interpolate each encoding at so many vertices along the edges of a cube of as many voxels, about cubic in the region."""
    edges = field.bounds.half.tolist()
    for encoding, resolution in zip(field.lattice_encodings().values(), resolutions, strict=True):
        encoding.resize(vertices_along(resolution, edges))


def change_lattices(state: FitState, change: Callable[[], None], moments: Moments) -> None:
    """Change the field's lattices, and make the optimiser follow the parameters that are other ones afterwards.

    Args:
        state: of the fit.
        change: replaces parameters under their names.
        moments: what becomes of their moments; kept ones are interpolated over the whole lattice, which must be dense.
    """
    before = dict(state.field.named_parameters())
    change()
    for name, parameter in state.field.named_parameters():
        if parameter is not before[name]:
            keep = partial(resampled, size=parameter.shape[:-1]) if moments == "keep" else None
            state.optimiser.replace(f"field.{name}", cast(nn.Parameter, parameter), keep)
    if moments == "drop_all":
        state.optimiser.drop_moments()
