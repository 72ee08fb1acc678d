"""Anisotropic 3D Gaussians with spherical-harmonics colour (3DGS, Kerbl et al. 2023)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from invgraphics.core import harmonics
from invgraphics.core.bounds import Bounds
from invgraphics.core.colour import srgb_to_linear
from invgraphics.core.field import Field, Gaussians, Quantity
from invgraphics.core.rendering import Context
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Points, Scene
from invgraphics.errors import InputError, NotComposableError
from invgraphics.fields.transformed import move_gaussians

NEIGHBOURS = 3
"""A Gaussian starts as wide as the mean distance to this many nearest neighbours (3DGS, §5.1)."""
FAR_SHARE = 0.2
"""Share of random points that goes outside the inner box of a contracted space."""
FAR_REACH = 30.0
"""How far out those go, in half-extents of the box; log-uniformly, so that every shell gets its share."""
SCALE_RANGE = (1e-5, 0.5)
"""Limits of a starting scale, relative to the scene's radius (or to the distance from its centre, where that is larger)."""

PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
"""Names of a `GaussianField`'s parameters; the first axis of each is the primitive."""


@dataclass(frozen=True)
class GaussianFieldConfig:
    """How a set of Gaussians starts.

    Attributes:
        sh_degree: degree of the colour's spherical harmonics, 0 to 3.
        count: random Gaussians where the scene has no points, or ``init`` is ``random``.
        init: start from the scene's points, or at random in its bounds.
        max_init: most of the scene's points to start from; a random subset if there are more.
        opacity: opacity at the start.
        scale_factor: multiplies the starting scales.
        isotropic: whether all three axes of a Gaussian stay equal.
    """

    sh_degree: int = 3
    count: int = 10_000
    init: Literal["scene", "random"] = "scene"
    max_init: int = 100_000
    opacity: float = 0.1
    scale_factor: float = 1.0
    isotropic: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.sh_degree <= harmonics.MAX_DEGREE:
            raise ValueError(f"sh_degree must be from 0 to {harmonics.MAX_DEGREE}, not {self.sh_degree}.")
        if self.count < 1 or self.max_init < 1:
            raise ValueError("count and max_init must be at least 1.")
        if not 0 < self.opacity < 1:
            raise ValueError(f"opacity must lie between 0 and 1, not be {self.opacity}.")
        if not self.scale_factor > 0:
            raise ValueError(f"scale_factor must be positive, not {self.scale_factor}.")

    def build(self, scene: Scene) -> GaussianField:
        """The Gaussians that a fit of ``scene`` starts from; randomness comes from torch's global generator.

        Raises:
            InputError: the scene's point cloud is empty or not finite.
        """
        if self.init == "scene" and scene.points is not None:
            points = _subset(_checked(scene.points, scene.name), self.max_init)
        else:
            points = random_points(scene.bounds, self.count)
        rgb = srgb_to_linear(points.rgb) if scene.colour == "linear" else points.rgb
        n = len(points)
        scales = starting_scales(points.position, scene.bounds) * self.scale_factor
        logit = torch.logit(torch.tensor(self.opacity))
        tensors = {
            "means": points.position.clone(),
            "quaternions": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
            "log_scales": scales.log()[:, None].repeat(1, 3),
            "opacity_logits": logit.repeat(n),
            "sh_dc": ((rgb - 0.5) / harmonics.BAND_0)[:, None, :],
            "sh_rest": torch.zeros(n, harmonics.count(self.sh_degree) - 1, 3),
        }
        return GaussianField(tensors, self.isotropic)


class GaussianField(Field):
    """n Gaussians. Parameters are stored before activation; `primitives` activates them.

    Args:
        tensors: one per name in `PARAMETERS`, all with n rows.
        isotropic: whether all three axes of a Gaussian are kept equal (their mean log-scale counts).
    """

    provides = Quantity.GAUSSIANS
    means: Tensor
    quaternions: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    sh_active: Tensor

    def __init__(self, tensors: Mapping[str, Tensor], isotropic: bool = False) -> None:
        super().__init__()
        self.isotropic = isotropic
        for name in PARAMETERS:
            setattr(self, name, nn.Parameter(tensors[name]))
        self.register_buffer("sh_active", torch.tensor(self.sh_degree))

    @property
    def sh_degree(self) -> int:
        """Degree of the coefficients that are stored."""
        return harmonics.degree_of(1 + self.sh_rest.shape[1])

    @property
    def active_degree(self) -> int:
        """Degree of the bands in use, at most ``sh_degree``; saved with the field."""
        return int(self.sh_active)

    @active_degree.setter
    def active_degree(self, degree: int) -> None:
        if not 0 <= degree <= self.sh_degree:
            raise ValueError(f"active_degree must be from 0 to {self.sh_degree}, not {degree}.")
        self.sh_active.fill_(degree)

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """Gaussians have no pointwise reading here."""
        raise NotComposableError(f"GaussianField has no {want.words()} at points.", "It provides gaussians.")

    def primitives(self, want: Quantity, ctx: Context) -> Gaussians:
        """The activated Gaussians, with the active bands of their colour."""
        if want != Quantity.GAUSSIANS:
            return super().primitives(want, ctx)
        return self._gaussians(harmonics.count(self.active_degree))

    def primitive_count(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @torch.no_grad()
    def replace(self, tensors: Mapping[str, Tensor]) -> None:
        """Swap all parameters for new ones, of any common number of rows. An optimiser must be told.

        Raises:
            ValueError: a name is missing or unknown, the numbers of rows differ, or a row has another shape than before.
        """
        if set(tensors) != set(PARAMETERS):
            raise ValueError(f"replace needs exactly {', '.join(PARAMETERS)}; got {', '.join(tensors)}.")
        if len({len(tensor) for tensor in tensors.values()}) != 1:
            raise ValueError("replace needs the same number of rows in every tensor.")
        for name, tensor in tensors.items():
            old = getattr(self, name)
            if tensor.shape[1:] != old.shape[1:]:
                raise ValueError(f"rows of {name} have shape {tuple(old.shape[1:])}, not {tuple(tensor.shape[1:])}.")
            setattr(self, name, nn.Parameter(tensor.detach(), requires_grad=old.requires_grad))

    @torch.no_grad()
    def transformed(self, similarity: Float[Tensor, "4 4"]) -> GaussianField:
        """A copy of this field moved by a similarity, colours included.

        Raises:
            InputError: the matrix is no similarity.
        """
        moved = move_gaussians(self._gaussians(harmonics.count(self.sh_degree)), similarity.to(self.means))
        tensors = {
            "means": moved.means,
            "quaternions": moved.quaternions,
            "log_scales": moved.scales.log(),
            "opacity_logits": self.opacity_logits.clone(),
            "sh_dc": moved.sh[:, :1].clone(),
            "sh_rest": moved.sh[:, 1:].clone(),
        }
        field = GaussianField(tensors, self.isotropic)
        field.active_degree = self.active_degree
        return field

    def _gaussians(self, coefficients: int) -> Gaussians:
        log_scales = self.log_scales.mean(dim=1, keepdim=True).expand(-1, 3) if self.isotropic else self.log_scales
        return Gaussians(
            means=self.means,
            quaternions=self.quaternions,
            scales=log_scales.exp(),
            opacities=self.opacity_logits.sigmoid(),
            sh=torch.cat([self.sh_dc, self.sh_rest[:, : coefficients - 1]], dim=1),
        )

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Resize to the checkpoint's number of Gaussians first, which density control may have changed."""
        for name in PARAMETERS:
            stored, parameter = state_dict.get(prefix + name), getattr(self, name)
            if isinstance(stored, Tensor) and stored.shape[1:] == parameter.shape[1:] and len(stored) != len(parameter):
                # Resized in place, so that whoever holds the parameter still holds it after loading.
                parameter.data = parameter.new_empty(stored.shape)
                parameter.grad = None
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def starting_scales(positions: Float[Tensor, "n 3"], bounds: Bounds) -> Float[Tensor, " n"]:
    """Mean distance to the nearest neighbours, kept within `SCALE_RANGE`."""
    from scipy.spatial import KDTree

    reach = (positions - bounds.centre).norm(dim=1).clamp_min(bounds.radius)
    if len(positions) == 1:
        return SCALE_RANGE[1] * reach
    neighbours = min(NEIGHBOURS, len(positions) - 1)
    points = positions.detach().double().cpu().numpy()
    distances, _ = KDTree(points).query(points, k=neighbours + 1)
    mean = torch.from_numpy(distances[:, 1:]).mean(dim=1).to(positions)
    return mean.clamp(SCALE_RANGE[0] * reach, SCALE_RANGE[1] * reach)


def random_points(bounds: Bounds, count: int) -> Points:
    """Uniform points of random colour in the box; in a contracted space some of them on shells far around it."""
    x = torch.rand(count, 3) * 2 - 1
    if bounds.space == "contracted":
        far = round(FAR_SHARE * count)
        shell = nn.functional.normalize(torch.randn(far, 3), dim=1)
        x[:far] = shell * FAR_REACH ** torch.rand(far, 1)
    return Points(bounds.centre + x * bounds.half, torch.rand(count, 3))


def _checked(points: Points, scene: str) -> Points:
    if len(points) == 0:
        remedy = "Set the field's init = 'random', or give the scene points."
        raise InputError(f"The point cloud of scene '{scene}' is empty, so there is nothing to start Gaussians from.", remedy)
    for name in ("position", "rgb"):
        bad = int((~torch.isfinite(getattr(points, name))).any(dim=1).sum())
        if bad:
            remedy = "Remove them, or set the field's init = 'random'."
            raise InputError(f"The point cloud of scene '{scene}': {bad} points have a {name} that is not finite.", remedy)
    return points


def _subset(points: Points, most: int) -> Points:
    if len(points) <= most:
        return points
    keep = torch.randperm(len(points))[:most]
    return Points(points.position[keep], points.rgb[keep])
