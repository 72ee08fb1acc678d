"""Labels, units, directions and number formats of quantities, shared by all outputs."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from invgraphics.runs.scores import Score

Direction = Literal["higher", "lower", "none"]
Group = Literal["image", "geometry", "cost"]

ABSENT = "–"
"""Shown where a method has no such quantity."""


@dataclass(frozen=True)
class MeasuredQuantity:
    """A measured quantity of a run, a column of the summary: label, unit, direction and number format.

    Attributes:
        key: its name in ``scores.json``.
        label: display name.
        unit: unit in which it is written; empty for a pure number.
        better: direction of improvement; ``none`` for a quantity that is never ranked.
        group: what it measures: ``image``, ``geometry`` or ``cost``; the first two are quality.
        scale: the stored value is multiplied by this before it is written.
        decimals: digits after the point; ``None`` means three significant digits.
        margin: differences below this, in stored units, are of no interest: the margin of equivalence tests, stated before
            anything is measured; ``None`` where none is.
    """

    key: str
    label: str
    unit: str
    better: Direction
    group: Group
    scale: float = 1.0
    decimals: int | None = None
    margin: float | None = None

    @property
    def arrow(self) -> str:
        """``↑`` where higher is better, ``↓`` where lower is."""
        return {"higher": "↑", "lower": "↓", "none": ""}[self.better]

    @property
    def heading(self) -> str:
        """Label, unit and direction."""
        return " ".join(part for part in (self.label, f"({self.unit})" if self.unit else "", self.arrow) if part)

    def text(self, value: float | None) -> str:
        """``value`` in this quantity's unit and digits."""
        if value is None:
            return ABSENT
        if math.isinf(value):
            return "∞" if value > 0 else "−∞"
        return f"{value * self.scale:z,.{self._digits(value)}f}".replace("-", "−")

    def spread(self, mean: float, deviation: float) -> str:
        """``± deviation`` with the digits of its mean; empty for a cost that is the same for all seeds."""
        text = f"{deviation * self.scale:,.{self._digits(mean)}f}"
        return "" if self.group == "cost" and float(text.replace(",", "")) == 0 else f"± {text}"

    def sort_key(self, value: float) -> float:
        """Key of an ascending sort, best value first."""
        return -value if self.better == "higher" else value

    def _digits(self, value: float) -> int:
        return significant_decimals(value * self.scale) if self.decimals is None else self.decimals


_NAMES: dict[str, tuple[str, int]] = {
    "psnr": ("PSNR", 2),
    "ssim": ("SSIM", 3),
    "ms_ssim": ("MS-SSIM", 3),
    "flip": ("FLIP", 3),
    "lpips": ("LPIPS", 3),
    "psnr_exposed": ("PSNR, exposure fitted", 2),
    "depth_abs_rel": ("Depth abs-rel", 3),
    "depth_rmse": ("Depth RMSE", 3),
    "depth_abs_rel_smooth": ("Depth abs-rel off edges", 3),
    "depth_rmse_smooth": ("Depth RMSE off edges", 3),
    "normal_deg": ("Normal error", 1),
    "alpha_iou": ("Alpha IoU", 3),
    "chamfer": ("Chamfer", 4),
    "surface_accuracy": ("Surface accuracy", 4),
    "surface_completeness": ("Surface completeness", 4),
    "f_score": ("F-score, 1%", 3),
    "normal_consistency": ("Normal consistency", 3),
    "pose_rotation_deg": ("Pose rotation, median", 2),
    "pose_translation_percent": ("Pose position, median", 2),
}

SCALED = "_at_1_"
"""Between a metric's name and the divisor of the test views' size, where it is of smaller pictures."""

MARGINS = {"psnr": 0.2, "ssim": 0.005, "ms_ssim": 0.005, "flip": 0.005, "lpips": 0.01}
"""Metric -> difference below which methods count as equal, where a study states no other: about what cannot be seen."""

_GEOMETRY = ("depth_", "normal_", "alpha_", "pose_", "chamfer", "surface_", "f_score")

_UNITS = {"deg": "°", "degrees": "°", "degree": "°", "world units": "units"}

COSTS = (
    MeasuredQuantity("fit_seconds", "Fit", "s", "lower", "cost"),
    MeasuredQuantity("fit_cpu_seconds", "Fit, all threads", "CPU s", "none", "cost"),
    MeasuredQuantity("steps", "Steps", "", "none", "cost", decimals=0),
    MeasuredQuantity("render_seconds_per_view", "Render", "s/view", "lower", "cost"),
    MeasuredQuantity("render_fps", "Render", "FPS", "higher", "cost"),
    MeasuredQuantity("peak_memory_bytes", "Memory", "MB", "lower", "cost", scale=1e-6),
    MeasuredQuantity("model_bytes", "Model", "MB", "lower", "cost", scale=1e-6),
    MeasuredQuantity("parameters", "Params", "M", "none", "cost", scale=1e-6),
    MeasuredQuantity("primitives", "Primitives", "", "none", "cost", decimals=0),
    MeasuredQuantity("dead", "Dead", "%", "none", "cost", scale=100, decimals=2),
)
"""Costs in the order of the table; 1 MB = 10⁶ bytes."""


TIMES = ("fit_seconds", "render_seconds_per_view", "render_fps")
"""Costs that a clock measures, which other programs on the same cores disturb."""


def metric_label(key: str) -> str:
    """Display name of a metric, also at 1/n of the test views' size; an unknown key with spaces for underscores."""
    name, scaled, divisor = key.partition(SCALED)
    label = _NAMES[name][0] if name in _NAMES else name.replace("_", " ")
    return f"{label} at 1/{divisor}" if scaled else label


def quality_quantity(key: str, score: Score) -> MeasuredQuantity:
    """Quantity of a quality metric, with unit and direction from its stored score."""
    name = key.partition(SCALED)[0]
    decimals = _NAMES[name][1] if name in _NAMES else None
    better: Direction = "higher" if score.higher_is_better else "lower"
    group: Group = "geometry" if key.startswith(_GEOMETRY) else "image"
    unit = _UNITS.get(score.unit, score.unit)
    return MeasuredQuantity(key, metric_label(key), unit, better, group, decimals=decimals, margin=MARGINS.get(name))


def significant_decimals(value: float, digits: int = 3) -> int:
    """Number of decimals that show ``digits`` significant digits, at most six."""
    if value == 0:
        return 0
    return min(6, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def times(ratio: float) -> str:
    """Format a ratio of two costs to two significant digits: 1.4, 14, 140."""
    return f"{ratio:.2g}" if ratio < 10 else f"{float(f'{ratio:.2g}'):.0f}"


def listing(items: Iterable[str]) -> str:
    """Join items in words: ``a``, ``a and b``, ``a, b and c``."""
    words = list(items)
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def budget_words(budget: str) -> str:
    """Format a budget: ``60s`` -> ``60 s``; ``5m`` and ``5min`` -> ``5 min``; ``5000steps`` -> ``5,000 steps``."""
    found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(steps?|s|min|m|h)\s*", budget)
    if found is None:
        return budget
    amount, unit = float(found.group(1)), {"m": "min", "step": "steps"}.get(found.group(2), found.group(2))
    return f"{int(amount):,} {unit}" if unit == "steps" else f"{amount:,g} {unit}"


def grouped(pairs: Sequence[tuple[str, str]]) -> str:
    """The value that all owners have; else each value with its owners in brackets, empty values left out."""
    owners: dict[str, list[str]] = {}
    for value, owner in dict.fromkeys(pairs):
        owners.setdefault(value, []).append(owner)
    if len(owners) <= 1:
        return "".join(owners)
    return "; ".join(f"{value} ({listing(names)})" for value, names in owners.items() if value)
