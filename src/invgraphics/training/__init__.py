"""Fitting a field by gradient descent through a renderer; losses and hooks are frozen configs with ``build()``."""

LOSSES = {
    "photometric": "invgraphics.training.losses:PhotometricConfig",
    "coarse": "invgraphics.training.losses:CoarseConfig",
    "ssim": "invgraphics.training.losses:SsimConfig",
    "distortion": "invgraphics.training.losses:DistortionConfig",
}

HOOKS = {
    "density_control": "invgraphics.training.density_control:DensityControlConfig",
    "sh_degree": "invgraphics.training.hooks:ShDegreeConfig",
}
