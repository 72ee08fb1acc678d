"""Features at the vertices of regular grids over some axes of the unit cube: voxels, planes and lines."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import Protocol, runtime_checkable

from invgraphics.core.bounds import Bounds
from invgraphics.errors import InputError, did_you_mean

Combination = Literal["concat", "sum", "vm", "cp"]
"""How the interpolated features of several lattices become one vector.

- ``concat``: one after the other (dense multi-resolution grids).
- ``sum``: added (tri-planes: EG3D, Chan et al. 2022, arXiv 2112.07945, §3.2, up to the factor of its mean).
- ``vm``: products of consecutive pairs, concatenated: xy, z, xz, y, yz, x is the vector-matrix decomposition (TensoRF, Chen et
  al. 2022, arXiv 2203.09517, equation 5), its components not yet summed.
- ``cp``: the product of all: x, y, z is the CANDECOMP/PARAFAC decomposition (equation 4 there), its components not yet summed.
"""

ORIGIN, CORNER = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
"""Lowest and highest corner of the unit cube."""

COMBINATIONS: tuple[str, ...] = get_args(Combination)

Role = Literal["geometry", "appearance"]
"""What a field reads from lattices: density or signed distance, or colour; shared lattices count as geometry."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Features at the vertices of a regular grid that spans some axes of the unit cube.

    An axis of R vertices has them at k / (R - 1), k = 0 .. R - 1, so the first lies at 0 and the last at 1 (`grid_sample`'s
    ``align_corners=True``; DVGO, arXiv 2111.11215; TensoRF). With R = 1 the features are constant along the axis.

    Attributes:
        features: dense: (R_1, .., R_d, c), one dimension per letter of ``axes`` in that order, channels last. With ``links``:
            (n, c), rows that the vertices link to.
        axes: the axes spanned, 1 to 3 different ones of ``x``, ``y`` and ``z``.
        links: row of each vertex, int32 of shape (R_1, .., R_d); -1, or any number that is no row, marks an empty vertex, whose
            features are 0 (Plenoxels, Fridovich-Keil et al. 2022, arXiv 2112.05131, §3.1).
    """

    features: Float[Tensor, "*vertices c"]
    axes: str = "xyz"
    links: Int[Tensor, "*vertices"] | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"(?!.*(.).*\1)[xyz]{1,3}", self.axes):
            raise InputError(f"A lattice's axes are 1 to 3 different letters of 'xyz', not '{self.axes}'.")
        shape, axes = tuple(self.features.shape), len(self.axes)
        if self.links is None and len(shape) != axes + 1:
            raise InputError(f"Features of a lattice over '{self.axes}' have {axes} axes and channels, not the shape {shape}.")
        if self.links is not None:
            self._check_links(self.links)
        if 0 in (*self.resolution, self.channels):
            raise InputError(
                f"A lattice needs a vertex on every axis and a channel, not the shape {(*self.resolution, shape[-1])}."
            )

    def _check_links(self, links: Tensor) -> None:
        if self.features.ndim != 2 or links.ndim != len(self.axes):
            shapes = f"{tuple(self.features.shape)} and {tuple(links.shape)}"
            raise InputError(f"A linked lattice over '{self.axes}' has features (n, c) and one link per vertex, not {shapes}.")
        if links.dtype != torch.int32 or links.device != self.features.device:
            raise InputError("The links of a lattice are int32, on the device of its features.")

    @property
    def resolution(self) -> tuple[int, ...]:
        """Vertices along each of ``axes``."""
        return tuple(self.features.shape[:-1] if self.links is None else self.links.shape)

    @property
    def channels(self) -> int:
        """Features per vertex."""
        return self.features.shape[-1]

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns of a position that ``axes`` name: x is 0, y is 1, z is 2."""
        return tuple("xyz".index(axis) for axis in self.axes)

    @property
    def rows(self) -> Float[Tensor, "n c"]:
        """Features as one row per vertex, or per link; vertices in the order of memory (last axis fastest)."""
        return self.features.reshape(-1, self.channels)


def vertices_along(resolution: float, edges: Sequence[float]) -> tuple[int, int, int]:
    """Vertices along x, y and z of about cubic voxels in a box, as many in all as in a cube (TensoRF, `utils.N_to_reso`).

    Args:
        resolution: vertices along an edge of that cube.
        edges: lengths of the box's edges, in any unit.
    """
    mean = (edges[0] * edges[1] * edges[2]) ** (1 / 3)
    x, y, z = (max(2, round(resolution * edge / mean)) for edge in edges)
    return x, y, z


def resampled(
    features: Float[Tensor, "*vertices c"], size: Sequence[int], lo: Sequence[float] = (), hi: Sequence[float] = ()
) -> Float[Tensor, "*resized c"]:
    """Linear interpolation, axis by axis, of features at ``size`` vertices spread evenly from ``lo`` to ``hi``, ends included.

    Args:
        features: of a dense lattice.
        size: new vertices along each axis.
        lo: where the first lies on each axis, in units of the old lattice's length; empty for 0.
        hi: where the last lies; empty for 1. What reaches beyond the old lattice continues its border.
    """
    for axis, count in enumerate(size):
        first, last = lo[axis] if lo else 0.0, hi[axis] if hi else 1.0
        old = features.shape[axis]
        if (first, last, count) == (0.0, 1.0, old):
            continue
        # In double precision: where new vertices lie on old ones they have their features, to float32.
        place = torch.arange(count, dtype=torch.float64) / max(count - 1, 1) * (last - first) + first
        place = (place * (old - 1)).clamp(0, old - 1)
        below = place.floor().clamp_max(max(old - 2, 0)).long()
        weight = (place - below).to(features.dtype).to(features.device)
        weight = weight.reshape(-1, *[1] * (features.ndim - axis - 1))
        above = (below + 1).clamp_max(old - 1).to(features.device)
        features = torch.lerp(
            features.index_select(axis, below.to(features.device)), features.index_select(axis, above), weight
        )
    return features


def check_lattices(unit: Tensor, lattices: Sequence[Lattice], combine: Combination) -> None:
    """Check that lattices can be encoded together at positions ``unit``.

    Raises:
        InputError: no lattice, an unknown combination, unequal channels in a sum or product, other dtypes or devices.
    """
    if combine not in COMBINATIONS:
        sentence = f"There is no combination '{combine}' of lattices.{did_you_mean(combine, COMBINATIONS)}"
        raise InputError(sentence, f"Known combinations: {', '.join(COMBINATIONS)}.")
    if not lattices or (combine == "vm" and len(lattices) % 2):
        expected = "pairs of lattices" if combine == "vm" else "at least one lattice"
        raise InputError(f"'{combine}' combines {expected}, not {len(lattices)}.")
    if unit.ndim != 2 or unit.shape[1] != 3:
        raise InputError(f"Positions on lattices have the shape (m, 3), not {tuple(unit.shape)}.")
    if any((x.features.dtype, x.features.device) != (unit.dtype, unit.device) for x in lattices):
        raise InputError("Features of lattices and positions have one dtype and lie on one device.")
    channels = [lattice.channels for lattice in lattices]
    groups = {"concat": [], "vm": [channels[k : k + 2] for k in range(0, len(channels), 2)]}.get(combine, [channels])
    if any(len(set(group)) > 1 for group in groups):
        raise InputError(f"'{combine}' needs lattices of as many channels, not {channels}.")


@runtime_checkable
class LatticeEncoding(Protocol):
    """Protocol of encodings made of lattices, beside `core.field.Encoding`.

    Attributes:
        combine: how the lattices' features become one vector.
    """

    combine: Combination

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Vertices of the finest lattice along x, y and z."""
        ...

    def lattices(self) -> tuple[Lattice, ...]:
        """Lattices over the encoding's parameters, whose gradients reach them."""
        ...

    def resize(self, resolution: tuple[int, int, int], lo: Sequence[float] = ORIGIN, hi: Sequence[float] = CORNER) -> None:
        """Replace the parameters, under their names, by interpolated ones of ``resolution`` vertices along x, y and z.

        Corners are aligned (see `Lattice`), so R -> 2R - 1 vertices leave the features unchanged everywhere.

        Args:
            resolution: vertices of the finest lattice.
            lo: lowest corner of the part of the unit cube that the new lattices span.
            hi: its highest corner.
        """
        ...


@runtime_checkable
class SparseGradientModule(Protocol):
    """Protocol of modules whose parameters can have sparse gradients, as those of torch's ``Embedding``.

    Attributes:
        sparse_gradients: whether they may; set by a fit whose optimiser skips entries without gradient.
    """

    sparse_gradients: bool


@runtime_checkable
class LatticeField(Protocol):
    """Protocol of fields with encodings made of lattices."""

    @property
    def bounds(self) -> Bounds:
        """The region that the lattices' unit cube covers."""
        ...

    def lattice_encodings(self) -> dict[Role, LatticeEncoding]:
        """Encodings made of lattices by what is read from them; empty where there is none."""
        ...

    @property
    def croppable(self) -> bool:
        """Whether the region is a box and all encodings are lattices, as `crop` needs."""
        ...

    def crop(self, lo: Float[Tensor, 3], hi: Float[Tensor, 3], resolution: float) -> None:
        """Move the region to the box [lo, hi] and interpolate the lattices there; nothing is left outside.

        Args:
            lo: lowest corner, local frame.
            hi: highest corner.
            resolution: vertices of the finest lattices along the edges of a cube of as many voxels.

        Raises:
            InputError: it is not `croppable`.
        """
        ...
