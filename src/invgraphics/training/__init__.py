"""Fitting a field by gradient descent through a renderer; losses and hooks are frozen configs with ``build()``."""

LOSSES = {
    "photometric": "invgraphics.training.losses:PhotometricConfig",
    "coarse": "invgraphics.training.losses:CoarseConfig",
    "ssim": "invgraphics.training.losses:SsimConfig",
    "opacity": "invgraphics.training.splat_losses:OpacityConfig",
    "scale": "invgraphics.training.splat_losses:ScaleConfig",
    "distortion": "invgraphics.training.losses:DistortionConfig",
}

HOOKS = {
    "density_control": "invgraphics.training.density_control:DensityControlConfig",
    "relocation": "invgraphics.training.relocation:RelocationConfig",
    "smoothing": "invgraphics.training.smoothing:SmoothingConfig",
    "limits": "invgraphics.training.limits:LimitsConfig",
    "sh_degree": "invgraphics.training.hooks:ShDegreeConfig",
}
