"""Anisotropic 3D Gaussians with spherical-harmonics colour (3DGS, Kerbl et al. 2023)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from invgraphics.core import harmonics
from invgraphics.core.field import Field, Gaussians, Quantity, resize_to_stored
from invgraphics.core.rendering import Context
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Points, Scene
from invgraphics.errors import NotComposableError
from invgraphics.fields.convert import visible_points
from invgraphics.fields.gaussian_density import query_density
from invgraphics.fields.starting import (
    backdrop_points,
    initial_points,
    starting_scales,
)

PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
"""Names of a `GaussianField`'s parameters; the first axis of each is the primitive."""


@dataclass(frozen=True)
class GaussianFieldConfig:
    """Settings of a set of Gaussians and its initialisation.

    Attributes:
        sh_degree: degree of the colour's spherical harmonics, 0 to 3.
        count: random Gaussians where the scene has no points, or ``init`` is ``random``.
        init: start from the scene's points, from points that multi-view ``stereo`` finds in the training photographs (see
            `stereo_points`), at random in its bounds, from the training views' depth maps, or from the fitted ``field`` of the
            run that ``source`` names.
        source: folder of a run of a density field on the same scene; for ``init = "field"``.
        max_init: most points to start from; a random subset if there are more.
        backdrop: in endless space, Gaussians that start behind the subject besides those, in the colours of opaque training
            photographs (see `backdrop_points`); for ``init`` ``scene``, ``stereo`` and ``random``.
        opacity: opacity at the start.
        scale_factor: multiplies the starting scales.
        isotropic: whether all three axes of a Gaussian stay equal.
        dropout: share of Gaussians left out of a training step at the fit's end, rising linearly from none; the others absorb
            as much more (DropGaussian, Park et al. 2025). Against learning few photographs by heart.
        dropout_views: most training photographs with which Gaussians are left out; 0 for any number.
    """

    title: ClassVar[str] = "anisotropic 3D Gaussians"

    sh_degree: int = 3
    count: int = 10_000
    init: Literal["scene", "stereo", "random", "depth", "field"] = "scene"
    source: str = ""
    max_init: int = 100_000
    backdrop: int = 0
    opacity: float = 0.1
    scale_factor: float = 1.0
    isotropic: bool = False
    dropout: float = 0.0
    dropout_views: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.sh_degree <= harmonics.MAX_DEGREE:
            raise ValueError(f"sh_degree must be from 0 to {harmonics.MAX_DEGREE}, not {self.sh_degree}.")
        if self.count < 1 or self.max_init < 1:
            raise ValueError("count and max_init must be at least 1.")
        if self.backdrop < 0:
            raise ValueError(f"backdrop must not be negative, not {self.backdrop}.")
        if not 0 < self.opacity < 1:
            raise ValueError(f"opacity must lie between 0 and 1, not be {self.opacity}.")
        if not self.scale_factor > 0:
            raise ValueError(f"scale_factor must be positive, not {self.scale_factor}.")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be at least 0 and below 1, not {self.dropout}.")
        if self.dropout_views < 0:
            raise ValueError(f"dropout_views must not be negative, not {self.dropout_views}.")
        if (self.init == "field") != bool(self.source):
            raise ValueError("init = 'field' needs the folder of a run as 'source', and nothing else does.")

    def capped(self, most: int) -> GaussianFieldConfig:
        """Limit the initial number of Gaussians to ``most``; backdrop points are dropped first."""
        count, max_init = min(self.count, most), min(self.max_init, most)
        return replace(self, count=count, max_init=max_init, backdrop=min(self.backdrop, most - max(count, max_init)))

    def build(self, scene: Scene) -> GaussianField:
        """Initialise the Gaussians for ``scene``; randomness comes from torch's global generator.

        With ``init = "field"`` they are random until `converted` is given the field.

        Raises:
            InputError: the scene's point cloud is empty or not finite, or there are no depth maps.
        """
        points = initial_points(scene, self.init, self.count, self.max_init)
        if self.init not in ("depth", "field"):
            points = points.joined(backdrop_points(scene, self.backdrop))
        return self.from_points(points, scene)

    def converted(self, source: Field, scene: Scene) -> GaussianField:
        """Initialise Gaussians by conversion of the density field ``source``, where the training views see it.

        Raises:
            InputError: it has no density and radiance, or is empty.
        """
        return self.from_points(visible_points(source, scene, self.max_init), scene)

    def from_points(self, points: Points, scene: Scene) -> GaussianField:
        """Initialise one Gaussian per point, coloured in the scene's colour space, scaled by its neighbours' distances."""
        n = len(points)
        scales = starting_scales(points.position, scene.bounds) * self.scale_factor
        logit = torch.logit(torch.tensor(self.opacity))
        tensors = {
            "means": points.position.clone(),
            "quaternions": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
            "log_scales": scales.log()[:, None].repeat(1, 3),
            "opacity_logits": logit.repeat(n),
            "sh_dc": harmonics.constant(points.rgb),
            "sh_rest": torch.zeros(n, harmonics.count(self.sh_degree) - 1, 3),
        }
        few = not self.dropout_views or len(scene.train) <= self.dropout_views
        return GaussianField(tensors, self.isotropic, self.dropout if few else 0.0)


GAUSSIAN_QUANTITIES = Quantity.GAUSSIANS | Quantity.DENSITY | Quantity.RADIANCE | Quantity.NORMAL


class GaussianField(Field):
    """n Gaussians. Parameters are stored before activation; `primitives` activates them.

    The buffer ``smoothing`` holds the standard deviation, in local units, of an isotropic filter that every Gaussian is seen
    through (Mip-Splatting, §5.1): 0 where there is none. `primitives` has it applied.

    Args:
        tensors: one per name in `PARAMETERS`, all with n rows.
        isotropic: whether all three axes of a Gaussian are kept equal (their mean log-scale counts).
        dropout: share of Gaussians left out of a training step at the end of a fit, by renderers of `primitives` only.
    """

    provides = GAUSSIAN_QUANTITIES
    means: Tensor
    quaternions: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    sh_active: Tensor
    smoothing: Tensor

    def __init__(self, tensors: Mapping[str, Tensor], isotropic: bool = False, dropout: float = 0.0) -> None:
        super().__init__()
        self.isotropic = isotropic
        self.dropout = dropout
        for name in PARAMETERS:
            setattr(self, name, nn.Parameter(tensors[name]))
        self.register_buffer("sh_active", torch.tensor(self.sh_degree))
        self.register_buffer("smoothing", torch.zeros(len(self.means)))

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
        """The Gaussians as one density in space, by the ``physical`` convention for their opacities (`query_density`).

        Raises:
            NotComposableError: something else than density, radiance and normal is wanted.
        """
        if lacking := want & ~self.provides:
            raise NotComposableError(f"GaussianField has no {lacking.words()} at points.")
        return query_density(self._smoothed(self._gaussians(harmonics.count(self.active_degree))), samples, want)

    def primitives(self, want: Quantity, ctx: Context) -> Gaussians:
        """The activated, smoothed Gaussians with the active SH bands; in training, with dropout applied to their opacities."""
        if want != Quantity.GAUSSIANS:
            return super().primitives(want, ctx)
        return self._with_dropout(self._smoothed(self._gaussians(harmonics.count(self.active_degree))), ctx)

    def primitive_count(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @torch.no_grad()
    def filter_attenuation(self) -> Float[Tensor, " n"]:
        """Factor in (0, 1] by which the 3D smoothing filter lowers each opacity; 1 without smoothing."""
        return self._filtered(self._gaussians(1).scales)[1]

    @torch.no_grad()
    def replace(self, tensors: Mapping[str, Tensor]) -> None:
        """Replace all parameters by new ones, of any common number of rows, without smoothing.

        The optimiser must be updated too.

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
        self.smoothing = self.means.new_zeros(len(self.means))

    def _gaussians(self, coefficients: int) -> Gaussians:
        """The Gaussians as stored, without smoothing."""
        log_scales = self.log_scales.mean(dim=1, keepdim=True).expand(-1, 3) if self.isotropic else self.log_scales
        return Gaussians(
            means=self.means,
            quaternions=self.quaternions,
            scales=log_scales.exp(),
            opacities=self.opacity_logits.sigmoid(),
            sh=torch.cat([self.sh_dc, self.sh_rest[:, : coefficients - 1]], dim=1),
        )

    def _smoothed(self, gaussians: Gaussians) -> Gaussians:
        """Apply the 3D smoothing filter: wider, and fainter such that each keeps its integral (Mip-Splatting, §5.1)."""
        if not bool(self.smoothing.any()):
            return gaussians
        scales, attenuation = self._filtered(gaussians.scales)
        return replace(gaussians, scales=scales, opacities=gaussians.opacities * attenuation)

    def _filtered(self, scales: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
        """Scales behind the 3D filter, and the factor on opacities that keeps each Gaussian's integral."""
        wide = (scales.square() + self.smoothing[:, None].square()).sqrt()
        return wide, (scales / wide).prod(dim=1)

    def _with_dropout(self, gaussians: Gaussians, ctx: Context) -> Gaussians:
        """Make a random share of the Gaussians transparent, and the others that much more opaque (DropGaussian, eq. 6)."""
        share = self.dropout * ctx.progress
        if not ctx.training or share <= 0:
            return gaussians
        device = gaussians.opacities.device if ctx.generator is None else ctx.generator.device
        kept = torch.rand(len(gaussians), generator=ctx.generator, device=device).to(gaussians.opacities) >= share
        return replace(gaussians, opacities=(gaussians.opacities * kept / (1 - share)).clamp_max(1.0))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Resize to the checkpoint's number of Gaussians first, which density control may have changed."""
        for name in PARAMETERS:
            stored, parameter = state_dict.get(prefix + name), getattr(self, name)
            if isinstance(stored, Tensor) and stored.shape[1:] == parameter.shape[1:] and len(stored) != len(parameter):
                resize_to_stored(parameter, stored)
        # Kept by runs that have it; others are not smoothed.
        self.smoothing = self.means.new_zeros(len(self.means))
        state_dict.setdefault(prefix + "smoothing", self.smoothing)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


class FixedGaussians(Field):
    """Field of constant Gaussians, for rendering without fitting."""

    provides = GAUSSIAN_QUANTITIES

    def __init__(self, gaussians: Gaussians) -> None:
        super().__init__()
        self._gaussians = gaussians

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """The Gaussians as one density in space, see `GaussianField.query`."""
        if lacking := want & ~self.provides:
            raise NotComposableError(f"FixedGaussians has no {lacking.words()} at points.")
        return query_density(self._gaussians, samples, want)

    def primitives(self, want: Quantity, ctx: Context) -> Gaussians:
        """The Gaussians."""
        return self._gaussians if want == Quantity.GAUSSIANS else super().primitives(want, ctx)

    def primitive_count(self) -> int:
        """Number of Gaussians."""
        return len(self._gaussians)
