"""Fields: parameterisations of a scene, the quantities that they provide, and encodings of position."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Flag, auto
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from invgraphics.core.bounds import Bounds
from invgraphics.core.fused import FusedLattice
from invgraphics.core.ngp import FusedNGP, FusedSDF
from invgraphics.core.rendering import Context
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.errors import NotComposableError


class Quantity(Flag):
    """Quantities of a field: those at points come from `Field.query`, explicit primitives from `Field.primitives`."""

    NONE = 0
    DENSITY = auto()
    SDF = auto()
    GRADIENT = auto()
    RADIANCE = auto()
    NORMAL = auto()
    FEATURES = auto()
    GAUSSIANS = auto()
    PLANES = auto()
    DEPTH_MAPS = auto()
    MESH = auto()
    POINTS = auto()

    def words(self) -> str:
        """The members in lower case, comma-separated."""
        return ", ".join(str(member.name).lower() for member in self) or "nothing"


@dataclass(frozen=True, eq=False)
class Gaussians:
    """n anisotropic 3D Gaussians, after their activations.

    Attributes:
        means: centres, local frame.
        quaternions: rotations (w, x, y, z); normalised by whoever uses them.
        scales: standard deviations along the rotated axes, > 0, local units.
        opacities: peak opacity in [0, 1].
        sh: real spherical-harmonics coefficients of the colour minus 0.5, k = (degree + 1)^2 of them (3DGS, §2).
    """

    means: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]

    def __len__(self) -> int:
        return len(self.means)


class Field(nn.Module, ABC):
    """A parameterisation of a scene: pointwise quantities, explicit primitives, or both. It never renders itself.

    Attributes:
        provides: the quantities that it can be queried for.
    """

    provides: Quantity

    @abstractmethod
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """Evaluate the quantities ``want`` (within ``provides``) at m samples.

        Differentiable in parameters, positions and directions.
        """

    def query_no_grad(self, samples: Samples, want: Quantity) -> FieldValues:
        """`query` outside the graph, as samplers do it."""
        with torch.no_grad():
            return self.query(samples, want)

    def density_no_grad(self, samples: Samples) -> Float[Tensor, " m"]:
        """Density at m samples, per local length unit, outside the graph."""
        density = self.query_no_grad(samples, Quantity.DENSITY).density
        assert density is not None
        return density

    def support(self, bounds: Bounds, resolution: int) -> Bool[Tensor, "r r r"] | None:
        """Cells of the bounds' unit cube outside which the density is zero, for samplers; ``None`` where it may be anywhere."""
        return None

    def fused(self, bounds: Bounds) -> FusedNGP | FusedLattice | None:
        """Detached parameters over ``bounds`` for fused inference, where a kernel supports such fields; else ``None``."""
        return None

    def fused_sdf(self, bounds: Bounds) -> FusedSDF | None:
        """Detached parameters of the signed distance over ``bounds`` for fused sphere tracing, where a kernel supports it."""
        return None

    @property
    def feature_width(self) -> int | None:
        """Number of features that `query` returns; ``None`` for fields without any."""
        return None

    def primitives(self, want: Quantity, ctx: Context) -> Any:
        """The explicit primitives of this field, such as `Gaussians` for ``GAUSSIANS`` or `DepthMaps` for ``DEPTH_MAPS``.

        Raises:
            NotComposableError: it has none of that kind.
        """
        raise NotComposableError(f"{type(self).__name__} has no {want.words()}.")

    def primitive_count(self) -> int | None:
        """Number of explicit primitives, ``None`` for fields that have none."""
        return None


class Conditional(Field):
    """A field over a class of objects: a code chooses the instance (auto-decoder; DeepSDF, Park et al. 2019, §4).

    Rays of training views show the instance that the view names; others, whose ``view`` is -1, show that of the mean code.

    Attributes:
        codes: one of each instance, learnt.
        subjects: numbers of the instances in the scene, in the order of ``codes``; empty where they have none.
    """

    codes: Float[Tensor, "s c"]
    subjects: tuple[int | None, ...]

    @abstractmethod
    def at(self, code: Float[Tensor, " c"]) -> Field:
        """The field of one instance, which shares the networks."""

    @abstractmethod
    def of_subject(self, subject: int) -> Field:
        """The field of a training instance, by its number in the scene."""

    @abstractmethod
    def with_codes(self, codes: Float[Tensor, "k c"], rows: Int[Tensor, " v"]) -> Conditional:
        """The same networks over other instances.

        Args:
            codes: of k instances; they become its parameter.
            rows: which of them each of v training views shows.
        """

    def mean_code(self) -> Float[Tensor, " c"]:
        """Mean of the training instances' codes, which stands for the class."""
        return self.codes.mean(dim=0)


def resize_to_stored(parameter: Tensor, stored: Tensor) -> None:
    """Resize a parameter to the shape of a stored one that is about to be loaded.

    In place, so that references to the parameter (an optimiser's, for instance) stay valid.
    """
    parameter.data = parameter.new_empty(stored.shape)
    parameter.grad = None


class Encoding(nn.Module, ABC):
    """Maps positions in the unit cube to features.

    Attributes:
        width: number of features.
        needs_covariance: whether `forward` takes the sample's covariance (integrated encodings).
    """

    width: int
    needs_covariance: ClassVar[bool] = False

    @abstractmethod
    def forward(self, unit: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"] | None = None) -> Float[Tensor, "m f"]:
        """Features at ``unit``; ``covariance`` is in unit coordinates and given only if ``needs_covariance``."""
