"""Table of a study's variants across its scenes, with the mean over scenes, best mean first."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass

from invgraphics.report.data.factors import StudyCell
from invgraphics.report.data.studies import Study
from invgraphics.report.statistics.values import diverged, value_of
from invgraphics.report.wording import ABSENT, MeasuredQuantity


@dataclass(frozen=True)
class AcrossRow:
    """A variant's means.

    Attributes:
        variant: its name.
        values: mean over seeds for each scene, in stored units; ``None`` where a seed is missing or diverged.
        mean: over the scenes; ``None`` where a scene has no value: means of different scenes cannot be compared.
        refused: why there is no mean; empty where there is one.
    """

    variant: str
    values: tuple[float | None, ...]
    mean: float | None
    refused: str = ""


@dataclass(frozen=True)
class AcrossScenes:
    """Rows by mean, best first, rows without one last in the study's order; ``quantity`` formats their values."""

    quantity: MeasuredQuantity
    scenes: tuple[str, ...]
    rows: tuple[AcrossRow, ...]

    def text(self, value: float | None) -> str:
        """A value as written."""
        return ABSENT if value is None else self.quantity.text(value)


def across_scenes(study: Study, quantity: MeasuredQuantity | None) -> AcrossScenes | None:
    """Mean over seeds of every variant on every scene, and over scenes where it has a value on all.

    Returns:
        the table; ``None`` where the study has a single scene, or nothing ran.
    """
    if quantity is None or len(study.scenes) < 2:
        return None
    cells: dict[tuple[str, str], list[StudyCell]] = {}
    for cell in study.cells:
        cells.setdefault((cell.variant, cell.scene), []).append(cell)
    rows = []
    for variant in study.variants:
        values = tuple(_mean(cells.get((variant, scene), []), quantity) for scene in study.scenes)
        known = [value for value in values if value is not None]
        lacking = [scene for scene, value in zip(study.scenes, values, strict=True) if value is None]
        mean = None if lacking else statistics.fmean(known)
        rows.append(AcrossRow(variant, values, mean, f"no mean: lacks {', '.join(lacking)}" if lacking else ""))
    rows.sort(key=lambda row: math.inf if row.mean is None else quantity.sort_key(row.mean))
    return AcrossScenes(quantity, study.scenes, tuple(rows))


def _mean(cells: list[StudyCell], quantity: MeasuredQuantity) -> float | None:
    values = [None if cell.run is None or diverged(cell.run, quantity) else value_of(cell.run, quantity) for cell in cells]
    known = [value for value in values if value is not None and math.isfinite(value)]
    return statistics.fmean(known) if known and len(known) == len(values) else None
