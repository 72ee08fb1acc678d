"""Scoring under a protocol: compositing, rounding, masks and crops; then every metric; then the mean over views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics import plugins
from invgraphics.core import Rendering, Scene, View
from invgraphics.core.colour import linear_to_srgb, quantise, srgb_to_linear
from invgraphics.errors import InputError, did_you_mean
from invgraphics.metrics.base import Inapplicable, Metric, Pair, Skip
from invgraphics.metrics.conventions import PROTOCOLS, Lpips, Measure, Protocol, Psnr, Rounding, Ssim
from invgraphics.metrics.image import psnr, ssim
from invgraphics.metrics.perceptual import lpips
from invgraphics.runs.scores import Score

Image = Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class ViewScore:
    """The metrics of one view.

    Attributes:
        view: the view's name.
        values: metric name -> value.
        skipped: metric name -> why it has no value.
    """

    view: str
    values: dict[str, float]
    skipped: dict[str, str]


def protocol_named(name: str) -> Protocol:
    """Look up one of our own protocols.

    Raises:
        InputError: unknown name, the known ones are listed; or the name of another tool's, which only rescoring takes.
    """
    own = [known for known, protocol in PROTOCOLS.items() if not protocol.source]
    if name not in PROTOCOLS:
        raise InputError(f"There is no protocol '{name}'.{did_you_mean(name, own)}", f"Known protocols: {', '.join(own)}.")
    if PROTOCOLS[name].source:
        raise InputError(
            f"'{name}' is the protocol of another tool; a fit is evaluated under our own: {', '.join(own)}.",
            f"Score the finished run again: invgraphics rescore RUN --protocol {name}.",
        )
    return PROTOCOLS[name]


def prepare(rendering: Rendering, view: View, scene: Scene, protocol: Protocol) -> Pair:
    """Composite, convert to display sRGB, round, mask and crop a rendering and its view: the pair that metrics compare.

    Args:
        rendering: prediction of shape (h, w), in the scene's local frame and colour space.
        view: the truth.
        scene: where both come from; its background is used where the protocol says so, and where nothing is transparent.
        protocol: the conventions.

    Raises:
        InputError: prediction and truth differ in size, or the crop leaves nothing.
        Skip: the prediction's colour or alpha is not finite somewhere, or the view has a mask and the protocol supports none.
    """
    height, width = view.image.shape[:2]
    if tuple(rendering.alpha.shape) != (height, width):
        got = "x".join(str(size) for size in reversed(rendering.alpha.shape))
        raise InputError(f"The prediction of view '{view.name}' is {got} pixels, the truth is {width}x{height}.")
    if 2 * protocol.crop >= min(height, width):
        raise InputError(f"Protocol '{protocol.name}' crops {protocol.crop} pixels of every side; '{view.name}' has no more.")
    rendering = rendering.detach()
    if sentence := describe_non_finite_pixels(rendering):
        raise Skip(sentence)
    image, truth, mask = _masked(*_composited(rendering, view, scene, protocol), view, protocol)
    pair = Pair(
        image=image,
        truth=truth,
        pred_alpha=rendering.alpha,
        true_alpha=None if view.alpha is None else view.opacity().to(image),
        pred_depth=rendering.depth * scene.scale,
        true_depth=None if view.depth is None else view.depth.to(image) * scene.scale,
        pred_normal=rendering.normal,
        true_normal=None if view.normal is None else view.normal.to(image),
        mask=mask,
    )
    return pair.cropped(protocol.crop) if protocol.crop else pair


def describe_non_finite_pixels(rendering: Rendering) -> str:
    """Describe how many pixels have a NaN or infinite colour or alpha; empty if none has."""
    broken = ~(rendering.rgb.isfinite().all(dim=-1) & rendering.alpha.isfinite())
    count = int(broken.sum())
    return f"the predicted colour or alpha is not finite at {count} of {broken.numel()} pixels" if count else ""


def _composited(rendering: Rendering, view: View, scene: Scene, protocol: Protocol) -> tuple[Image, Image]:
    """Prediction and truth over the protocol's background, display sRGB in [0, 1], quantised by its rules."""
    background = scene.background
    if view.alpha is not None and protocol.background != "scene":
        background = torch.tensor(protocol.background)
        background = srgb_to_linear(background) if scene.colour == "linear" else background
    image = rounded(_display(rendering.over(background.to(rendering.rgb)), scene), protocol.prediction)
    if protocol.truth_opaque:
        view = replace(view, alpha=None)
    over = _over_in_double if protocol.truth_double and view.image.dtype == torch.uint8 else View.over
    colour = over(view, background.to(view.image.device, torch.float32))
    return image, rounded(_display(colour, scene), protocol.truth).to(image)


def _masked(image: Image, truth: Image, view: View, protocol: Protocol) -> tuple[Image, Image, Bool[Tensor, "h w"] | None]:
    """Both pictures with the view's mask applied, and the mask where means are restricted to it."""
    if view.mask is None or (protocol.masks != "excluded" and bool(view.mask.all())):
        return image, truth, None
    if protocol.masks == "unknown":
        raise Skip(f"the view has a mask, and {protocol.name} does not support masks")
    mask = view.mask.to(image.device, torch.bool)
    if protocol.masks == "zero":
        return image * mask[..., None], truth * mask[..., None], None
    return torch.where(mask[..., None], image, truth), truth, mask


def _display(colour: Image, scene: Scene) -> Image:
    return linear_to_srgb(colour) if scene.colour == "linear" else colour.clamp(0, 1)


def _over_in_double(view: View, background: Float[Tensor, 3]) -> Image:
    """`View.over` for bytes, in double precision."""
    if view.alpha is None:
        return view.image.double() / 255
    alpha = view.alpha[..., None].double() / 255
    return view.image.double() / 255 * alpha + (1 - alpha) * background.double()


def rounded(display: Image, rounding: Rounding) -> Image:
    """Display colours in [0, 1] quantised to 8 bits, or unchanged for ``none``."""
    if rounding == "none":
        return display
    levels = quantise(display) if rounding == "nearest" else (display.clamp(0, 1) * 255).to(torch.uint8)
    return levels.float() / 255


def score(rendering: Rendering, view: View, scene: Scene, protocol: Protocol, only: Sequence[str] | None = None) -> ViewScore:
    """Score one view with every metric of the protocol, or with those named in ``only``.

    Raises:
        InputError: an unknown metric in ``only``, or a prediction of the wrong size.
    """
    wanted = list(only if only is not None else plugins.names("metrics") if protocol.measures is None else protocol.measures)
    values: dict[str, float] = {}
    skipped: dict[str, str] = {}
    try:
        pair = prepare(rendering, view, scene, protocol)
    except Skip as reason:
        return ViewScore(view.name, {}, dict.fromkeys(wanted, str(reason)))
    for name in wanted:
        try:
            values[name] = _registered(name, pair) if protocol.measures is None else measure(protocol.measures[name], pair)
        except Inapplicable:
            continue
        except Skip as reason:
            skipped[name] = str(reason)
    return ViewScore(view.name, values, skipped)


def measure(how: Measure, pair: Pair) -> float:
    """Compute PSNR (dB), SSIM or LPIPS of a pair with the given settings.

    Raises:
        Skip: the pictures are too small, no pixel counts, or LPIPS lacks its weights.
    """
    if isinstance(how, Psnr):
        return psnr(pair, how)
    return ssim(pair, how) if isinstance(how, Ssim) else lpips(pair, how)


def _registered(name: str, pair: Pair) -> float:
    metric = _metric(name)
    try:
        value = float(metric.compute(pair))
    except Skip:
        raise
    except Exception as error:
        if plugins.origin("metrics", name) == "built in":
            raise
        # A third-party metric's mistake must not cost the scores of a finished fit.
        raise Skip(f"{plugins.origin('metrics', name)}: {type(error).__name__}: {error}") from error
    if not math.isfinite(value):
        raise Skip(f"the value is not finite ({value})")
    return value


def _metric(name: str) -> Metric:
    foreign = name in plugins.names("metrics") and plugins.origin("metrics", name) != "built in"
    try:
        metric = plugins.load("metrics", name)
    except InputError as error:
        if foreign:
            raise Skip(error.sentence) from error
        raise
    if not isinstance(metric, Metric):
        raise Skip(f"{plugins.origin('metrics', name)}: {plugins.names('metrics')[name]} is not an invgraphics Metric")
    return metric


def summarise(
    scores: Sequence[ViewScore], protocol: Protocol = PROTOCOLS["default"]
) -> tuple[dict[str, Score], dict[str, str]]:
    """Average scores over views by the protocol's rule: the ``quality`` and ``skipped`` parts of a ``scores.json``.

    A metric that is missing in any view gets no mean: means over different views cannot be compared. Why it is missing, and
    in which view first unless all views say the same, goes to ``skipped``.
    """
    names = list(dict.fromkeys(name for one in scores for name in (*one.values, *one.skipped)))
    quality: dict[str, Score] = {}
    skipped: dict[str, str] = {}
    for name in names:
        missing = [one for one in scores if name not in one.values]
        if missing:
            reasons = [one.skipped.get(name, "not computed") for one in missing]
            general = len(missing) == len(scores) and len(set(reasons)) == 1
            skipped[name] = reasons[0] if general else f"view {missing[0].view}: {reasons[0]}"
            continue
        quality[name] = _joined(name, [one.values[name] for one in scores], protocol)
    return quality, skipped


def _joined(name: str, values: list[float], protocol: Protocol) -> Score:
    """Average one metric over views by the protocol's rule: mean, unit, direction and per-view values."""
    mean = math.fsum(values) / len(values)
    if protocol.measures is None:
        metric = _metric(name)
        unit, higher_is_better = metric.unit, metric.higher_is_better
    else:
        how = protocol.measures[name]
        if isinstance(how, Psnr) and how.views == "mean error":
            mean = -10 * math.log10(math.fsum(10 ** (-value / 10) for value in values) / len(values))
        unit, higher_is_better = ("dB" if isinstance(how, Psnr) else ""), not isinstance(how, Lpips)
    return Score(mean=mean, unit=unit, higher_is_better=higher_is_better, per_view=tuple(values))
