"""Keys under which an evaluation stores scores, without heavy imports: what a study may name before anything has run."""

from __future__ import annotations

from collections.abc import Iterable

from invgraphics import plugins
from invgraphics.metrics.surface_metrics import SURFACE_METRICS

POSE_ROTATION, POSE_TRANSLATION = "pose_rotation_deg", "pose_translation_percent"
"""Of fits that refine their poses."""

SCALED = ("psnr", "ssim")
"""Metrics that are also computed in smaller pictures than those of the test views."""


def scaled_key(metric: str, divisor: int) -> str:
    """Key of a metric at 1/``divisor`` of the test views' size."""
    return f"{metric}_at_1_{divisor}"


def quality_keys(divisors: Iterable[int] = ()) -> list[str]:
    """Every key that a fit's quality can have: registered metrics, also of smaller pictures, geometry and poses.

    Args:
        divisors: of the test views' size, at which they are scored too (``data.test_scales``).
    """
    scaled = [scaled_key(metric, divisor) for divisor in divisors for metric in SCALED]
    return [*plugins.names("metrics"), *scaled, *SURFACE_METRICS, POSE_ROTATION, POSE_TRANSLATION]
