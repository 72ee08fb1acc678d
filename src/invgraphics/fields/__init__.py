"""Parameterisations of a scene (see `invgraphics.core.Field`); each entry is a frozen config with ``build(scene)``."""

FIELDS = {
    "neural": "invgraphics.fields.neural:NeuralFieldConfig",
    "gaussians": "invgraphics.fields.gaussian:GaussianFieldConfig",
}
