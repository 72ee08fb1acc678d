"""Image and geometry metrics as pure functions of prediction and ground truth, and the scoring protocols that apply them."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

METRICS = {
    "psnr": "invgraphics.metrics.image:PSNR",
    "ssim": "invgraphics.metrics.image:SSIM",
    "ms_ssim": "invgraphics.metrics.image:MS_SSIM",
    "flip": "invgraphics.metrics.perceptual:FLIP",
    "lpips": "invgraphics.metrics.perceptual:LPIPS",
    "psnr_exposed": "invgraphics.metrics.exposure:PSNR_EXPOSED",
    "depth_abs_rel": "invgraphics.metrics.geometry:DEPTH_ABS_REL",
    "depth_rmse": "invgraphics.metrics.geometry:DEPTH_RMSE",
    "depth_abs_rel_smooth": "invgraphics.metrics.geometry:DEPTH_ABS_REL_SMOOTH",
    "depth_rmse_smooth": "invgraphics.metrics.geometry:DEPTH_RMSE_SMOOTH",
    "normal_deg": "invgraphics.metrics.geometry:NORMAL_DEG",
    "alpha_iou": "invgraphics.metrics.geometry:ALPHA_IOU",
}

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
