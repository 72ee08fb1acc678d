"""Heads: from an encoding's features to raw geometry and colour, by networks or without."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus

from invgraphics.core import harmonics
from invgraphics.core.field import Encoding
from invgraphics.errors import InputError
from invgraphics.fields.encodings.frequency import frequencies
from invgraphics.fields.encodings.lattices import LatticeFeatures
from invgraphics.fields.mlp import Mlp
from invgraphics.fields.settings import NeuralSettings

NEUS_SHARPNESS, EG3D_SHARPNESS = 100.0, 1.0
"""Softplus beta of hidden layers: 100 for signed distances (NeuS), whose eikonal loss needs a second derivative; 1 for
tri-planes (EG3D)."""


def geometry_net(settings: NeuralSettings, inputs: int) -> Mlp:
    """Network from the encoding's features to raw geometry, followed by the geometry features."""
    # A signed distance also takes the plain coordinates, from which its initial sphere is made.
    inputs += 3 if settings.geometry == "sdf" else 0
    return Mlp(
        inputs=inputs,
        layers=settings.layers,
        width=settings.width,
        outputs=1 + settings.geometry_features,
        skip=settings.skip,
        sharpness=NEUS_SHARPNESS if settings.geometry == "sdf" else _sharpness(settings),
    )


def colour_net(settings: NeuralSettings, features: int) -> Mlp:
    """Network from ``features`` features, their octaves and a direction to raw colour."""
    return Mlp(
        inputs=features * (1 + 2 * settings.feature_octaves) + settings.direction_width,
        layers=settings.colour_layers,
        width=settings.colour_width,
        outputs=3,
        sharpness=_sharpness(settings),
    )


def _sharpness(settings: NeuralSettings) -> float | None:
    return EG3D_SHARPNESS if settings.hidden_activation == "softplus" else None


def sums_components(encoding: Encoding) -> bool:
    """Whether an encoding's features are components of one quantity, which is their sum (TensoRF, equations 6 and 7)."""
    return isinstance(encoding, LatticeFeatures) and encoding.combine in ("vm", "cp")


def geometry_feature_width(settings: NeuralSettings, encoding: Encoding) -> int:
    """Number of geometry features: those that colour takes from geometry."""
    if settings.geometry_head == "mlp":
        return settings.geometry_features
    return 0 if sums_components(encoding) else encoding.width - 1


def check_colour_features(head: Literal["mlp", "sh", "none"], features: int) -> None:
    """Check that a head without network gets as many features as it takes.

    Raises:
        InputError: it does not.
    """
    counts = [3 * harmonics.count(degree) for degree in range(harmonics.MAX_DEGREE + 1)]
    if head == "none" and features != 3:
        raise InputError(f"head = 'none' takes 3 features as the colour, but gets {features}.")
    if head == "sh" and features not in counts:
        known = ", ".join(map(str, counts))
        raise InputError(
            f"head = 'sh' takes the coefficients of whole bands, but gets {features} features.", f"Expected: {known}."
        )


def raw_colour(
    net: Mlp | None, features: Float[Tensor, "m c"], direction: Float[Tensor, "m 3"], settings: NeuralSettings
) -> Float[Tensor, "m 3"]:
    """Colour before its activation, seen along unit directions.

    Coefficients of spherical harmonics are those of red first, then green, then blue (Plenoxels, equation 2).
    """
    if settings.head == "none":
        return features
    if settings.head == "sh":
        return harmonics.evaluate(features.unflatten(1, (3, -1)).mT, direction)
    assert net is not None
    if settings.feature_octaves:
        features = octaves(features, settings.feature_octaves)
    if settings.direction == "frequency":
        features = torch.cat([features, frequencies(direction, settings.direction_degree)], dim=1)
    elif settings.direction == "sh":
        features = torch.cat([features, harmonics.basis(direction, settings.direction_degree - 1)], dim=1)
    return net(features)


def octaves(features: Float[Tensor, "m f"], count: int) -> Float[Tensor, "m g"]:
    """Features, then the sines and then the cosines of 2^k times them, k = 0 .. count - 1 (TensoRF, `positional_encoding`)."""
    phases = (features[:, :, None] * 2.0 ** torch.arange(count, device=features.device)).flatten(1)
    return torch.cat([features, phases.sin(), phases.cos()], dim=1)


def activated_colour(
    raw: Float[Tensor, "m 3"], settings: NeuralSettings, colour: Literal["srgb", "linear"]
) -> Float[Tensor, "m 3"]:
    """Radiance in the scene's colour space."""
    if settings.colour_activation == "clamp":
        return harmonics.non_negative(raw + 0.5)
    if colour == "linear":
        return softplus(raw)
    padding = settings.colour_padding
    return raw.sigmoid() if padding == 0 else raw.sigmoid() * (1 + 2 * padding) - padding
