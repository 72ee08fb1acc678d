"""Rescoring of saved pictures, a run's or another tool's, under named protocols."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from invgraphics.core import Rendering, View
from invgraphics.errors import InputError, did_you_mean
from invgraphics.experiments.progress import Reporter
from invgraphics.metrics.conventions import PROTOCOLS, Protocol
from invgraphics.metrics.protocols import ViewScore, score, summarise
from invgraphics.runs.scores import DEFAULT, ScoredTruth, Scores
from invgraphics.tools.predictions import PictureSet
from invgraphics.tools.rescoring import Rescored, background_name, has_model_scores, labels, scores_of

SHARED = ("psnr", "ssim", "lpips")
"""Metrics that are recomputed where a run's own scores hold the others already."""


def protocols_named(names: str) -> list[Protocol]:
    """Parse a comma-separated list of protocols, or ``all``.

    Raises:
        InputError: a name is unknown, or there is none.
    """
    wanted = list(PROTOCOLS) if names.strip() == "all" else [name.strip() for name in names.split(",") if name.strip()]
    known = f"Known protocols: {', '.join(PROTOCOLS)}; or all."
    if not wanted:
        raise InputError("No protocol is named.", known)
    for name in wanted:
        if name not in PROTOCOLS:
            raise InputError(f"There is no protocol '{name}'.{did_you_mean(name, PROTOCOLS)}", known)
    return [PROTOCOLS[name] for name in dict.fromkeys(wanted)]


def check_same_truth(sets: Sequence[PictureSet]) -> None:
    """Refuse sets of pictures with different ground truth, whose scores are not comparable.

    Raises:
        InputError: views, size, background or true pixels differ; the sentence names both sets and what differs.
    """
    for other in sets[1:]:
        first = sets[0]
        left_size, right_size = (f"{side.size[0]}x{side.size[1]}" for side in (first, other))
        facts: tuple[tuple[str, Any, Any], ...] = (
            ("numbers of views", len(first.names), len(other.names)),
            ("sizes", left_size, right_size),
            ("backgrounds", background_name(first.background), background_name(other.background)),
            ("true pixels", first.sha256[:12], other.sha256[:12]),
        )
        for what, left, right in facts:
            if left != right:
                raise InputError(
                    f"'{first.folder}' and '{other.folder}' have different {what} ({left} and {right}).",
                    "Numbers compare only on the same true pictures: same scene, views, resize and background.",
                )


def why_unsuited(pictures: PictureSet, protocol: Protocol, allow_8bit: bool = False) -> str:
    """Reason why pictures cannot be scored under a protocol, for lack of data that it needs; empty if they can.

    Args:
        pictures: what is to be scored.
        protocol: how they would be scored.
        allow_8bit: whether 8-bit predictions may stand in for unrounded ones.
    """
    background, widest = protocol.background, protocol.widest
    if protocol.prediction == "none" and pictures.eight_bit and not allow_8bit:
        return "needs unrounded predictions, and these are 8-bit pictures (--allow-8bit scores them all the same)"
    if pictures.transparency == "open" and background == "scene" and pictures.background is None:
        return "needs the data set's background: name it with --background"
    if pictures.transparency == "fixed" and background not in ("scene", pictures.background):
        wanted = background if isinstance(background, str) else background_name(background)
        present = background_name(pictures.background)
        return f"puts the scene in front of {wanted}; here it is in front of {present} already, without alpha to change that"
    if pictures.provenance and widest is not None and pictures.size[0] > widest:
        return f"its loader scales pictures wider than {widest} pixels down to that: fit at that size"
    return ""


def rescore(sets: Sequence[PictureSet], protocols: Sequence[Protocol], allow_8bit: bool = False) -> list[Rescored]:
    """Score every set under every protocol.

    Raises:
        InputError: the sets differ in their truth, or a picture cannot be read or has another size than its truth.
    """
    check_same_truth(sets)
    total, done = sum(len(one.names) for one in sets), 0
    result = []
    with Reporter("rescoring") as reporter:
        for pictures, label in zip(sets, labels([one.folder for one in sets]), strict=True):
            lacking = {one.name: why_unsuited(pictures, one, allow_8bit) for one in protocols}
            scores: dict[str, list[ViewScore]] = {one.name: [] for one in protocols if not lacking[one.name]}
            only = {name: _metrics(pictures, PROTOCOLS[name]) for name in scores}
            for index in range(len(pictures.names)):
                truth, predicted = pictures.truth(index), _predictions(pictures, index)
                for name, views in scores.items():
                    rendering = predicted(_wants_bytes(pictures, truth, PROTOCOLS[name]))
                    views.append(score(rendering, truth, pictures.scene, PROTOCOLS[name], only[name]))
                done += 1
                reporter.show(done / total, f"{label}, view {index + 1} of {len(pictures.names)}")
            tables = {one.name: _scores(pictures, one, scores.get(one.name), lacking[one.name]) for one in protocols}
            result.append(Rescored(pictures, label, tables))
    return result


def _predictions(pictures: PictureSet, index: int) -> Callable[[bool], Rendering]:
    """Read a view's prediction twice: from half-precision floats, and from its 8-bit picture."""
    return cache(lambda exact: _checked(pictures, index, exact))


def _metrics(pictures: PictureSet, protocol: Protocol) -> tuple[str, ...] | None:
    """Metrics to compute: a protocol's own; of ours, the shared ones where the run has the others; ``None`` for all."""
    if protocol.measures is not None:
        return tuple(protocol.measures)
    return SHARED if has_model_scores(pictures, protocol.name) else None


def _wants_bytes(pictures: PictureSet, truth: View, protocol: Protocol) -> bool:
    """Whether a protocol scores exactly the saved picture: rounded to 8 bits, over the scene's background."""
    same = truth.alpha is None or protocol.background in ("scene", pictures.background)
    return protocol.prediction == "nearest" and same


def _checked(pictures: PictureSet, index: int, exact: bool) -> Rendering:
    rendering = pictures.prediction(index, exact)
    (height, width), (true_height, true_width) = rendering.alpha.shape, pictures.truth(index).image.shape[:2]
    if (height, width) != (true_height, true_width):
        raise InputError(
            f"In '{pictures.folder}' the prediction of view '{pictures.names[index]}' is {width}x{height} pixels, "
            f"the truth is {true_width}x{true_height}."
        )
    return rendering


def _scores(pictures: PictureSet, protocol: Protocol, views: Sequence[ViewScore] | None, lacking: str) -> Scores:
    """Aggregate the scores of a set of pictures from those of its views."""
    if views is None:
        quality, skipped = {}, dict.fromkeys(SHARED if protocol.measures is None else protocol.measures, lacking)
    else:
        quality, skipped = summarise(views, protocol)
    run, own = pictures.provenance, scores_of(pictures, DEFAULT)
    eight_bit = pictures.eight_bit and protocol.prediction == "none"
    caution = ("The protocol needs unrounded predictions; 8-bit pictures were used.",) if eight_bit and not lacking else ()
    scene = "" if run is None else run.scene
    if own is not None:
        scene = own.scene
    truth = ScoredTruth(
        sha256=pictures.sha256, size=pictures.size, background=pictures.background, transparency=pictures.transparency
    )
    return Scores(
        method=pictures.folder.name if run is None else run.method,
        preset="" if run is None else run.preset,
        scene=scene,
        seed=None if run is None else run.seed,
        protocol=protocol.name,
        views=pictures.names,
        cost={} if own is None else own.cost,
        quality=quality,
        skipped=skipped,
        rescored=True,
        conventions=protocol.record(),
        truth=truth,
        notes=(*pictures.notes, *caution),
    )
