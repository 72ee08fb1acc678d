"""Scoring protocols as data: our own, and the evaluation conventions of other tools.

A number such as "31.2 dB" means little without its conventions. Each `Protocol` states one set of them, another tool's as read
in the source files that it names; `invgraphics.metrics.protocols` carries them out. Imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Colour = tuple[float, float, float]

Rounding = Literal["none", "nearest", "down"]
"""What happens to a picture after compositing: floats stay, or bytes by rounding, or bytes by truncation."""


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
        grey: whether SSIM is computed on Rec. 709 luma, instead of on each channel.
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
class Protocol:
    """Settings of scoring: background, rounding, masks and crop of both pictures, and the metrics that compare them.

    No protocol below crops a picture; SSIM's own border is part of its `Ssim`. Pictures are composited in the scene's colour
    space and measured in display sRGB.

    Attributes:
        name: name on the command line and in ``scores.<name>.json``.
        summary: one line for a table.
        source: of another tool: the repository, its commit, and the files in which this was read; empty for our own.
        measures: name in the scores -> what is measured; ``None`` for every registered metric.
        background: what is put behind transparent pixels; ``scene`` is the colour that the data set declares. Photographs
            without alpha have no background to choose. Other colours are display colours, which linear scenes convert.
        prediction: rounding of the prediction; ``none`` needs unrounded predictions.
        truth: rounding of the truth.
        truth_double: whether the truth is composited in double precision. It decides on which side of a whole byte truncation
            falls at the edges of things.
        masks: treatment of pixels outside a view's mask: ``excluded`` from every mean, and equal in both pictures, so that
            windows see no error there; multiplied by ``zero`` in both pictures; or ``unknown`` to the tool.
        crop: pixels left out along each border.
        widest: the tool's loader scales wider pictures down to this width in pixels; ``None``: it does not.
        truth_opaque: whether the truth's alpha is dropped: transparent pixels show whatever colour they have in the file.
    """

    name: str
    summary: str
    source: str = ""
    measures: Mapping[str, Measure] | None = field(default=None, hash=False)
    background: Literal["scene"] | Colour = "scene"
    prediction: Rounding = "none"
    truth: Rounding = "none"
    truth_double: bool = False
    masks: Literal["excluded", "zero", "unknown"] = "unknown"
    crop: int = 0
    widest: int | None = None
    truth_opaque: bool = False

    def record(self) -> dict[str, Any]:
        """Settings as plain values for a file; optional ones only where they are set."""
        always = ("name", "summary", "background", "prediction", "truth", "masks")
        return {name: value for name, value in asdict(self).items() if value or name in always}


WHITE: Colour = (1.0, 1.0, 1.0)
BLACK: Colour = (0.0, 0.0, 0.0)

VISER_GREY: Colour = (0.1490, 0.1647, 0.2157)
"""Background of splatfacto in evaluation, unless it is configured."""

NGP_KERNEL = (0.120078, 0.233881, 0.292082, 0.233881, 0.120078)
"""The window of instant-ngp's SSIM along one axis."""

_GAUSSIAN_SPLATTING = "graphdeco-inria/gaussian-splatting@472689c"
_LOADED_DOWN = "scene/dataset_readers.py (the truth's bytes are truncated), utils/camera_utils.py (1600 pixels)"
_NERFSTUDIO = "nerfstudio-project/nerfstudio@50e0e3c"
_TORCHMETRICS = "torchmetrics 1.4.2 or later (functional/image/ssim.py; earlier ones leave SSIM's border out)"
_SPLATTING_MEASURES: dict[str, Measure] = {"psnr": Psnr(), "ssim": Ssim(edges="zero"), "lpips_vgg": Lpips("vgg", scaled=False)}

_OWN = (
    Protocol(
        "default",
        "8-bit pictures over the scene's background, no crop, mean over views",
        prediction="nearest",
        truth="nearest",
        masks="excluded",
    ),
    Protocol("float", "as default, with unrounded pictures", masks="excluded"),
)

_OTHERS = (
    Protocol(
        "nerfbaselines",
        "both pictures truncated to bytes over the data set's background; SSIM inside the border; both LPIPS",
        "nerfbaselines/nerfbaselines@cde53bd nerfbaselines/evaluation.py, metrics.py, utils.py (convert_image_dtype)",
        {"psnr": Psnr(), "ssim": Ssim(), "lpips": Lpips(), "lpips_vgg": Lpips("vgg")},
        prediction="down",
        truth="down",
        masks="zero",
    ),
    Protocol(
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
    Protocol(
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
    Protocol(
        "3dgs-train",
        "what train.py prints: unrounded predictions over black, mean of three PSNRs, one for each channel",
        f"{_GAUSSIAN_SPLATTING} train.py (training_report), utils/image_utils.py, {_LOADED_DOWN}",
        {"psnr": Psnr(channels="apart")},
        background=BLACK,
        truth="down",
        truth_double=True,
        widest=1600,
    ),
    Protocol(
        "multinerf",
        "predictions rounded to 8 bits, truth unrounded, over white; SSIM inside the border",
        "google-research/multinerf@5b4d4f6 eval.py (eval_quantize_metrics), internal/image.py, internal/datasets.py",
        {"psnr": Psnr(), "ssim": Ssim()},
        background=WHITE,
        prediction="nearest",
    ),
    Protocol(
        "nerf-pytorch",
        "unrounded pictures over white (white_bkgd); PSNR only",
        "yenchenlin/nerf-pytorch@63a5a63 run_nerf.py (render_path), run_nerf_helpers.py (mse2psnr)",
        {"psnr": Psnr()},
        background=WHITE,
    ),
    Protocol(
        "nerfstudio-nerf",
        "unrounded pictures over the data set's background; SSIM mirrored at the border, its range measured in each pair",
        f"{_NERFSTUDIO} nerfstudio/models/nerfacto.py (likewise vanilla_nerf.py, instant_ngp.py, tensorf.py), {_TORCHMETRICS}",
        {"psnr": Psnr(), "ssim": Ssim(edges="mirror", data_range=None), "lpips": Lpips()},
    ),
    Protocol(
        "nerfstudio-splatfacto",
        "unrounded pictures over the viewer's dark grey; SSIM inside the border",
        f"{_NERFSTUDIO} nerfstudio/models/splatfacto.py",
        {"psnr": Psnr(), "ssim": Ssim(), "lpips": Lpips()},
        background=VISER_GREY,
    ),
    Protocol(
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
    Protocol(
        "gsplat",
        "unrounded pictures over black (its loader drops the truth's alpha channel); SSIM mirrored at the border",
        f"nerfstudio-project/gsplat@90d7b4b examples/simple_trainer.py (eval), examples/datasets/colmap.py, {_TORCHMETRICS}",
        {"psnr": Psnr(), "ssim": Ssim(edges="mirror"), "lpips": Lpips()},
        background=BLACK,
        truth_opaque=True,
    ),
)

PROTOCOLS = {protocol.name: protocol for protocol in (*_OWN, *_OTHERS)}
"""Every protocol by name: our own, which apply every registered metric, then those of other tools."""
