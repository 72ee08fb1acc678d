"""A point cloud whose neighbours around a sample make its density and colour, through small networks (Xu et al. 2022)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize, relu, softplus
from typing_extensions import override

from invgraphics.core import harmonics
from invgraphics.core.bounds import Bounds
from invgraphics.core.field import Field, Quantity, resize_to_stored
from invgraphics.core.rendering import Context
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.core.scene import Points, Scene
from invgraphics.errors import InputError
from invgraphics.fields.convert import visible_points
from invgraphics.fields.encodings.frequency import frequencies, frequency_width
from invgraphics.fields.mlp import Mlp
from invgraphics.fields.starting import initial_points, median_spacing
from invgraphics.kernels.near import near_points
from invgraphics.kernels.segments import segment_sums

ROWS = ("positions", "features", "raw_rgb", "confidence_logits")
"""Names of a `PointField`'s tensors whose first axis is the point; all but the first are parameters."""
COLOUR_MARGIN = 0.02
"""A point's starting colour keeps this far from where its activation saturates."""


@dataclass(frozen=True)
class PointFieldConfig:
    """Settings of a neural point cloud and its initialisation; sizes are Point-NeRF's.

    Attributes:
        features: learnt features of each point.
        neighbours: most points that a sample sees (Point-NeRF: 8).
        reach: radius within which they are looked for, in median distances of a point to its neighbour of that rank.
        layers: hidden layers that see a neighbour's features and the sample's offset from it.
        width: features of each.
        octaves: of the offset's encoding, whose unit is the radius.
        colour_layers: hidden layers of the colour network, which sees the neighbours' mean and the direction.
        colour_width: features of each.
        direction_degree: bands of spherical harmonics of the direction, 1 to 4.
        density_scale: density of a neighbour whose network says 1, per radius.
        confidence: of each point at the start, in (0, 1).
        init: start from points that multi-view ``stereo`` finds in the training photographs (see `stereo_points`), from the
            scene's points, at random in its bounds, from the training views' true depth maps, or from the fitted ``field`` of
            the run that ``source`` names: centres of its Gaussians, or visible points of its density.
        source: folder of that run.
        count: random points where the scene has none, or ``init`` is ``random``.
        max_init: most points to start from; a random subset if there are more.
    """

    title: ClassVar[str] = "point cloud + network"

    features: int = 32
    neighbours: int = 8
    reach: float = 1.5
    layers: int = 2
    width: int = 256
    octaves: int = 5
    colour_layers: int = 4
    colour_width: int = 256
    direction_degree: int = 4
    density_scale: float = 30.0
    confidence: float = 0.15
    init: Literal["scene", "stereo", "random", "depth", "field"] = "scene"
    source: str = ""
    count: int = 10_000
    max_init: int = 100_000

    def __post_init__(self) -> None:
        for name in ("features", "neighbours", "layers", "width", "count", "max_init"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}.")
        if not 1 <= self.direction_degree <= harmonics.MAX_DEGREE + 1:
            raise ValueError(f"direction_degree must be from 1 to {harmonics.MAX_DEGREE + 1}, not {self.direction_degree}.")
        if not 0 < self.confidence < 1 or not self.reach > 0 or not self.density_scale > 0 or self.octaves < 0:
            raise ValueError("confidence must lie between 0 and 1, reach and density_scale above 0, octaves at 0 or above.")
        if (self.init == "field") != bool(self.source):
            raise ValueError("init = 'field' needs the folder of a run as 'source', and nothing else does.")

    def capped(self, most: int) -> PointFieldConfig:
        """Limit the initial number of points to ``most``."""
        return replace(self, count=min(self.count, most), max_init=min(self.max_init, most))

    def build(self, scene: Scene) -> PointField:
        """Place the points for ``scene``; randomness comes from torch's global generator.

        With ``init = "field"`` they are random until `converted` is given the field.

        Raises:
            InputError: the scene's point cloud is empty or not finite, or there are no depth maps.
        """
        return self.from_points(initial_points(scene, self.init, self.count, self.max_init), scene)

    def converted(self, source: Field, scene: Scene) -> PointField:
        """Place the points on another field: at the centres of its most opaque Gaussians, else where its density is seen.

        Raises:
            InputError: it has neither Gaussians nor density and radiance, or is empty.
        """
        if Quantity.GAUSSIANS not in source.provides:
            return self.from_points(visible_points(source, scene, self.max_init), scene)
        gaussians = source.primitives(Quantity.GAUSSIANS, Context(scene.bounds))
        opaque = gaussians.opacities.detach().argsort(descending=True, stable=True)[: self.max_init]
        rgb = (0.5 + harmonics.BAND_0 * gaussians.sh.detach()[opaque, 0]).clamp(0, 1)
        return self.from_points(Points(gaussians.means.detach()[opaque], rgb), scene)

    def from_points(self, points: Points, scene: Scene) -> PointField:
        """Make each of ``points`` a neural one; their own features and confidences are kept where they fit."""
        n = len(points)
        if n == 0:
            raise InputError("There are no points to start from.", "Set the field's init = 'random'.")
        features = points.features
        if features is None or features.shape[1] != self.features:
            features = 0.1 * torch.randn(n, self.features)
        rgb = points.rgb.clamp(COLOUR_MARGIN, 1 - COLOUR_MARGIN)
        confidence = torch.full((n,), self.confidence) if points.confidence is None else points.confidence.clamp(0.01, 0.99)
        tensors = {
            "positions": points.position.clone(),
            "features": features,
            "raw_rgb": rgb.logit() if scene.colour == "srgb" else torch.expm1(rgb).log(),
            "confidence_logits": confidence.logit(),
        }
        return PointField(self, tensors, scene)


class PointField(Field):
    """Density and radiance of a sample from its nearest points.

    Each neighbour's features and the sample's offset from it go through one network, whose output says the neighbour's density,
    softplus(x - 1), and features; both are averaged with weights of inverse distance times confidence (Point-NeRF, equations 4
    to 7; the density is weighted after its activation). A second network makes colour of the mean features and the direction,
    added to the mean of the points' own colours before the activation. Where no point is near there is nothing.
    """

    provides = Quantity.DENSITY | Quantity.RADIANCE | Quantity.NORMAL | Quantity.FEATURES | Quantity.POINTS
    positions: Tensor
    features: Tensor
    raw_rgb: Tensor
    confidence_logits: Tensor
    radius: Tensor

    def __init__(self, config: PointFieldConfig, tensors: Mapping[str, Tensor], scene: Scene) -> None:
        super().__init__()
        self.config = config
        self.colour: Literal["srgb", "linear"] = scene.colour
        self.register_buffer("positions", tensors["positions"])
        for name in ROWS[1:]:
            setattr(self, name, nn.Parameter(tensors[name]))
        radius = config.reach * median_spacing(self.positions, config.neighbours, scene.bounds)
        self.register_buffer("radius", torch.tensor(radius))
        # The first layer in two parts: that of a point's features is evaluated once per point, not per neighbour.
        self.point_layer = nn.Linear(config.features, config.width)
        self.offset_layer = nn.Linear(frequency_width(config.octaves), config.width, bias=False)
        self.hidden = nn.ModuleList(nn.Linear(config.width, config.width) for _ in range(config.layers - 1))
        self.density_head = nn.Linear(config.width, 1)
        self.colour_net = Mlp(
            inputs=config.width + config.direction_degree**2,
            layers=config.colour_layers,
            width=config.colour_width,
            outputs=3,
        )

    @property
    @override
    def feature_width(self) -> int:
        """Mean features, and raw colour."""
        return self.config.width + 3

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """See `Field.query`; a normal is that of the density's negative gradient and can be had inside ``no_grad``."""
        if want == Quantity.RADIANCE and samples.features is not None:
            return FieldValues(radiance=self._radiance(samples.features, samples.direction))
        position, normal = samples.position, None
        if Quantity.NORMAL in want:
            normal = self._normal(position)
        index, _ = self._neighbours(position)
        near = (index[:, 0] >= 0).nonzero()[:, 0]
        inner, aggregated = self._aggregate(position.index_select(0, near), index.index_select(0, near))
        density = inner.new_zeros(len(position)).index_copy(0, near, inner)
        radiance = features = None
        if Quantity.RADIANCE in want:
            seen = self._radiance(aggregated, samples.direction.index_select(0, near))
            radiance = seen.new_zeros(len(position), 3).index_copy(0, near, seen)
        if Quantity.FEATURES in want:
            features = aggregated.new_zeros(len(position), aggregated.shape[1]).index_copy(0, near, aggregated)
        return FieldValues(
            density=density if Quantity.DENSITY in want else None, radiance=radiance, normal=normal, features=features
        )

    def _neighbours(self, position: Float[Tensor, "m 3"]) -> tuple[Int[Tensor, "m k"], Float[Tensor, "m k"]]:
        return near_points(position.detach(), self.positions, self.config.neighbours, float(self.radius))

    def _aggregate(
        self, position: Float[Tensor, "m 3"], index: Int[Tensor, "m k"]
    ) -> tuple[Float[Tensor, " m"], Float[Tensor, "m f"]]:
        """Density at positions with neighbours, and their mean features, of which the last three are raw colour."""
        # Only existing neighbours pass through the network: two fifths of the slots are empty.
        sample, slot = (index >= 0).nonzero(as_tuple=True)
        point, m = index[sample, slot], len(index)
        offset = (position.index_select(0, sample) - self.positions.index_select(0, point)) / self.radius
        weight = 1 / (offset.square().sum(dim=1) + 1e-6).sqrt()
        weight = weight / weight.new_zeros(m).index_add(0, sample, weight).index_select(0, sample)
        hidden = self.point_layer(self.features).index_select(0, point)
        encoded = frequencies(offset / 2, self.config.octaves)
        hidden = relu(torch.addmm(hidden, encoded, self.offset_layer.weight.t()), inplace=True)
        for layer in self.hidden:
            hidden = relu(layer(hidden), inplace=True)
        weighted = weight * self.confidence_logits.sigmoid().index_select(0, point)
        density = softplus(self.density_head(hidden) - 1) * (self.config.density_scale / self.radius)
        density = segment_sums(density, weighted, sample, m)[:, 0]
        features = segment_sums(hidden, weighted, sample, m)
        raw_rgb = segment_sums(self.raw_rgb.index_select(0, point), weight, sample, m)
        return density, torch.cat([features, raw_rgb], dim=1)

    def _radiance(self, aggregated: Float[Tensor, "m f"], direction: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        features, raw_rgb = aggregated.split([self.config.width, 3], dim=1)
        seen = torch.cat([features, harmonics.basis(direction, self.config.direction_degree - 1)], dim=1)
        raw = raw_rgb + self.colour_net(seen)
        return raw.sigmoid() if self.colour == "srgb" else softplus(raw)

    def _normal(self, position: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """Unit normals, without gradients; zero where there is no density."""
        with torch.enable_grad():
            moving = position.detach().requires_grad_()
            density = self.query(Samples.at(moving), Quantity.DENSITY).density
            assert density is not None
            (gradient,) = torch.autograd.grad(density.sum(), moving)
        return -normalize(gradient, dim=1, eps=torch.finfo(gradient.dtype).tiny)

    @override
    def support(self, bounds: Bounds, resolution: int) -> Bool[Tensor, "r r r"] | None:
        """Cells within the radius of a point; ``None`` in contracted space, where a radius has no one size."""
        if bounds.space == "contracted":
            return None
        margin = self.radius / (2 * bounds.half)
        unit = bounds.to_unit(self.positions)
        first, end = (
            ((unit + side * margin).mul(resolution).floor().long() + past).clamp(0, resolution)
            for side, past in ((-1, 0), (1, 1))
        )
        # Boxes that cover a cell: running sums, along each axis, of +1 where a box begins and -1 where it has ended.
        covered = torch.zeros((resolution + 1,) * 3, dtype=torch.int32, device=self.positions.device)
        for ends in itertools.product((False, True), repeat=3):
            corner = torch.where(torch.tensor(ends, device=first.device), end, first)
            change = covered.new_tensor((-1) ** sum(ends))
            covered.index_put_(tuple(corner.unbind(dim=1)), change, accumulate=True)
        for axis in range(3):
            covered = covered.cumsum(dim=axis, dtype=torch.int32)
        return covered[:resolution, :resolution, :resolution] > 0

    def primitives(self, want: Quantity, ctx: Context) -> Any:
        """The points, with their colours, features and confidences."""
        if want != Quantity.POINTS:
            return super().primitives(want, ctx)
        rgb = self.raw_rgb.sigmoid() if self.colour == "srgb" else softplus(self.raw_rgb)
        return Points(self.positions, rgb, features=self.features, confidence=self.confidence_logits.sigmoid())

    def primitive_count(self) -> int:
        """Number of points."""
        return len(self.positions)

    @torch.no_grad()
    def replace(self, tensors: Mapping[str, Tensor]) -> None:
        """Replace all points by new ones, of any number. An optimiser must be told.

        Raises:
            ValueError: a name is missing or unknown, the numbers of rows differ, or a row has another shape than before.
        """
        if set(tensors) != set(ROWS) or len({len(tensor) for tensor in tensors.values()}) != 1:
            raise ValueError(f"replace needs exactly {', '.join(ROWS)}, all with the same number of rows.")
        for name, tensor in tensors.items():
            old = getattr(self, name)
            if tensor.shape[1:] != old.shape[1:]:
                raise ValueError(f"rows of {name} have shape {tuple(old.shape[1:])}, not {tuple(tensor.shape[1:])}.")
            setattr(self, name, nn.Parameter(tensor.detach()) if isinstance(old, nn.Parameter) else tensor.detach())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Resize to the checkpoint's number of points first, which growth and pruning may have changed."""
        for name in ROWS:
            stored, own = state_dict.get(prefix + name), getattr(self, name)
            if isinstance(stored, Tensor) and stored.shape[1:] == own.shape[1:] and len(stored) != len(own):
                resize_to_stored(own, stored)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
