"""Lower bound of a recipe's memory demand from its settings alone, checked before anything is built."""

from __future__ import annotations

import torch

from invgraphics.core import Scene, harmonics
from invgraphics.errors import InputError
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.fields.points import PointFieldConfig
from invgraphics.memory import check_fits
from invgraphics.recipes.recipe import Method

COPIES = 6
"""Of each primitive's values during a step: parameter, gradient, Adam's two moments; activated, and the gradient of that."""
RAY_BYTES = 512
"""Of a ray of a batch: origin, direction, interval, colours and their gradients."""
TRAINED_COPIES = 4
"""Of each parameter of a network: itself, its gradient and Adam's two moments."""


def check_memory(method: Method, scene: Scene) -> None:
    """Check that a method's field and batches fit into free memory; the estimate is a lower bound.

    Raises:
        InputError: it does not fit; the remedy names the value to change.
    """
    config, rays = method.recipe.field, method.recipe.batches.rays
    check_fits(rays * RAY_BYTES, f"A step of {method.name} with {rays:,} rays", "Choose a lower batches.rays.")
    if isinstance(config, GaussianFieldConfig | PointFieldConfig):
        at_random = config.init in ("random", "field") or (config.init == "scene" and scene.points is None)
        known = 0 if scene.points is None else min(len(scene.points), config.max_init)
        primitives = config.count if at_random else known
        gaussians = isinstance(config, GaussianFieldConfig)
        row = 4 * (11 + 3 * harmonics.count(config.sh_degree) if gaussians else 7 + config.features)
        what = f"The field of {method.name} with {primitives:,} {'Gaussians' if gaussians else 'points'}"
        check_fits(primitives * row * COPIES, what, "Choose a lower field.count or field.max_init.")
        return
    samples = max(rays, method.recipe.batches.samples)  # at least one on each ray
    activations = samples * int(getattr(config, "width", 0)) * 4 * 2  # of one layer, with their gradients
    needed = TRAINED_COPIES * _parameter_bytes(method, scene) + activations
    remedy = "Choose a smaller network: field.width, field.layers, or the size of field.encoding."
    check_fits(needed, f"A step of {method.name}, with gradients and moments,", remedy)


def _parameter_bytes(method: Method, scene: Scene) -> int:
    """Bytes of a field's parameters, from tensor shapes on torch's meta device."""
    try:
        with torch.device("meta"):
            field = method.recipe.field.build(scene)
    except (RuntimeError, OverflowError) as error:
        if "overflow" not in str(error).lower():
            return 0  # a field that reads values while it is built: it says itself what it cannot do
        raise InputError(f"The field of {method.name} has more parameters than can be counted.", "Lower its sizes.") from error
    return sum(parameter.numel() * parameter.element_size() for parameter in field.parameters())
