"""Ways to make a picture (see `invgraphics.core.Renderer`); each entry is a frozen config with ``build(scene)``."""

RENDERERS = {
    "volumetric": "invgraphics.renderers.volumetric:VolumetricConfig",
    "splatting": "invgraphics.renderers.splatting:SplattingConfig",
}

SAMPLERS = {
    "stratified": "invgraphics.renderers.samplers:StratifiedConfig",
    "hierarchical": "invgraphics.renderers.samplers:HierarchicalConfig",
    "occupancy": "invgraphics.renderers.occupancy:OccupancyConfig",
}
