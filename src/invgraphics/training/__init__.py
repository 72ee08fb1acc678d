"""Fitting a field by gradient descent through a renderer; losses are callable frozen configs, hooks have a ``build()``."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

LOSSES = {
    "photometric": "invgraphics.training.losses:PhotometricLoss",
    "coarse": "invgraphics.training.losses:CoarseLoss",
    "ssim": "invgraphics.training.losses:SsimLoss",
    "opacity": "invgraphics.training.splat_losses:OpacityLoss",
    "scale": "invgraphics.training.splat_losses:ScaleLoss",
    "distortion": "invgraphics.training.losses:DistortionLoss",
}

HOOKS = {
    "density_control": "invgraphics.training.density_control:DensityControlConfig",
    "relocation": "invgraphics.training.relocation:RelocationConfig",
    "smoothing": "invgraphics.training.smoothing:SmoothingConfig",
    "limits": "invgraphics.training.limits:LimitsConfig",
    "sh_degree": "invgraphics.training.hooks:ShDegreeConfig",
}

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
