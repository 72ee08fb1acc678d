"""The README's second picture, from the folder of ``compare SCENE --methods all``: the table, field by renderer, as measured.

Each cell shows one test view as its best method renders it, and the mean PSNR of every method. ``make matrix`` runs it on
reports/compare-all-bricks.
"""

import json
import sys
import textwrap
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image


def draw(folder: Path, out: Path, view: int = 0) -> None:
    """Write ``out``: fields as rows and renderers as columns, with a thumbnail and the scores in each cell."""
    comparison = json.loads((folder / "compare.json").read_text())
    cells: dict[tuple[str, str], list[tuple[float, str, Path]]] = {}
    for run in (folder / run for run in comparison["runs"] if run.endswith(f"seed-{comparison['seeds'][0]}")):
        scores = json.loads((run / "scores.json").read_text())
        place = tuple(comparison["cells"][scores["method"]])
        entry = (scores["quality"]["psnr"]["mean"], scores["method"], run / "test" / f"{view:04d}.png")
        cells.setdefault(place, []).append(entry)
    rows = list(dict.fromkeys(field for field, _ in cells))
    columns = sorted(dict.fromkeys(renderer for _, renderer in cells), key=lambda name: (name != "volume rendering", name))
    shape = len(rows), len(columns)
    # A row is as high as its picture and the names under it.
    heights = [1.5 + 0.13 * max(len(cells.get((row, column), [])) for column in columns) for row in rows]
    width, height = 1.5 * shape[1] + 1.2, sum(heights) + 0.9
    caption = textwrap.fill(_caption(comparison), round(13 * width))
    below = 0.18 * (1 + caption.count("\n")) / height
    layout = ConstrainedLayoutEngine(rect=(0, below, 1, 1 - below), h_pad=0.06, w_pad=0.06)
    figure = plt.figure(figsize=(width, height), dpi=100, facecolor="white", layout=layout)
    axes = figure.subplots(*shape, gridspec_kw={"height_ratios": heights})
    for row, line in zip(rows, axes.reshape(shape), strict=True):
        for column, axis in zip(columns, line, strict=True):
            _cell(axis, sorted(cells.get((row, column), []), reverse=True))
        line[0].set_ylabel(textwrap.fill(row, 16), fontsize=9, rotation=0, ha="right", va="center", labelpad=8)
    for column, axis in zip(columns, axes.reshape(shape)[0], strict=True):
        axis.set_title(textwrap.fill(column, 16), fontsize=9, pad=10)
    figure.text(0.01, 0.004, caption, fontsize=8.5, color="#555", va="bottom")
    figure.savefig(out)


def _cell(axis: Any, entries: list[tuple[float, str, Path]]) -> None:
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(False)
    if not entries:
        axis.set_facecolor("#f6f7f8")
        axis.set_aspect(1)
        return
    axis.imshow(Image.open(entries[0][2]), interpolation="lanczos")
    lines = [f"{name.split('/')[1]} {psnr:.1f}" for psnr, name, _ in entries]
    axis.set_xlabel("\n".join(lines), fontsize=7.5, labelpad=3)


def _caption(comparison: dict[str, Any]) -> str:
    machine = comparison["environment"]
    size = "x".join(map(str, comparison["size"])) if isinstance(comparison["size"], list) else comparison["size"]
    words = [f"Scene {comparison['scene']}, {size} px, {comparison['budget']} each, mean PSNR (dB) over its test views."]
    words += [f"{machine['cpu']}, {machine['threads']} thread{'s' * (machine['threads'] != 1)}, {machine['date'][:10]}."]
    return " ".join(words)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
