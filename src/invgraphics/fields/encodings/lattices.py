"""Encodings whose parameters are lattices: what voxel grids, factors and planes have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from typing_extensions import override

from invgraphics import kernels
from invgraphics.core.field import Encoding, resize_to_stored
from invgraphics.core.lattice import CORNER, ORIGIN, Combination, Lattice, LatticeField, resampled, vertices_along
from invgraphics.errors import InputError

CUBE = (1.0, 1.0, 1.0)
"""Edges of a region whose vertices are spread evenly over the axes."""


class LatticeConfig(ABC):
    """Settings of an encoding by lattices, whose vertices are spread over a region's edges."""

    @abstractmethod
    def build(self, edges: Sequence[float] = CUBE) -> Encoding:
        """The encoding for a region with these edges, initial values drawn from torch's global generator."""


@dataclass(frozen=True)
class Place:
    """Where an encoding keeps a lattice's features.

    Attributes:
        group: what the lattice is: ``levels``, ``planes`` or ``lines``. Its parameter is called ``group.key``.
        key: its name within the group.
        axes: the axes that it spans.
    """

    group: str
    key: str
    axes: str


class LatticeFeatures(Encoding):
    """Multilinear interpolation of features at vertices, combined by `kernels.lattice_encode`.

    Args:
        features: of each lattice, (R_1, .., R_d, c), in the order of the combination.
        combine: how the lattices' features become one vector.
        scale: factor of the combination.

    Attributes:
        width: number of combined features.
        sparse_gradients: whether its parameters may have sparse gradients (see `core.lattice.SparseGradientModule`).
    """

    sparse_gradients: bool = False

    def __init__(
        self, features: Mapping[Place, Float[Tensor, "*vertices c"]], combine: Combination, scale: float = 1.0
    ) -> None:
        super().__init__()
        self.combine: Combination = combine
        self.scale = scale
        self._places = tuple(features)
        for place, values in features.items():
            if not hasattr(self, place.group):
                self.add_module(place.group, nn.ParameterDict())
            self._group(place)[place.key] = nn.Parameter(values)
        channels = [values.shape[-1] for values in features.values()]
        self.width = {"concat": sum(channels), "vm": sum(channels[::2])}.get(combine, channels[0])

    def lattices(self) -> tuple[Lattice, ...]:
        """Its lattices, views of the parameters as they are now; ``scale`` is not in them."""
        return tuple(Lattice(self._group(place)[place.key], place.axes) for place in self._places)

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Vertices along x, y and z, of the finest lattice that spans the axis."""
        sizes = [dict(zip(lattice.axes, lattice.resolution, strict=True)) for lattice in self.lattices()]
        x, y, z = (max(size.get(axis, 1) for size in sizes) for axis in "xyz")
        return x, y, z

    @torch.no_grad()
    def resize(self, resolution: tuple[int, int, int], lo: Sequence[float] = ORIGIN, hi: Sequence[float] = CORNER) -> None:
        """Interpolate all lattices to other numbers of vertices, corners on corners; a level grows as the finest one does.

        The function stays the same where every old vertex is a new one, for instance from R to 2R - 1 vertices. Parameters are
        new ones under the old names.

        Args:
            resolution: vertices along x, y and z of the finest lattices, at least 2.
            lo: lowest corner of the part of the unit cube that the new lattices span.
            hi: its highest corner.

        Raises:
            InputError: fewer than 2 vertices.
        """
        if min(resolution) < 2:
            raise InputError(f"A lattice cannot be resized to {resolution} vertices.", "It needs at least 2 along each axis.")
        old, new = (dict(zip("xyz", sizes, strict=True)) for sizes in (self.resolution, resolution))
        for place, lattice in zip(self._places, self.lattices(), strict=True):
            cells = [
                max(1, round((size - 1) * (new[axis] - 1) / (old[axis] - 1)))
                for axis, size in zip(place.axes, lattice.resolution, strict=True)
            ]
            first, last = ([corner[column] for column in lattice.columns] for corner in (lo, hi))
            values = resampled(lattice.features, [cell + 1 for cell in cells], first, last).clone()
            self._group(place)[place.key] = nn.Parameter(values)

    def forward(self, unit: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"] | None = None) -> Float[Tensor, "m f"]:
        """Features at ``unit``, differentiable twice; ``covariance`` is not used."""
        features = kernels.lattice_encode(unit, self.lattices(), self.combine, self.sparse_gradients)
        return features if self.scale == 1.0 else features * self.scale

    def _group(self, place: Place) -> nn.ParameterDict:
        group = self.get_submodule(place.group)
        assert isinstance(group, nn.ParameterDict)
        return group

    @override
    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Resize to the checkpoint's numbers of vertices first, which a fit may have changed."""
        for place in self._places:
            stored, parameter = state_dict.get(f"{prefix}{place.group}.{place.key}"), self._group(place)[place.key]
            if isinstance(stored, Tensor) and stored.ndim == parameter.ndim and stored.shape[-1] == parameter.shape[-1]:
                resize_to_stored(parameter, stored)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def crop_lattices(field: LatticeField, lo: Float[Tensor, 3], hi: Float[Tensor, 3], resolution: float) -> None:
    """Interpolate a field's encodings at the vertices of the box [lo, hi]; see `core.lattice.LatticeField.crop`.

    Raises:
        InputError: the field is not `croppable`.
    """
    if not field.croppable:
        raise InputError("Only a field in a box, whose encodings are all lattices, can be cropped.")
    corners = field.bounds.to_unit(lo).tolist(), field.bounds.to_unit(hi).tolist()
    for encoding in field.lattice_encodings().values():
        encoding.resize(vertices_along(resolution, (hi - lo).tolist()), *corners)
