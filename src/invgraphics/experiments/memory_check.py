"""Lower bound of a recipe's memory demand from its settings alone, checked before anything is built."""

from __future__ import annotations

import torch

from invgraphics.core import Scene, harmonics
from invgraphics.errors import InputError
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.fields.planes import PlanesConfig
from invgraphics.memory import check_fits
from invgraphics.recipes.recipe import Method

COPIES = 6
"""Of each primitive's values during a step: parameter, gradient, Adam's two moments; activated, and the gradient of that."""
RAY_BYTES = 512
"""Of a ray of a batch: origin, direction, interval, colours and their gradients."""
TEXEL_BYTES = 16 * COPIES
"""Of a texel of a multi-plane image: colour and opacity, in as many copies."""
TRAINED_COPIES = 4
"""Of each parameter of a network: itself, its gradient and Adam's two moments."""


def check_memory(method: Method, scene: Scene) -> None:
    """Check that a method's field and batches fit into free memory; the estimate is a lower bound.

    Raises:
        InputError: it does not fit; the remedy names the value to change.
    """
    config, rays = method.recipe.field, method.recipe.batches.rays
    check_fits(rays * RAY_BYTES, f"A step of {method.name} with {rays:,} rays", "Choose a lower batches.rays.")
    if isinstance(config, GaussianFieldConfig):
        at_random = config.init in ("random", "field") or (config.init == "scene" and scene.points is None)
        known = 0 if scene.points is None else min(len(scene.points), config.max_init)
        primitives = config.count if at_random else known
        row = 4 * (11 + 3 * harmonics.count(config.sh_degree))
        what = f"The field of {method.name} with {primitives:,} Gaussians"
        check_fits(primitives * row * COPIES, what, "Choose a lower field.count or field.max_init.")
        return
    if isinstance(config, PlanesConfig):
        pixels = max(view.camera.width * view.camera.height for view in scene.train)
        texels = round(config.count * pixels * config.texels**2)
        remedy = "Choose a lower field.count or field.texels."
        check_fits(texels * TEXEL_BYTES, f"The field of {method.name} with {texels:,} texels or more", remedy)
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
    except InputError:
        return 0  # it does not go with the scene, and says so where it is built
    except (RuntimeError, OverflowError) as error:
        if "overflow" not in str(error).lower():
            return 0  # a field that reads values while it is built: it says itself what it cannot do
        raise InputError(f"The field of {method.name} has more parameters than can be counted.", "Lower its sizes.") from error
    return sum(parameter.numel() * parameter.element_size() for parameter in field.parameters())
