"""Factor effects as interval plots, and the mean of two factors' combinations as heat maps."""

from __future__ import annotations

import itertools
import math
import statistics
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invgraphics.report.data.factors import METHOD, Factor, Observation
from invgraphics.report.figures.style import INK, MUTED, PAGE, Figure, canvas, save, series_style
from invgraphics.report.statistics.effects import Effect
from invgraphics.report.statistics.intervals import Estimate
from invgraphics.report.statistics.sentences import effect_sentence
from invgraphics.report.statistics.values import value_of
from invgraphics.report.wording import MeasuredQuantity
from invgraphics.text import file_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDE, NARROW = 860.0, 400.0
ROW, FRAME, LINE = 50.0, 86.0, 16.0
"""Heights in CSS pixels: of a comparison, of title, axis and margins together, and of a further line of text."""
MOST_PARTS = 12
"""Settings of other factors whose means are numbered below a bar."""
LETTER, WIDE_LETTERS = 7.2, 80
"""Width of a letter in CSS pixels; and letters of a line from which on numbers stand beside a label."""

HEAT_COLOURS = "viridis"
MOST_HEAT_MAPS = 6
ON_DARK, ON_LIGHT = "#fdfdfd", "#101214"
"""Numbers on a heat map's fields, which keep their colour on a dark page."""


def draw_intervals(effects: Sequence[Effect], folder: Path) -> Figure | None:
    """Interval plot of effects, one per row: mean, interval for these scenes (thick) and for scenes like these (thin).

    Below each bar stand the means of single scenes as numbers, which a line of the plot names.
    """
    shown = [effect for effect in effects if math.isfinite(effect.estimate.mean)]
    if not shown:
        return None
    quantity = shown[0].quantity
    title = f"Differences in {quantity.label}"
    wide = _draw_intervals(shown, title, folder / f"effects-{file_name(quantity.key)}", WIDE)
    narrow = _draw_intervals(shown, title, folder / f"effects-{file_name(quantity.key)}-narrow", NARROW)
    return Figure(wide, narrow, title, " ".join(map(effect_sentence, shown)))


def _draw_intervals(effects: Sequence[Effect], title: str, stem: Path, width: float) -> Path:
    quantity = effects[0].quantity
    parts = list(dict.fromkeys(name for effect in effects for name in _parts(effect)))
    key = textwrap.wrap(", ".join(f"{i} {name}" for i, name in enumerate(parts, 1)), round(width / LETTER))
    lines = max(len(_label(effect, round(width / LETTER))) for effect in effects)
    with canvas(width, FRAME + (ROW + LINE * (lines - 1)) * len(effects) + LINE * len(key)) as (figure, axes):
        axes.axvline(0, color=INK.light, linewidth=1.1, zorder=1)
        colours = {path: i for i, path in enumerate(dict.fromkeys(effect.factor for effect in effects))}
        axes.set_ylim(len(effects) - 0.4, -0.75)
        axes.set_xlim(*_limits(effects))
        for line, effect in enumerate(effects):
            _draw_row(axes, line, effect, (colours[effect.factor], parts), round(width / LETTER))
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        unit = f" ({quantity.unit})" if quantity.unit else ""
        direction = {"higher": "right is better", "lower": "left is better", "none": ""}[quantity.better]
        words = f"difference in {quantity.label}{unit}" + (f", {direction}" if direction else "")
        axes.set_xlabel("\n".join([words, *key]))
        axes.set_title(title)
        return save(figure, stem)


def _parts(effect: Effect) -> dict[str, float]:
    """Mean of each scene, or at each combination of other factors' levels where there is one scene."""
    scenes = {name: one.estimate.mean for name, one in effect.by_scene.items()}
    settings = effect.by_setting if len(effect.by_setting) <= MOST_PARTS else {}
    return scenes or {name: one.estimate.mean for name, one in settings.items()}


def _limits(effects: Sequence[Effect]) -> tuple[float, float]:
    """Axis limits of an interval plot: all means and zero, and both intervals unless far wider than others (two seeds)."""
    scale = effects[0].quantity.scale
    means = [effect.estimate.mean * scale for effect in effects]
    means += [mean * scale for effect in effects for mean in _parts(effect).values()]
    reach = max([abs(mean) for mean in means] + [1e-12])
    bars = [(bar.mean * scale, bar.half_width * scale) for effect in effects for bar in _bars(effect)]
    cap = max(2 * reach, 3 * statistics.median(max(bar.half_width for bar in _bars(effect)) * scale for effect in effects))
    low = min(0.0, *means, *(mean - min(half, cap) for mean, half in bars))
    high = max(0.0, *means, *(mean + min(half, cap) for mean, half in bars))
    pad = 0.05 * (high - low) or 1.0
    return low - pad, high + pad


def _bars(effect: Effect) -> list[Estimate]:
    """Intervals of an effect from the thick bar to the thin one, on which the verdict rests where there are several scenes."""
    return [effect.estimate] if effect.across is None else [effect.estimate, effect.across]


def _draw_row(axes: Axes, line: int, effect: Effect, look: tuple[int, Sequence[str]], letters: int) -> None:
    """One effect: label and numbers above its bar, on the page's colour so that no line runs through them."""
    colour, order = look
    style, scale, value = series_style(colour), effect.quantity.scale, effect.estimate
    small: dict[str, Any] = {"color": MUTED.light, "fontsize": 9.5, "ha": "center", "va": "top", "zorder": 2}
    low, high = axes.get_xlim()
    for where, names in _clusters(_parts(effect), 2.5 * (high - low) / letters / scale):
        axes.text(where * scale, line + 0.1, " ".join(str(order.index(name) + 1) for name in names), clip_on=True, **small)
    for bar, width in zip(_bars(effect), (3.2, 0.9), strict=False):
        ends = [bar.low * scale, bar.high * scale]
        axes.plot(ends, [line, line], color=style.colour, linewidth=width, zorder=3)
        for side, edge, arrow, beyond in (("low", low, "<", ends[0] < low), ("high", high, ">", ends[1] > high)):
            if beyond:  # or a bar that goes on would look like one that ends
                head: dict[str, Any] = {"markersize": 7, "clip_on": False, "zorder": 3, "gid": f"beyond-{side}-{line}"}
                axes.plot(edge, line, arrow, color=style.colour, **head)
    filled: dict[str, Any] = {} if effect.found else {"markerfacecolor": PAGE.light, "markeredgewidth": 1.8}
    axes.plot(value.mean * scale, line, style.marker, color=style.colour, markersize=9, zorder=4, **filled)
    unit = f" {effect.quantity.unit}" if effect.quantity.unit else ""
    text = f"{effect.text(value.mean)}{unit} {effect.interval}".rstrip()
    ground: dict[str, Any] = {"facecolor": PAGE.light, "edgecolor": "none", "pad": 1.0}
    place: dict[str, Any] = {
        "xycoords": axes.get_yaxis_transform(),
        "textcoords": "offset points",
        "va": "bottom",
        "bbox": ground,
    }
    label = "\n".join(_label(effect, letters))
    axes.annotate(label, (0, line), (2, 7), color=INK.light, fontsize=11.5, zorder=5, **place)
    if letters >= WIDE_LETTERS:
        axes.annotate(text, (1, line), (-2, 7), color=style.colour, fontsize=11.5, ha="right", zorder=5, **place)


def _clusters(means: Mapping[str, float], gap: float) -> list[tuple[float, list[str]]]:
    """Group names whose means are closer than ``gap`` to the first of their group: (place, names), from left to right."""
    groups: list[tuple[float, list[str]]] = []
    for name, mean in sorted(means.items(), key=lambda item: item[1]):
        if groups and mean - groups[-1][0] < gap:
            groups[-1][1].append(name)
        else:
            groups.append((mean, [name]))
    return groups


def _label(effect: Effect, letters: int) -> list[str]:
    """Lines of an effect's label; numbers stand beside it where the plot is wide."""
    return textwrap.wrap(effect.label, letters - 34 if letters >= WIDE_LETTERS else letters - 4)


@dataclass(frozen=True)
class HeatMap:
    """The mean of a quantity at each combination of two factors' levels.

    Attributes:
        rows: the factor down the side.
        columns: the factor along the top.
        values: (row level, column level) -> mean in stored units; absent where nothing ran.
        runs: runs behind each mean.
        matched: whether all means are over the same scenes, seeds and other levels.
    """

    rows: Factor
    columns: Factor
    values: dict[tuple[str, str], float]
    runs: int
    matched: bool


def heat_map(pair: tuple[Factor, Factor], quantity: MeasuredQuantity, observations: Sequence[Observation]) -> HeatMap | None:
    """Heat map over the runs that all combinations share, else over all runs; ``None`` unless the factors are crossed."""
    down, across = pair
    cells: dict[tuple[str, str], dict[tuple[Any, ...], float]] = {}
    for observation in observations:
        value = value_of(observation.run, quantity)
        if value is None or not math.isfinite(value):
            continue
        levels = observation.levels
        others = tuple(sorted((key, level) for key, level in levels.items() if key not in (down.path, across.path)))
        place = (levels.get(down.path, ""), levels.get(across.path, ""))
        cells.setdefault(place, {})[(observation.scene, observation.run.seed, others)] = value
    rows, columns = ({place[axis] for place in cells} for axis in (0, 1))
    if min(len(rows), len(columns)) < 2 or len(cells) < len(rows) + len(columns):
        return None  # a cross through one field, as one factor at a time makes it, combines nothing
    common = set.intersection(*(set(found) for found in cells.values()))
    values = {
        place: statistics.fmean(v for k, v in found.items() if not common or k in common) for place, found in cells.items()
    }
    return HeatMap(down, across, values, len(common) or min(map(len, cells.values())), bool(common))


def draw_heat_maps(
    factors: Sequence[Factor], quantity: MeasuredQuantity, observations: Sequence[Observation], folder: Path
) -> list[Figure]:
    """A heat map for each pair of factors, at most ``MOST_HEAT_MAPS``; the factor with fewer levels goes down the side."""
    figures = []
    for pair in itertools.combinations(factors, 2):
        down, across = sorted(pair, key=lambda factor: (factor.path != METHOD, len(factor.levels)))
        table = heat_map((down, across), quantity, observations)
        if table is not None and len(figures) < MOST_HEAT_MAPS:
            figures.append(_draw_heat(table, quantity, folder / f"heat-{len(figures)}"))
    return figures


def _draw_heat(table: HeatMap, quantity: MeasuredQuantity, stem: Path) -> Figure:
    import matplotlib as mpl
    import numpy as np

    rows, columns = table.rows.levels, table.columns.levels
    grid = np.array([[table.values.get((row, column), np.nan) for column in columns] for row in rows]) * quantity.scale
    low, high = float(np.nanmin(grid)), float(np.nanmax(grid))
    span = (high - low) or 1.0
    title = f"{quantity.heading} by {table.rows.path} and {table.columns.path}"
    with canvas(max(400.0, 170 + 82 * len(columns)), 96 + 44 * len(rows)) as (figure, axes):
        axes.imshow(grid, cmap=HEAT_COLOURS, vmin=low, vmax=low + span, aspect="auto")
        for (row, column), value in np.ndenumerate(grid):
            if np.isfinite(value):
                red, green, blue, _ = mpl.colormaps[HEAT_COLOURS]((value - low) / span)
                ink = ON_LIGHT if 0.299 * red + 0.587 * green + 0.114 * blue > 0.5 else ON_DARK
                text = quantity.text(value / quantity.scale)
                axes.text(column, row, text, ha="center", va="center", color=ink, fontsize=12)
        axes.set_xticks(range(len(columns)), [_short(level) for level in columns])
        axes.set_yticks(range(len(rows)), [_short(level) for level in rows])
        axes.set_xlabel(table.columns.path)
        axes.grid(visible=False)
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
        axes.set_title(quantity.heading, fontsize=12.5)
        path = save(figure, stem)
    text = "; ".join(f"{row}, {column}: {quantity.text(value)}" for (row, column), value in table.values.items())
    basis = f"mean over {table.runs} runs in each field" if table.matched else "fields rest on different runs"
    return Figure(path, None, f"{title}, {basis}", f"{title}: {text}.")


def _short(level: str) -> str:
    return level if len(level) <= 22 else f"{level[:21]}…"
