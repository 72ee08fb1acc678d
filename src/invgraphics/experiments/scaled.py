"""Scores of a model in smaller pictures than those of the test views, against truth of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from invgraphics.core import Model, Scene
from invgraphics.metrics.keys import SCALED, scaled_key
from invgraphics.metrics.protocols import protocol_named, score, summarise
from invgraphics.runs.scores import Score
from invgraphics.scenes.scales import scene_at


def scaled_scores(
    model: Model, scene: Scene, protocol: str, data: Mapping[str, Any], *, refined: bool = False
) -> tuple[dict[str, Score], dict[str, str]]:
    """Render and score the test views at the scales that ``data.test_scales`` names.

    Args:
        model: what is scored.
        scene: as loaded.
        protocol: name of the rules.
        data: the run's changes of the data (`TrainingData.changes`).
        refined: whether the fit has refined its poses: test views at other scales are then not aligned, and not scored.

    Returns:
        ``psnr_at_1_8`` and the like, for each divisor, and what was skipped and why.
    """
    rules, quality, skipped = protocol_named(protocol), {}, {}
    reason = "the fit has refined its poses" if refined else ""
    if scene.is_class:
        reason = "the instances of the test views are inferred from pictures of the full size"
    for divisor in data.get("test_scales", ()):
        if reason:
            skipped |= {scaled_key(metric, divisor): reason for metric in SCALED}
            continue
        smaller = scene_at(scene, divisor)
        scores = [score(model.render(view.camera, normals=False), view, smaller, rules) for view in smaller.test]
        found, missing = summarise(scores, rules)
        quality |= {scaled_key(metric, divisor): found[metric] for metric in SCALED if metric in found}
        skipped |= {scaled_key(metric, divisor): missing[metric] for metric in SCALED if metric in missing}
    return quality, skipped
