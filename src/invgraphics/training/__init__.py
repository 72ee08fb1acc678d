"""Fitting a field by gradient descent through a renderer; losses and penalties are called, hooks have a ``build()``."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

LOSSES = {
    "photometric": "invgraphics.training.losses:PhotometricLoss",
    "coarse": "invgraphics.training.losses:CoarseLoss",
    "ssim": "invgraphics.training.losses:SsimLoss",
    "opacity": "invgraphics.training.losses:OpacityLoss",
    "scale": "invgraphics.training.losses:ScaleLoss",
    "distortion": "invgraphics.training.losses:DistortionLoss",
    "interlevel": "invgraphics.training.interlevel:InterlevelLoss",
    "background_entropy": "invgraphics.training.losses:BackgroundEntropyLoss",
    "point_colour": "invgraphics.training.losses:PointColourLoss",
    "eikonal": "invgraphics.training.eikonal:EikonalLoss",
    "mask": "invgraphics.training.losses:MaskLoss",
}

PENALTIES = {
    "total_variation": "invgraphics.training.penalties:TotalVariationPenalty",
    "l1": "invgraphics.training.penalties:L1Penalty",
    "sparsity": "invgraphics.training.penalties:SparsityPenalty",
    "curvature": "invgraphics.training.eikonal:CurvaturePenalty",
    "eikonal": "invgraphics.training.eikonal:EikonalPenalty",
    "code": "invgraphics.training.codes.penalty:CodePenalty",
    "confidence": "invgraphics.training.points.control:ConfidencePenalty",
}

HOOKS = {
    "density_control": "invgraphics.training.density_control:DensityControlConfig",
    "relocation": "invgraphics.training.relocation:RelocationConfig",
    "smoothing": "invgraphics.training.smoothing:SmoothingConfig",
    "limits": "invgraphics.training.limits:LimitsConfig",
    "upsample": "invgraphics.training.upsample:UpsampleConfig",
    "tight_box": "invgraphics.training.tight_box:TightBoxConfig",
    "prune": "invgraphics.training.prune:PruneConfig",
    "point_control": "invgraphics.training.points.control:PointControlConfig",
    "view_rates": "invgraphics.training.view_rates:ViewRatesConfig",
    "sh_degree": "invgraphics.training.hooks:ShDegreeConfig",
}

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
