"""How pictures are measured, as data: our own protocols, and those of the tools whose numbers a paper compares itself with.

A number such as "31.2 dB" means little without its conventions. Each `Convention` states those of one tool, as read in the
source file that it names; `invgraphics.metrics.measures` holds the small functions that carry them out. Imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Colour = tuple[float, float, float]

Rounding = Literal["none", "nearest", "down"]
"""What happens to a picture after compositing: floats stay, or bytes by rounding, or bytes by truncation."""


@dataclass(frozen=True)
class Protocol:
    """What is fixed before one of our own metrics looks at a picture.

    Attributes:
        name: name in scores and on the command line.
        quantise: whether both pictures are rounded to 8 bits after compositing, as their PNG files are.
        background: what transparent pixels are put in front of; ``scene`` is the colour that the data set declares.
        crop: pixels left out along each border.
        aggregation: how views are joined: the mean of their values; or, for metrics in dB, the value of the mean error.
        summary: one line for a table of protocols.
    """

    name: str
    quantise: bool = True
    background: Literal["scene", "white", "black"] = "scene"
    crop: int = 0
    aggregation: Literal["mean_of_views", "psnr_of_mean_mse"] = "mean_of_views"
    summary: str = ""


PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        Protocol("default", summary="8-bit pictures over the scene's background, no crop, mean over views"),
        Protocol("float", quantise=False, summary="as default, with unrounded pictures"),
    )
}
"""Our own protocols by name; they apply every registered metric."""


@dataclass(frozen=True)
class Psnr:
    """Peak signal-to-noise ratio for colours in [0, 1].

    Attributes:
        channels: one mean squared error over all channels; or the mean of three PSNRs, one for each channel, which is at
            least as large (Jensen's inequality) and larger where the channels' errors differ.
        views: the mean of the views' values; or the value of the views' mean squared error.
    """

    channels: Literal["together", "apart"] = "together"
    views: Literal["mean of views", "mean error"] = "mean of views"


@dataclass(frozen=True)
class Ssim:
    """Structural similarity (Wang et al. 2004, eq. 13, with k1 = 0.01 and k2 = 0.03) with population covariances.

    Attributes:
        kernel: the separable window's weights along one axis; empty for the published Gaussian of 11 taps, sigma 1.5.
        edges: ``valid``: windows wholly inside the picture only; or everywhere, and the picture goes on as ``zero``, as
            ``mirror`` (the edge pixel occurs once: dcb|abcd) or as ``reflect`` (twice: cba|abcd).
        data_range: the range L of the values; ``None`` measures it in each pair: the larger max - min of the two pictures.
        grey: whether the window looks at Rec. 709 luma, instead of at each channel in turn.
    """

    kernel: tuple[float, ...] = ()
    edges: Literal["valid", "zero", "mirror", "reflect"] = "valid"
    data_range: float | None = 1.0
    grey: bool = False


@dataclass(frozen=True)
class Lpips:
    """Learned perceptual similarity v0.1 (Zhang et al. 2018).

    Attributes:
        net: the backbone.
        scaled: whether colours are scaled to [-1, 1], which the network was calibrated for; else they are given in [0, 1].
    """

    net: Literal["alex", "vgg"] = "alex"
    scaled: bool = True


Measure = Psnr | Ssim | Lpips


@dataclass(frozen=True)
class Convention:
    """How one tool measures.

    No tool below crops a picture by default; SSIM's own border is part of its `Ssim`. Pictures are composited in the scene's
    colour space and measured in display sRGB.

    Attributes:
        name: name on the command line and in ``scores.<name>.json``.
        summary: one line for a table.
        source: the repository, its commit, and the files in which this was read.
        measures: name in the scores -> what is measured.
        background: what is put behind transparent pixels; ``scene`` is the colour that the data set declares. Photographs
            without alpha have no background to choose.
        prediction: rounding of the prediction; ``none`` needs unrounded predictions.
        truth: rounding of the truth.
        truth_double: whether the truth is composited in double precision. It decides on which side of a whole byte truncation
            falls at the edges of things.
        masks: pixels that do not count are multiplied by zero in both pictures; or the tool knows no masks.
        widest: the tool's loader scales wider pictures down to this width in pixels; ``None``: it does not.
    """

    name: str
    summary: str
    source: str
    measures: Mapping[str, Measure] = field(hash=False)
    background: Literal["scene"] | Colour = "scene"
    prediction: Rounding = "none"
    truth: Rounding = "none"
    truth_double: bool = False
    masks: Literal["zero", "unknown"] = "unknown"
    widest: int | None = None


WHITE: Colour = (1.0, 1.0, 1.0)
BLACK: Colour = (0.0, 0.0, 0.0)

VISER_GREY: Colour = (0.1490, 0.1647, 0.2157)
"""What splatfacto shows behind a scene when it does not train, unless told another colour."""

NGP_KERNEL = (0.120078, 0.233881, 0.292082, 0.233881, 0.120078)
"""The window of instant-ngp's SSIM along one axis."""

_GAUSSIAN_SPLATTING = "graphdeco-inria/gaussian-splatting@472689c"
_LOADED_DOWN = "scene/dataset_readers.py (the truth's bytes are truncated), utils/camera_utils.py (1600 pixels)"
_NERFSTUDIO = "nerfstudio-project/nerfstudio@50e0e3c"
_TORCHMETRICS = "torchmetrics 1.4.2 or later (functional/image/ssim.py; earlier ones leave SSIM's border out)"
_SPLATTING_MEASURES: dict[str, Measure] = {"psnr": Psnr(), "ssim": Ssim(edges="zero"), "lpips_vgg": Lpips("vgg", scaled=False)}

_ALL = (
    Convention(
        "nerfbaselines",
        "both pictures truncated to bytes over the data set's background; SSIM inside the border; both LPIPS",
        "nerfbaselines/nerfbaselines@cde53bd nerfbaselines/evaluation.py, metrics.py, utils.py (convert_image_dtype)",
        {"psnr": Psnr(), "ssim": Ssim(), "lpips": Lpips(), "lpips_vgg": Lpips("vgg")},
        prediction="down",
        truth="down",
        masks="zero",
    ),
    Convention(
        "3dgs-metrics",
        "PNG files over black; SSIM with zeros beyond the border; LPIPS (VGG) of unscaled colours",
        f"{_GAUSSIAN_SPLATTING} metrics.py, render.py, utils/loss_utils.py, {_LOADED_DOWN}",
        _SPLATTING_MEASURES,
        background=BLACK,
        prediction="nearest",
        truth="down",
        truth_double=True,
        widest=1600,
    ),
    Convention(
        "3dgs-metrics-white",
        "as 3dgs-metrics with the option -w, as the paper's tables of synthetic scenes were made",
        f"{_GAUSSIAN_SPLATTING} metrics.py, render.py, utils/loss_utils.py, {_LOADED_DOWN}",
        _SPLATTING_MEASURES,
        background=WHITE,
        prediction="nearest",
        truth="down",
        truth_double=True,
        widest=1600,
    ),
    Convention(
        "3dgs-train",
        "what train.py prints: unrounded predictions over black, mean of three PSNRs, one for each channel",
        f"{_GAUSSIAN_SPLATTING} train.py (training_report), utils/image_utils.py, {_LOADED_DOWN}",
        {"psnr": Psnr(channels="apart")},
        background=BLACK,
        truth="down",
        truth_double=True,
        widest=1600,
    ),
    Convention(
        "multinerf",
        "predictions rounded to 8 bits, truth unrounded, over white; SSIM inside the border",
        "google-research/multinerf@5b4d4f6 eval.py (eval_quantize_metrics), internal/image.py, internal/datasets.py",
        {"psnr": Psnr(), "ssim": Ssim()},
        background=WHITE,
        prediction="nearest",
    ),
    Convention(
        "nerf-pytorch",
        "unrounded pictures over white (white_bkgd); PSNR only",
        "yenchenlin/nerf-pytorch@63a5a63 run_nerf.py (render_path), run_nerf_helpers.py (mse2psnr)",
        {"psnr": Psnr()},
        background=WHITE,
    ),
    Convention(
        "nerfstudio-nerf",
        "unrounded pictures over the data set's background; SSIM mirrored at the border, its range measured in each pair",
        f"{_NERFSTUDIO} nerfstudio/models/nerfacto.py (likewise vanilla_nerf.py, instant_ngp.py, tensorf.py), {_TORCHMETRICS}",
        {"psnr": Psnr(), "ssim": Ssim(edges="mirror", data_range=None), "lpips": Lpips()},
    ),
    Convention(
        "nerfstudio-splatfacto",
        "unrounded pictures over the viewer's dark grey; SSIM inside the border",
        f"{_NERFSTUDIO} nerfstudio/models/splatfacto.py",
        {"psnr": Psnr(), "ssim": Ssim(), "lpips": Lpips()},
        background=VISER_GREY,
    ),
    Convention(
        "instant-ngp",
        "unrounded pictures over black; SSIM of luma with five taps; PSNR also of the mean error over views",
        "NVlabs/instant-ngp@abe236e scripts/run.py (test_transforms), scripts/common.py (SSIM, compute_error)",
        {
            "psnr": Psnr(),
            "psnr_of_mean_mse": Psnr(views="mean error"),
            "ssim": Ssim(kernel=NGP_KERNEL, edges="reflect", grey=True),
        },
        background=BLACK,
    ),
    Convention(
        "gsplat",
        "unrounded pictures over black (its loader drops the truth's alpha channel); SSIM mirrored at the border",
        f"nerfstudio-project/gsplat@90d7b4b examples/simple_trainer.py (eval), examples/datasets/colmap.py, {_TORCHMETRICS}",
        {"psnr": Psnr(), "ssim": Ssim(edges="mirror"), "lpips": Lpips()},
        background=BLACK,
    ),
)

CONVENTIONS = {convention.name: convention for convention in _ALL}
"""The conventions of other tools by name."""
