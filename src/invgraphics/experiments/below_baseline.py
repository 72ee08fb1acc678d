"""Diagnosis of a method that scores below the mean training image: the likely cause, and a remedy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from invgraphics.core import Camera, Rendering, Scene
from invgraphics.metrics.baselines import mean_image
from invgraphics.metrics.protocols import Protocol, score
from invgraphics.recipes.suitable import OPEN, is_open_space
from invgraphics.runs.scores import Score

FLOATER_DEPTH = 0.6
"""Median depth, over the camera's distance to the scene's centre, below which floaters stand in front of the cameras."""
SPARSE_ALPHA = 0.6
"""Mean alpha below which renderings of opaque photographs are mostly background."""
EMPTY_ALPHA = 0.1
"""Mean alpha, over that of photographs with alpha, below which renderings are empty."""
GAPS = "its Gaussians do not cover the views yet, or overfit few photographs", "a longer --budget or more photographs"
"""Cause and remedy for Gaussians."""


def coverage_and_depth(picture: Rendering, camera: Camera, scene: Scene) -> dict[str, float]:
    """Mean ``alpha``, and ``relative_depth``: median depth over the camera's distance to the scene's centre."""
    seen = picture.depth[picture.depth.isfinite() & (picture.alpha >= 0.5)]
    reach = float((camera.position.cpu() - scene.bounds.centre).norm())
    relative_depth = float(seen.median()) / max(reach, 1e-9) if len(seen) else 1.0
    return {"alpha": float(picture.alpha.mean()), "relative_depth": relative_depth}


def below_baseline(
    method: str,
    quality: Mapping[str, Score],
    statistics: Sequence[Mapping[str, float]],
    scene: Scene,
    protocol: Protocol,
    *,
    gaussians: bool = False,
) -> str:
    """Diagnose a mean PSNR below that of the mean training image in a sentence; empty otherwise.

    Args:
        method: ``renderer/recipe``.
        quality: its scores by metric, see `summarise`.
        statistics: `coverage_and_depth` of each test view.
        scene: with its training views.
        protocol: of the scores.
        gaussians: whether the field is made of Gaussians, which leave gaps rather than fog.
    """
    psnr = quality["psnr"].mean if "psnr" in quality else None
    if psnr is None or not scene.train:
        return ""
    with torch.no_grad():
        pairs = zip(mean_image(scene), scene.test, strict=True)
        values = [score(picture, view, scene, protocol, only=("psnr",)).values.get("psnr") for picture, view in pairs]
    known = [value for value in values if value is not None]
    if not known or psnr >= (baseline := sum(known) / len(known)):
        return ""
    means = {key: sum(view[key] for view in statistics) / len(statistics) for key in ("alpha", "relative_depth")}
    cause, remedy = GAPS if gaussians else _diagnose(method, means, scene)
    lost = f"{method} reaches {psnr:.1f} dB, below the mean training image ({baseline:.1f} dB)"
    return f"{lost}: {cause}. Try {remedy}."


def _diagnose(method: str, means: Mapping[str, float], scene: Scene) -> tuple[str, str]:
    """Select cause and remedy of fog by the family of the method, the kind of scene and the statistics of its renderings."""
    others = [] if scene.points is None else ["splatting/gaussians, which starts from known points"]
    if is_open_space(scene):
        suited = method.startswith(OPEN)
        others.insert(0, "--optimise exposure, where photographs differ in it" if suited else f"{OPEN[0]}, for open spaces")
    remedy = ", ".join(["a longer --budget", "a smaller --size", ", or ".join(["more photographs", *others])])
    if means["relative_depth"] < FLOATER_DEPTH:
        where = f"median depth {means['relative_depth']:.0%} of the way to the scene's middle"
        return f"fog hangs in front of the cameras ({where})", remedy
    covered = sum(float(view.opacity().mean()) for view in scene.train) / len(scene.train)
    if scene.has_alpha and means["alpha"] < EMPTY_ALPHA * covered:
        cause = f"its pictures are empty (mean alpha {means['alpha']:.3f} instead of {covered:.3f})"
        return cause, "--set batches.foreground=0.5, so that half of the rays meet the object, or lower rates of learning"
    if not scene.has_alpha and means["alpha"] < SPARSE_ALPHA:
        return f"its pictures are mostly empty (mean alpha {means['alpha']:.2f})", remedy
    return "the budget ended before its fog had cleared, or it overfits few photographs", remedy
