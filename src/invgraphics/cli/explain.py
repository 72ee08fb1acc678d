"""``invgraphics explain``: list and plot the contributions along one pixel's ray."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from invgraphics.cli.output import show_table
from invgraphics.errors import InputError
from invgraphics.runs.folder import check_run

if TYPE_CHECKING:
    from invgraphics.tools.explain import Explanation

ROWS = 24
"""Contributions that are printed, those that weigh most; the file has all."""


@dataclass(frozen=True)
class Explain:
    """List what one pixel's ray intersects: alpha, weight, transmittance and colour of every sample or Gaussian.

    Writes a figure (ray.png, ray.svg), a table (ray.csv) and the numbers of both (ray.json).

    Attributes:
        folder: The folder of a run.
        view: Index of the view, from 0.
        pixel: The pixel, counted from 0 from the upper left corner.
        split: Whose views are counted.
        out: Where to write.
        scene: Another copy of the scene, for instance where the data set has moved.
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    view: Annotated[int, arg(metavar="N")]
    pixel: Annotated[str, arg(metavar="COLUMN,ROW")]
    split: Literal["test", "train"] = "test"
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: RUN/explained/...)")] = None
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="(default: the run's own)")] = None

    def run(self) -> int:
        """Write figure and table; prints the table and the figure's path. Returns exit status 0."""
        pixel = parse_pixel(self.pixel)
        check_run(self.folder)

        from invgraphics.report.figures.ray import draw_ray
        from invgraphics.tools.explain import ExplainRequest, explain

        explanation = explain(ExplainRequest(self.folder, self.view, pixel, self.split, self.out, self.scene))
        figure = draw_ray(explanation.folder)
        show_contributions(explanation)
        for sentence in sentences(explanation):
            print(sentence)
        print(figure)
        return 0


def parse_pixel(text: str) -> tuple[int, int]:
    """Parse ``40,71`` to column and row.

    Raises:
        InputError: anything else.
    """
    found = re.fullmatch(r"\s*(\d+)\s*,\s*(\d+)\s*", text)
    if not found:
        raise InputError(f"--pixel cannot be '{text}'.", "Expected COLUMN,ROW from the upper left corner, for instance 40,71.")
    return int(found[1]), int(found[2])


def show_contributions(explanation: Explanation) -> None:
    """Print the contributions of largest weight, in compositing order."""
    found = explanation.contributions
    heaviest = sorted(found.weight.argsort(descending=True)[:ROWS].tolist())
    names = ["distance (world)", "from", "to", "alpha", "T", "weight", "red", "green", "blue"]
    columns = [found.t, found.begin, found.end, found.alpha, found.transmittance, found.weight, *found.rgb.T]
    if found.density is not None:
        names.insert(3, "density")
        columns.insert(3, found.density)
    rows = [[str(index), *(f"{float(column[index]):.4g}" for column in columns)] for index in heaviest]
    record = explanation.record
    what = f"pixel {record.pixel.column},{record.pixel.row} of {record.split} view {record.view}"
    shown = "" if len(rows) == len(found) else f", the {len(rows)} heaviest"
    show_table(f"{record.method}, {what}: {len(found)} {found.kind}{shown}", ["", *names], rows)


def sentences(explanation: Explanation) -> list[str]:
    """Summarise an explanation in sentences: opacity, colour against the truth, dead primitives and depths."""
    found, record, pixel = explanation.contributions, explanation.record, explanation.record.pixel
    through = 1 - found.opacity
    difference = float((explanation.rendered - explanation.composited).abs().max())
    lines = [
        f"Σ T·α·colour = {_colour(found.colour.tolist())}, and {through:.4f} of the background {_colour(record.background)}",
        f"add up to {_colour(explanation.composited.tolist())}; the renderer's picture has "
        f"{_colour(explanation.rendered.tolist())} (largest difference {difference:.1e}), the truth {_colour(pixel.true)}.",
    ]
    if found.density is not None and len(found):
        empty = int((found.density == 0).sum())
        lines.append(f"{empty} of {len(found)} samples are in empty space, where the density is zero.")
    if record.dead is not None:
        lines.append(f"In the whole model, {record.dead.sentence}")
    depths = {"mean": pixel.expected, "median": pixel.median, "true": pixel.true_depth}
    known = [f"{name} {value:.4g}" for name, value in depths.items() if value is not None]
    return [*lines, f"Depth in world units: {', '.join(known)}."] if known else lines


def _colour(values: Sequence[float | None]) -> str:
    return f"({', '.join('-' if value is None else f'{value:.3f}' for value in values)})"
