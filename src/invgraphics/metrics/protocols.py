"""Protocols: the conventions under which metrics are computed. Evaluation owns background, quantisation and crops."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics import plugins
from invgraphics.core import Rendering, Scene, View
from invgraphics.core.colour import linear_to_srgb, quantise
from invgraphics.errors import InputError, did_you_mean
from invgraphics.metrics.base import Metric, Pair, Skip
from invgraphics.metrics.conventions import CONVENTIONS, PROTOCOLS, Protocol


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
    """Look one of our own protocols up.

    Raises:
        InputError: unknown name, the known ones are listed; or the name of another tool's, which only rescoring knows.
    """
    if name in CONVENTIONS:
        raise InputError(
            f"'{name}' is the protocol of another tool; a fit is evaluated under our own: {', '.join(PROTOCOLS)}.",
            f"Score the finished run again: invgraphics rescore RUN --protocol {name}.",
        )
    if name not in PROTOCOLS:
        raise InputError(
            f"There is no protocol '{name}'.{did_you_mean(name, PROTOCOLS)}", f"Known protocols: {', '.join(PROTOCOLS)}."
        )
    return PROTOCOLS[name]


def display_colour(colour: Float[Tensor, "*p 3"], scene: Scene, protocol: Protocol) -> Float[Tensor, "*p 3"]:
    """Composited colours as the protocol shows them: display sRGB in [0, 1], rounded to 8 bits if it says so."""
    display = linear_to_srgb(colour) if scene.colour == "linear" else colour.clamp(0, 1)
    return quantise(display).float() / 255 if protocol.quantise else display


def background_of(scene: Scene, protocol: Protocol) -> Float[Tensor, 3]:
    """The protocol's background, in the scene's colour space."""
    if protocol.background == "scene":
        return scene.background
    return torch.full_like(scene.background, 1.0 if protocol.background == "white" else 0.0)


def prepare(rendering: Rendering, view: View, scene: Scene, protocol: Protocol) -> Pair:
    """Put a rendering and its view under a protocol.

    Args:
        rendering: prediction of shape (h, w), in the scene's local frame and colour space.
        view: the truth.
        scene: where both come from.
        protocol: the conventions.

    Raises:
        InputError: prediction and truth differ in size, or the crop leaves nothing.
        Skip: the prediction's colour or alpha is not finite somewhere.
    """
    height, width = view.image.shape[:2]
    if tuple(rendering.alpha.shape) != (height, width):
        got = "x".join(str(size) for size in reversed(rendering.alpha.shape))
        raise InputError(f"The prediction of view '{view.name}' is {got} pixels, the truth is {width}x{height}.")
    if 2 * protocol.crop >= min(height, width):
        raise InputError(f"Protocol '{protocol.name}' crops {protocol.crop} pixels of every side; '{view.name}' has no more.")
    rendering = rendering.detach()
    broken = ~(rendering.rgb.isfinite().all(dim=-1) & rendering.alpha.isfinite())
    if broken.any():
        raise Skip(f"the predicted colour or alpha is not finite at {int(broken.sum())} of {broken.numel()} pixels")
    background = background_of(scene, protocol).to(rendering.rgb)
    image = display_colour(rendering.over(background), scene, protocol)
    truth = display_colour(view.over(background.to(view.image.device)), scene, protocol).to(image)
    mask = None if view.mask is None else view.mask.to(image.device, torch.bool)
    pair = Pair(
        image=image if mask is None else torch.where(mask[..., None], image, truth),
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


def score(rendering: Rendering, view: View, scene: Scene, protocol: Protocol, only: Sequence[str] | None = None) -> ViewScore:
    """Score one view with every registered metric, or with those named in ``only``.

    Raises:
        InputError: an unknown metric in ``only``, or a prediction of the wrong size.
    """
    wanted = list(plugins.names("metrics")) if only is None else list(only)
    values: dict[str, float] = {}
    skipped: dict[str, str] = {}
    try:
        pair = prepare(rendering, view, scene, protocol)
    except Skip as reason:
        return ViewScore(view.name, {}, dict.fromkeys(wanted, str(reason)))
    for name in wanted:
        try:
            values[name] = _value(name, pair)
        except Skip as reason:
            skipped[name] = str(reason)
    return ViewScore(view.name, values, skipped)


def _value(name: str, pair: Pair) -> float:
    metric = _metric(name)
    try:
        value = float(metric.compute(pair))
    except Skip:
        raise
    except Exception as error:
        if plugins.origin("metrics", name) == "built in":
            raise
        # A stranger's mistake must not cost the scores of a finished fit.
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
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Join the views into the ``quality`` and the ``skipped`` part of a ``scores.json``, see `join_views`."""

    def joined(name: str, values: list[float]) -> dict[str, Any]:
        metric = _metric(name)
        mean = _mean(values, metric.unit, protocol)
        return {"mean": mean, "unit": metric.unit, "higher_is_better": metric.higher_is_better}

    return join_views(scores, joined)


def join_views(
    scores: Sequence[ViewScore], joined: Callable[[str, list[float]], dict[str, Any]]
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Join the views' scores into the ``quality`` and the ``skipped`` part of a ``scores.json``.

    A metric that is missing in any view gets no mean: means over different views cannot be compared. Why it is missing, and
    in which view first, goes to ``skipped``.

    Args:
        scores: of all views.
        joined: mean, unit and direction of a metric, from its name and its values.
    """
    names = list(dict.fromkeys(name for one in scores for name in (*one.values, *one.skipped)))
    quality: dict[str, dict[str, Any]] = {}
    skipped: dict[str, str] = {}
    for name in names:
        missing = [one for one in scores if name not in one.values]
        if missing:
            reason = missing[0].skipped.get(name, "not computed")
            skipped[name] = reason if len(missing) == len(scores) else f"view {missing[0].view}: {reason}"
            continue
        values = [one.values[name] for one in scores]
        quality[name] = {**joined(name, values), "per_view": values}
    return quality, skipped


def _mean(values: list[float], unit: str, protocol: Protocol) -> float:
    if protocol.aggregation == "psnr_of_mean_mse" and unit == "dB":
        return -10 * math.log10(math.fsum(10 ** (-value / 10) for value in values) / len(values))
    return math.fsum(values) / len(values)
