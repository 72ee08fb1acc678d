"""Parameterisations of a scene (see `invgraphics.core.Field`); each entry is a frozen config with ``build(scene)``."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

FIELDS = {
    "neural": "invgraphics.fields.neural:NeuralFieldConfig",
    "density": "invgraphics.fields.density_field:DensityFieldConfig",
    "features": "invgraphics.fields.features:FeatureFieldConfig",
    "conditional": "invgraphics.fields.conditional.field:ConditionalFieldConfig",
    "gaussians": "invgraphics.fields.gaussian:GaussianFieldConfig",
    "points": "invgraphics.fields.points.field:PointFieldConfig",
    "mesh": "invgraphics.fields.mesh:MeshFieldConfig",
    "planes": "invgraphics.fields.planes:PlanesConfig",
    "depth_maps": "invgraphics.fields.depth_maps:DepthMapsConfig",
}

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
