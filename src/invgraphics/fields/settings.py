"""Settings of neural fields (`invgraphics.fields.neural`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from invgraphics.config import OMIT_EMPTY, Slot
from invgraphics.core import harmonics
from invgraphics.fields.density import Activation, Interpolation
from invgraphics.fields.encodings.frequency import MAX_OCTAVES, FrequencyConfig, frequency_width
from invgraphics.fields.encodings.voxels import VoxelsConfig

MAX_LAYERS = 128
"""Hidden layers of a network; ten times as many as any method of the field has."""


@dataclass(frozen=True)
class NeuralSettings:
    """An encoding and two networks; grids can do without either, and colour can have an encoding of its own.

    Attributes:
        encoding: position to features.
        geometry: output of the geometry network: volume density, or signed distance (initialised as a sphere).
        layers: hidden layers of the geometry network.
        width: features of each.
        skip: hidden layer after which the encoding is concatenated once more, counted from 0; -1 for none.
        geometry_features: features that the colour network takes from the geometry network.
        colour_layers: hidden layers of the colour network.
        colour_width: features of each.
        direction: how the colour network sees the viewing direction; ``none`` makes colour independent of it.
        direction_degree: octaves for ``frequency``; bands for ``sh``, 1 to 4.
        density_activation: ``exp`` stops growing at exp(15); not used for ``sdf``.
        density_bias: added before that activation (mip-NeRF: softplus and -1).
        density_per: unit of length of the network's density. ``contracted``: in a contracted space, the box's half-extent after
            contraction along the radius, so that a new field is as thin a fog all the way to infinity as in a box. ``half``:
            the same, and in a box its half-extent.
        density_scale: factor of the density after its activation: with ``half``, half the number of voxels along an edge makes
            it a density per voxel, as in DVGO.
        density_interpolation: whether raw values of a voxel grid are activated after interpolation, before it (``in``), or made
            opacities before it (``pre``); see `DensityActivation`.
        appearance: a second encoding, for colour alone (DVGO, TensoRF); ``None``: colour takes the geometry features.
        appearance_basis: features that a linear map without bias makes of the second encoding's (TensoRF: 27); 0 for no map.
        feature_octaves: octaves of sine and cosine of the colour network's features that are appended to them (TensoRF: 2).
        geometry_head: ``none``: raw geometry is the encoding's first feature, the others are geometry features; of products
            (``vm``, ``cp``) it is the sum of all. No geometry network then.
        head: how colour comes from features. ``sh``: they are coefficients of spherical harmonics in the direction, the
            (degree + 1)^2 of red first; ``none``: they are the raw colour, alike from all sides. No colour network then.
        hidden_activation: of both networks' hidden layers; those of a signed distance are a sharp softplus in any case.
        colour_activation: of raw colour. ``sigmoid``: softplus in scenes of linear colour; ``clamp``: max(0, 0.5 + x), as
            Plenoxels and 3DGS do it, with the gradient of a projection.
        colour_padding: how far the sigmoid exceeds [0, 1] at both ends, so that black and white can be reached (0.001 in EG3D
            and mip-NeRF).
        colour_inputs: what the colour network sees besides features and direction: the ``position``, in half-extents of the
            box, the unit ``normal``, or both (IDR, NeuS, VolSDF).
    """

    encoding: Annotated[Any, Slot("encodings")] = field(default_factory=FrequencyConfig)
    geometry: Literal["density", "sdf"] = "density"
    layers: int = 8
    width: int = 256
    skip: int = 4
    geometry_features: int = 256
    colour_layers: int = 1
    colour_width: int = 128
    direction: Literal["frequency", "sh", "none"] = "frequency"
    direction_degree: int = 4
    density_activation: Activation = "softplus"
    density_bias: float = -1.0
    density_per: Literal["local", "contracted", "half"] = "local"
    density_scale: float = 1.0
    density_interpolation: Interpolation = "post"
    appearance: Annotated[Any, Slot("encodings")] | None = None
    appearance_basis: int = 0
    feature_octaves: int = 0
    geometry_head: Literal["mlp", "none"] = "mlp"
    head: Literal["mlp", "sh", "none"] = "mlp"
    hidden_activation: Literal["relu", "softplus"] = "relu"
    colour_activation: Literal["sigmoid", "clamp"] = "sigmoid"
    colour_padding: float = 0.0
    colour_inputs: tuple[Literal["position", "normal"], ...] = field(default=(), metadata=OMIT_EMPTY)

    def __post_init__(self) -> None:
        if not (0 <= self.layers <= MAX_LAYERS and 0 <= self.colour_layers <= MAX_LAYERS):
            raise ValueError(f"layers and colour_layers must be from 0 to {MAX_LAYERS}.")
        if min(self.width, self.colour_width) < 1 or self.geometry_features < 0:
            raise ValueError("width and colour_width must be at least 1, geometry_features at least 0.")
        if not -1 <= self.skip < self.layers:
            raise ValueError(f"skip must name one of the {self.layers} hidden layers (from 0) or be -1, not {self.skip}.")
        if self.direction == "sh" and not 1 <= self.direction_degree <= harmonics.MAX_DEGREE + 1:
            raise ValueError(f"direction_degree must be 1 to {harmonics.MAX_DEGREE + 1} for 'sh', not {self.direction_degree}.")
        if not 0 <= self.direction_degree <= MAX_OCTAVES:
            raise ValueError(f"direction_degree must be from 0 to {MAX_OCTAVES}, not {self.direction_degree}.")
        blind = self.appearance is None and self.geometry_head == "mlp" and self.geometry_features == 0
        blind &= not self.colour_inputs
        if blind and (self.direction == "none" or self.head != "mlp"):
            raise ValueError("with geometry_features = 0 and direction = 'none' colour would be the same everywhere.")
        self._check_heads()
        self._check_density()

    @property
    def direction_width(self) -> int:
        """Number of features of a direction."""
        widths = {"frequency": frequency_width(self.direction_degree), "sh": self.direction_degree**2, "none": 0}
        return widths[self.direction]

    @property
    def two_plain_networks(self) -> bool:
        """Whether colour and geometry are ReLU networks over features and direction alone, as fused kernels take them."""
        networks = self.geometry_head == self.head == "mlp" and self.hidden_activation == "relu"
        plain_colour = self.colour_activation == "sigmoid" and self.colour_padding == 0
        bare = self.appearance_basis == 0 and self.feature_octaves == 0 and not self.colour_inputs
        return networks and plain_colour and bare

    def _check_heads(self) -> None:
        if self.appearance_basis < 0 or not 0 <= self.colour_padding < 1:
            raise ValueError("appearance_basis cannot be negative, colour_padding is in [0, 1).")
        if not 0 <= self.feature_octaves <= MAX_OCTAVES:
            raise ValueError(f"feature_octaves must be from 0 to {MAX_OCTAVES}, not {self.feature_octaves}.")
        if self.appearance_basis and self.appearance is None:
            raise ValueError("appearance_basis needs an appearance encoding.")
        if len(set(self.colour_inputs)) < len(self.colour_inputs):
            raise ValueError(f"colour_inputs names each input once, not {', '.join(self.colour_inputs)}.")
        if self.colour_inputs and self.head != "mlp":
            raise ValueError("colour_inputs are inputs of a colour network: they need head = 'mlp'.")
        if self.feature_octaves and self.head != "mlp":
            raise ValueError("feature_octaves are inputs of a colour network: they need head = 'mlp'.")

    def _check_density(self) -> None:
        if self.density_scale <= 0:
            raise ValueError(f"density_scale must be above 0, not {self.density_scale}.")
        if self.geometry == "sdf" and self.geometry_head == "none":
            raise ValueError("a signed distance needs geometry_head = 'mlp'.")
        grid = isinstance(self.encoding, VoxelsConfig) and self.encoding.levels == 1 and self.geometry_head == "none"
        if self.density_interpolation != "post" and not grid:
            raise ValueError("density_interpolation other than 'post' needs voxels of one level and geometry_head = 'none'.")
