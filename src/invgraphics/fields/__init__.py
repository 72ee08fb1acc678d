"""Parameterisations of a scene (see `invgraphics.core.Field`); each entry is a frozen config with ``build(scene)``."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

FIELDS = {
    "neural": "invgraphics.fields.neural:NeuralFieldConfig",
    "features": "invgraphics.fields.features:FeatureFieldConfig",
    "gaussians": "invgraphics.fields.gaussian:GaussianFieldConfig",
}

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
