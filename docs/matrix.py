"""The README's second picture, from the folder of ``compare SCENE --methods all``: the table, field by renderer, as measured.

Each cell shows one test view as its best method renders it, and the mean PSNR of every method. Fields that one renderer alone
shows would leave their rows empty: they follow below, each under its name. ``make matrix`` draws reports/compare-all-bricks.
"""

import json
import math
import sys
import textwrap
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

Entries = list[tuple[float, str, Path]]
"""Mean PSNR, method and test view of a cell's runs."""


def draw(folder: Path, out: Path, view: int = 0) -> None:
    """Write ``out``: fields as rows and renderers as columns, with a thumbnail and the scores in each cell."""
    comparison = json.loads((folder / "compare.json").read_text())
    cells = _cells(folder, comparison, view)
    renderers = Counter(field for field, _ in cells)
    rows = [field for field in renderers if renderers[field] > 1]
    alone = [place for place in cells if renderers[place[0]] == 1]
    used = dict.fromkeys(renderer for field, renderer in cells if field in rows)
    columns = sorted(used, key=lambda name: (name != "volume rendering", name))
    lines = max(1, math.ceil(len(alone) / len(columns)))
    each = max(1, math.ceil(len(alone) / lines))  # rows of about the same length
    strips = [alone[i : i + each] for i in range(0, len(alone), each)]
    table = [[cells.get((row, column), []) for column in columns] for row in rows]
    # A row is as high as its picture, the names under it and, below the table, those above it.
    heights = [1.5 + 0.13 * max(map(len, line)) for line in table]
    heights += [2.0 + 0.13 * max(len(cells[place]) for place in strip) for strip in strips]
    width, height = 1.5 * len(columns) + 1.2, sum(heights) + 0.9
    caption = textwrap.fill(_caption(comparison), round(13 * width))
    below = 0.18 * (1 + caption.count("\n")) / height
    layout = ConstrainedLayoutEngine(rect=(0, below, 1, 1 - below), h_pad=0.06, w_pad=0.06)
    figure = plt.figure(figsize=(width, height), dpi=100, facecolor="white", layout=layout)
    axes = figure.subplots(len(heights), len(columns), squeeze=False, gridspec_kw={"height_ratios": heights})
    for row, entries, line in zip(rows, table, axes, strict=False):
        for cell, axis in zip(entries, line, strict=True):
            _cell(axis, cell)
        line[0].set_ylabel(textwrap.fill(row, 16), fontsize=9, rotation=0, ha="right", va="center", labelpad=8)
    for column, axis in zip(columns, axes[0], strict=True):
        axis.set_title(textwrap.fill(column, 16), fontsize=9, pad=10)
    for strip, line in zip(strips, axes[len(rows) :], strict=True):
        for place, axis in zip(strip, line, strict=False):
            _cell(axis, cells[place])
            axis.set_title("\n".join(textwrap.fill(name, 20) for name in place), fontsize=8, pad=6)
        for axis in line[len(strip) :]:
            axis.set_axis_off()
    if strips:
        label = "fields that one\nrenderer shows:\nfield, renderer"
        axes[len(rows), 0].set_ylabel(label, fontsize=9, rotation=0, ha="right", va="center", labelpad=8)
    figure.text(0.01, 0.004, caption, fontsize=8.5, color="#555", va="bottom")
    figure.savefig(out)


def _cells(folder: Path, comparison: dict[str, Any], view: int) -> dict[tuple[str, str], Entries]:
    """(field, renderer) -> its runs with the first seed, best first."""
    cells: dict[tuple[str, str], Entries] = {}
    for run in (folder / run for run in comparison["runs"] if run.endswith(f"seed-{comparison['seeds'][0]}")):
        scores = json.loads((run / "scores.json").read_text())
        field, renderer = comparison["cells"][scores["method"]]
        entry = (scores["quality"]["psnr"]["mean"], scores["method"], run / "test" / f"{view:04d}.png")
        cells.setdefault((field, renderer), []).append(entry)
    return {place: sorted(entries, reverse=True) for place, entries in cells.items()}


def _cell(axis: Any, entries: Entries) -> None:
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
