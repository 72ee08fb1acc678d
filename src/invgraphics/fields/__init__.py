"""Parameterisations of a scene (see `invgraphics.core.Field`); each entry is a frozen config with ``build(scene)``."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

FIELDS = {
    "neural": "invgraphics.fields.neural:NeuralFieldConfig",
    "gaussians": "invgraphics.fields.gaussian:GaussianFieldConfig",
    "points": "invgraphics.fields.points:PointFieldConfig",
}

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
