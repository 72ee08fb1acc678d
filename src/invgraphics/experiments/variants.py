"""Named renderer variants, for rendering a field that was fitted through another renderer."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from invgraphics.core import Field, Quantity, Renderer
from invgraphics.fields.mesh import ExtractedMesh
from invgraphics.fields.similarity import ShortestThird
from invgraphics.recipes.recipe import Method, load_method, presets, resolve, split_name
from invgraphics.renderers.splatting import Splatting
from invgraphics.renderers.surface import Surface
from invgraphics.text import sha256_of, slug

_SETTING = r":(?=[\w.]+=)"


@dataclass(frozen=True)
class RendererVariant:
    """A named renderer, with its settings, for rendering a fitted field.

    Attributes:
        name: as requested, ``METHOD`` or ``METHOD:key=value:key=value`` with keys of the recipe's renderer.
        table: the resolved ``[renderer]`` of its recipe.
    """

    name: str
    table: dict[str, Any]

    @property
    def digest(self) -> str:
        """SHA-256 of the settings."""
        return sha256_of(self.table)

    @property
    def folder(self) -> str:
        """The variant's name as one folder name."""
        method, *settings = re.split(_SETTING, self.name)
        return re.sub(r"[^\w.=+-]+", "-", "-".join([slug(method), *settings]))


def variant_named(name: str, preset: str = "") -> RendererVariant:
    """Parse an entry of ``--render-with``.

    Args:
        name: of the variant; ``preset=NAME`` among its settings takes the renderer of that preset.
        preset: of the fit that is rendered, which applies where the name has none and its recipe has one of that name.

    Raises:
        InputError: unknown method, preset or setting, or a renderer of several parts whose recipe does not say which.
    """
    method, named, settings = split_name(name)
    chosen = preset if named is None and preset in presets(method) else named
    recipe = load_method(method, chosen, tuple(f"renderer.{item}" for item in settings))
    return RendererVariant(name, recipe.table["renderer"])


def with_renderer(method: Method, variant: RendererVariant) -> Method:
    """Replace a method's renderer."""
    name = f"{method.name} rendered with {variant.name}"
    return resolve(name, method.preset, method.table | {"renderer": variant.table})


def as_shown(field: Field, renderer: Renderer) -> Field:
    """A fitted field as a renderer that did not fit it sees it: as the mesh of its surface, where the renderer needs one,
    and with the shortest axis of each Gaussian third, where it draws discs.

    Args:
        field: with a mesh, or with density or signed distance and radiance, it can be seen as a mesh.
        renderer: whose settings say how fine the mesh is.
    """
    extractable = Quantity.RADIANCE in field.provides and (Quantity.SDF | Quantity.DENSITY) & field.provides
    if isinstance(renderer, Surface) and Quantity.MESH not in field.provides and extractable:
        return ExtractedMesh(field, renderer.config.resolution, renderer.config.level)
    if isinstance(renderer, Splatting) and renderer.config.flat and Quantity.GAUSSIANS in field.provides:
        return ShortestThird(field)
    return field
