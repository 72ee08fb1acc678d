"""Encodings built for a region, and evaluated at samples: at their positions, or over their cones' Gaussians."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import pixel_limit
from invgraphics.core.field import Encoding
from invgraphics.core.samples import Samples
from invgraphics.core.scene import Scene
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.encodings.lattices import LatticeConfig

Config = TypeVar("Config", bound=Any)


def resolve_encodings(config: Config, scene: Scene) -> Config:
    """A field's config for a scene: hash grids with a ``min_spacing`` end at the pixels of the training views."""
    grids = {name: grid for name in ("encoding", "appearance") if isinstance(grid := getattr(config, name, None), HashConfig)}
    if not (scene.train and any(grid.min_spacing for grid in grids.values())):
        return config
    pixels = pixel_limit(scene.bounds, [view.camera for view in scene.train])
    return replace(config, **{name: grid.resolved(pixels) for name, grid in grids.items()})


def build_encoding(config: Any, bounds: Bounds) -> Encoding:
    """Build an encoding from its config; lattices take their proportions from the bounds."""
    return config.build(bounds.half.tolist()) if isinstance(config, LatticeConfig) else config.build()


def encode_samples(
    encoding: Encoding, bounds: Bounds, samples: Samples, unit: Float[Tensor, "m 3"] | None = None
) -> Float[Tensor, "m f"]:
    """Features of samples; of their cones' Gaussians where the encoding takes covariances (mip-NeRF, equation 7 to 9).

    Args:
        encoding: of the unit cube.
        bounds: of the field.
        samples: where; differentiable in their positions.
        unit: their positions in the unit cube, where they are known.
    """
    if not encoding.needs_covariance:
        return encoding(bounds.to_unit(samples.position) if unit is None else unit)
    mean = samples.cone_mean
    return encoding(bounds.to_unit(mean), bounds.unit_covariance(mean, samples.covariance))
