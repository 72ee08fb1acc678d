"""Renderers (see `invgraphics.core.Renderer`); each entry is a frozen config with ``build(scene)``."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

RENDERERS = {
    "volumetric": "invgraphics.renderers.volumetric:VolumetricConfig",
    "volsdf": "invgraphics.renderers.volsdf:VolSDFConfig",
    "neus": "invgraphics.renderers.neus:NeuSConfig",
    "splatting": "invgraphics.renderers.splatting:SplattingConfig",
    "gaussian_exact": "invgraphics.renderers.gaussians.volume:GaussianExactConfig",
    "sphere_tracing": "invgraphics.renderers.sphere_tracing:SphereTracingConfig",
    "surface": "invgraphics.renderers.surface:SurfaceConfig",
    "planes": "invgraphics.renderers.planes:PlanesConfig",
    "depth_warp": "invgraphics.renderers.depth_warp:DepthWarpConfig",
    "gaussian_sorted": "invgraphics.renderers.gaussians.volume:GaussianSortedConfig",
    "srn": "invgraphics.renderers.srn:SRNConfig",
    "ray_attention": "invgraphics.renderers.ray_attention:RayAttentionConfig",
}

SAMPLERS = {
    "stratified": "invgraphics.renderers.samplers:StratifiedConfig",
    "hierarchical": "invgraphics.renderers.samplers:HierarchicalConfig",
    "occupancy": "invgraphics.renderers.occupancy:OccupancyConfig",
    "proposals": "invgraphics.renderers.proposals:ProposalsConfig",
    "error_bounded": "invgraphics.renderers.error_bounded:ErrorBoundedConfig",
    "up_sampling": "invgraphics.renderers.up_sampling:UpSamplingConfig",
}

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
