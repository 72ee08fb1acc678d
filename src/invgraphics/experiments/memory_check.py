"""Lower bound of a recipe's memory demand from its settings alone, checked before anything is built."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import nn

from invgraphics.core import Scene, harmonics
from invgraphics.core.camera import pixel_limit
from invgraphics.core.lattice import LatticeField
from invgraphics.errors import InputError
from invgraphics.fields.depth_maps import DepthMapsConfig, stored_bytes
from invgraphics.fields.encodings.lattices import LatticeConfig
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.fields.planes import PlanesConfig
from invgraphics.fields.points.field import PointFieldConfig
from invgraphics.memory import check_fits
from invgraphics.recipes.recipe import Method
from invgraphics.recipes.schema import Recipe

COPIES = 6
"""Of each primitive's values during a step: parameter, gradient, Adam's two moments; activated, and the gradient of that."""
RAY_BYTES = 512
"""Of a ray of a batch: origin, direction, interval, colours and their gradients."""
TEXEL_BYTES = 16 * COPIES
"""Of a texel of a multi-plane image: colour and opacity, in as many copies."""
SAMPLE_BYTES = 32
"""Of a sample: its ray, interval, position and density."""
TRAINED_COPIES = 4
"""Of each parameter of a network: itself, its gradient and Adam's two moments."""
KEPT_LAYERS = 45
"""Layers of a sparse lattice's vertices that pruning is expected to leave, as it keeps what is near surfaces. After a minute
Plenoxels' 112 had kept 40 on `room`, 6 to 13 on five other scenes; 320 after an hour on `mic` 19."""
SAMPLES_REMEDY = "Choose a lower batches.rays or batches.samples, fewer samples in renderer.sampler, or a lower field.width."
NETWORK_REMEDY = "Choose a smaller network: field.width, field.layers, or the size of field.encoding."


def check_memory(method: Method, scene: Scene) -> None:
    """Check that a method's field, sampler and batches fit into free memory; the estimate is a lower bound.

    Raises:
        InputError: it does not fit; the remedy names the value to change.
    """
    recipe, step = method.recipe, f"A step of {method.name}"
    rays, sampler = recipe.batches.rays, getattr(recipe.renderer, "sampler", None)
    check_fits(rays * RAY_BYTES, f"{step} with {rays:,} rays", "Choose a lower batches.rays.")
    for hook in recipe.hooks:
        check_fits(getattr(hook, "rays", 0) * RAY_BYTES, f"A hook of {method.name}", "Choose fewer 'rays' for it.")
    on_each = getattr(sampler, "samples_per_ray", 1)
    what = f"{step} with {on_each:,} samples on each of {rays:,} rays"
    check_fits(rays * on_each * SAMPLE_BYTES, what, "Choose a lower batches.rays, or fewer samples in renderer.sampler.")
    what = f"The sampler of {method.name}"
    check_fits(getattr(sampler, "state_bytes", 0), what, "Choose a lower resolution or fewer cells in renderer.sampler.")
    if isinstance(recipe.field, GaussianFieldConfig | PointFieldConfig):
        _check_primitives(recipe.field, method.name, scene)
    elif isinstance(recipe.field, PlanesConfig):
        _check_planes(recipe.field, method.name, scene)
    elif isinstance(recipe.field, DepthMapsConfig):
        what = f"The field of {method.name} with {len(scene.train):,} photographs and their depth"
        check_fits(stored_bytes(scene.train), what, "Choose a lower data.train_views, or smaller pictures with --size.")
    else:
        _check_network(recipe, method.name, scene, rays * on_each)


def _check_primitives(config: GaussianFieldConfig | PointFieldConfig, name: str, scene: Scene) -> None:
    at_random = config.init in ("random", "field") or (config.init == "scene" and scene.points is None)
    known = 0 if scene.points is None else min(len(scene.points), config.max_init)
    primitives = config.count if at_random else known
    gaussians = isinstance(config, GaussianFieldConfig)
    row = 4 * (11 + 3 * harmonics.count(config.sh_degree) if gaussians else 7 + config.features)
    what = f"The field of {name} with {primitives:,} {'Gaussians' if gaussians else 'points'}"
    check_fits(primitives * row * COPIES, what, "Choose a lower field.count or field.max_init.")


def _check_network(recipe: Recipe, name: str, scene: Scene, on_rays: int) -> None:
    config, batches = recipe.field, recipe.batches
    activation = int(getattr(config, "width", 0)) * 4 * 2  # of one layer, with its gradient
    for penalty in recipe.penalties:
        needed = getattr(penalty, "points", 0) * (SAMPLE_BYTES + activation)
        check_fits(needed, f"A penalty of {name}", "Choose fewer 'points' for it.")
    parts = [config, *filter(None, [getattr(getattr(recipe.renderer, "sampler", None), "proposal", None)])]
    trained = TRAINED_COPIES * sum(_bytes(_build(part, name, scene)) for part in parts)
    check_fits(trained, f"A step of {name}, with gradients and moments,", NETWORK_REMEDY)
    activations = max(batches.samples or on_rays, batches.rays) * activation
    check_fits(trained + activations, f"A step of {name}, with what its network keeps for gradients,", SAMPLES_REMEDY)
    finest = _finest(recipe, scene)
    if grown := _resized(config, finest):
        parameters, links = _grown_bytes(_build(grown, name, scene), kept=0.0)
        needed = TRAINED_COPIES * parameters + links
        what = f"The field of {name}, up-sampled to {finest:,} vertices along an edge,"
        check_fits(needed, what, "Choose a lower 'resolution' in the hooks.")


def _check_planes(config: PlanesConfig, name: str, scene: Scene) -> None:
    """Check that a multi-plane image of at least the pictures' size fits."""
    pixels = max(view.camera.width * view.camera.height for view in scene.train)
    texels = round(config.count * pixels * config.texels**2)
    what = f"The field of {name} with {texels:,} texels or more"
    check_fits(texels * TEXEL_BYTES, what, "Choose a lower field.count or field.texels.")


def upsampled_bytes(method: Method, scene: Scene) -> tuple[int, int]:
    """Bytes of a field's parameters, and of its links, after the last up-sampling of its lattices; 0 where none is up-sampled.

    Sparse lattices are taken to keep `KEPT_LAYERS` of their vertices.
    """
    finest = _finest(method.recipe, scene)
    grown = _resized(method.recipe.field, finest)
    return _grown_bytes(_build(grown, method.name, scene), min(1.0, KEPT_LAYERS / finest)) if grown else (0, 0)


def _finest(recipe: Recipe, scene: Scene) -> int:
    """Most vertices along an edge to which hooks resize lattices, within their limits by the pictures' pixels; 0 for none."""
    sizes = [0]
    for hook in recipe.hooks:
        size = max(getattr(hook, "resolution", 0), *getattr(hook, "resolutions", ()), 0)
        if size and (spacing := getattr(hook, "min_spacing", 0)):
            size = min(size, math.ceil(pixel_limit(scene.bounds, [view.camera for view in scene.train]) / spacing))
        sizes.append(size)
    return max(sizes)


def _resized(config: Any, resolution: int) -> Any:
    """A field's settings with lattices of another resolution; ``None`` without one, or without lattices."""
    names = ("encoding", "appearance")
    lattices: dict[str, Any] = {name: part for name in names if isinstance(part := getattr(config, name, None), LatticeConfig)}
    changed = {name: replace(part, resolution=resolution) for name, part in lattices.items()} if resolution else {}
    return replace(config, **changed) if changed else None


def _build(config: Any, name: str, scene: Scene) -> nn.Module | None:
    """Build a field on torch's meta device, which holds shapes only; ``None`` if it reads values while it is built."""
    try:
        with torch.device("meta"):
            return config.build(scene)
    except InputError:
        return None  # incompatible with the scene: the error is raised where it is built
    except (RuntimeError, OverflowError, TypeError) as error:
        if "overflow" not in str(error).lower():
            return None  # building it raises the same error
        remedy = "Lower its sizes, or the 'resolution' of hooks."
        raise InputError(f"The field of {name} has more parameters than can be counted.", remedy) from error


def _bytes(field: nn.Module | None) -> int:
    """Bytes of a field's parameters."""
    return 0 if field is None else sum(parameter.numel() * parameter.element_size() for parameter in field.parameters())


def _grown_bytes(field: nn.Module | None, kept: float) -> tuple[int, int]:
    """Bytes of parameters and of links of a field of lattices, whose sparse ones keep a share of their rows."""
    if not isinstance(field, LatticeField):
        return 0, 0
    lattices = [lattice for encoding in field.lattice_encodings().values() for lattice in encoding.lattices()]
    linked = [lattice for lattice in lattices if lattice.links is not None]
    links = sum(lattice.links.numel() * lattice.links.element_size() for lattice in linked if lattice.links is not None)
    rows = sum(lattice.features.numel() * lattice.features.element_size() for lattice in linked)
    return _bytes(field) - round((1 - kept) * rows), links
