"""Ray diagram of one pixel: alpha, compositing weights, transmittance, density and depths along its ray."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from invgraphics.files import replacing
from invgraphics.report.data.pictures import read_picture
from invgraphics.report.data.ray import Ray, close_up, curve_of, read_ray, whole_ray
from invgraphics.report.figures.style import GRID, INK, MUTED, PAGE, POINTS, SERIES, canvas, save, spread_labels
from invgraphics.runs.explanation import FIGURE, PICTURE, TRUTH
from invgraphics.runs.inside import inside

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

SIZE = (1120.0, 640.0)
SHARPNESS = 2.0
"""Pixels of the PNG per CSS pixel."""
LIGHT, DENSITY, PASS = SERIES[0].light, SERIES[3].light, SERIES[6].light
DEPTH_STYLES = {
    "true_depth": ("true depth", INK.light, "-"),
    "expected": ("mean", SERIES[1].light, (0, (5, 2))),
    "median": ("median", SERIES[2].light, (0, (1.5, 1.5))),
}
"""Depth -> its name, colour and dashes."""
WIDE = 12.0
"""Ratio of far to near beyond which distances are drawn logarithmically."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of sRGB's primaries; separates dark swatches from light ones."""
CELLS = 900
"""Cells of a colour strip."""


def draw_ray(folder: Path) -> Path:
    """Draw the ray diagram of the explanation in ``folder``, beside its record.

    Returns:
        ``ray.png``; ``ray.svg`` lies beside it.

    Raises:
        InputError: a file is missing or broken.
    """
    ray = read_ray(folder)
    whole = whole_ray(ray)
    close = close_up(ray, whole)
    with canvas(*SIZE) as (figure, first):
        first.remove()
        figure.set_layout_engine("constrained", h_pad=0.03, hspace=0.0, w_pad=0.06)
        heights = (1.0 if close else 0.02, 0.35, 3.4, 1.2, 0.35)
        grid = figure.add_gridspec(len(heights), 2, width_ratios=(3.5, 1), height_ratios=heights)
        strip = figure.add_subplot(grid[1, 0])
        main, below, total = (figure.add_subplot(grid[row, 0], sharex=strip) for row in (2, 3, 4))
        _set_span(strip, *(close or whole))
        if close:
            _overview(figure.add_subplot(grid[0, 0]), ray, whole, close)
        _strip(strip, _nearest_colours(ray, strip), "colour")
        _draw_weights(main, ray)
        _densities(below, ray)
        _strip(total, _composited_colours(ray, total), "so far")
        _depths((strip, main, below), ray)
        for axes in (strip, main, below):
            axes.tick_params(labelbottom=False, bottom=False)
        total.set_xlabel(f"distance along the ray ({ray.record.length_unit} units)")
        _pictures(figure, grid[:, 1].subgridspec(2, 1), ray, folder)
        figure.suptitle(_title(ray), x=0.01, ha="left", fontsize=14, fontweight="bold")
        png = folder / f"{FIGURE}.png"
        with replacing(png) as temporary:
            figure.savefig(temporary, format="png", dpi=POINTS * SHARPNESS, facecolor=PAGE.light)
        save(figure, folder / FIGURE)
    return png


def _title(ray: Ray) -> str:
    record, pixel = ray.record, ray.record.pixel
    where = f"{record.scene}, {record.split} view {record.view}, pixel ({pixel.column}, {pixel.row})"
    return f"{record.method} on {where}: {len(ray.rgb)} {record.kind}"


def _set_span(axes: Axes, low: float, high: float) -> None:
    if low > 0 and high / low > WIDE:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")  # as text: labels are not typeset
        axes.xaxis.set_minor_formatter(lambda value, _: "")
    axes.set_xlim(low, high)


def _cells(axes: Axes) -> Float[ndarray, " cells"]:
    """Distances at the centres of a colour strip's cells, evenly spaced on the axis."""
    low, high = axes.get_xlim()
    share = (np.arange(CELLS) + 0.5) / CELLS
    return low * (high / low) ** share if axes.get_xscale() == "log" else low + (high - low) * share


def _nearest_colours(ray: Ray, axes: Axes) -> Float[ndarray, "cells 4"]:
    """RGBA of the sample that contains each distance, or of the nearest Gaussian; transparent where there is none."""
    at, t = _cells(axes), ray.columns["t"]
    if not len(t):
        return np.zeros((CELLS, 4))
    if ray.record.kind == "samples":
        which = (np.searchsorted(ray.columns["begin"], at, side="right") - 1).clip(min=0)
        there = (at >= ray.columns["begin"][which]) & (at <= ray.columns["end"][which])
    else:
        order = t.argsort(kind="stable")
        which = order[np.searchsorted((t[order][1:] + t[order][:-1]) / 2, at)]
        there = (at >= ray.columns["begin"].min()) & (at <= ray.columns["end"].max())
    return np.concatenate([ray.shown(ray.rgb[which]), np.asarray(there, float)[:, None]], axis=1)


def _composited_colours(ray: Ray, axes: Axes) -> Float[ndarray, "cells 4"]:
    """RGBA of the pixel composited up to each distance, over the background."""
    order = ray.columns["t"].argsort(kind="stable")
    weight, t = ray.columns["weight"][order], ray.columns["t"][order]
    light = (weight * ray.columns["counted"][order])[:, None] * ray.rgb[order]
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(light, axis=0)])
    left = 1 - np.concatenate([[0.0], np.cumsum(weight)])
    colour = ray.shown(sums + left[:, None] * ray.background)[np.searchsorted(t, _cells(axes))]
    return np.concatenate([colour, np.ones((CELLS, 1))], axis=1)


def _overview(axes: Axes, ray: Ray, whole: tuple[float, float], close: tuple[float, float]) -> None:
    """Draw colours and transmittance of the whole ray, with the interval of the close-up shaded."""
    _set_span(axes, *whole)
    begin, end = ray.columns["begin"], ray.columns["end"]
    for start, stop, colour in zip(begin, end, ray.shown(ray.rgb), strict=True):
        axes.axvspan(start, stop, 0, 0.22, color=tuple(colour), linewidth=0)
    axes.axvspan(*close, color=GRID.light, zorder=0)
    _draw_transmittance(axes, ray)
    axes.set(ylim=(-0.02, 1.06), yticks=[0, 1])
    axes.set_ylabel("whole ray", rotation=0, ha="right", va="center", labelpad=8)


def _strip(axes: Axes, colours: Float[ndarray, "cells 4"], name: str) -> None:
    """Draw a strip of colours along the ray."""
    axes.set_ylim(0, 1)
    drawn = axes.imshow(colours[None], aspect="auto", interpolation="nearest", extent=(0, 1, 0, 1), transform=axes.transAxes)
    drawn.set_clip_on(True)
    axes.set(yticks=[])
    axes.grid(False)
    axes.set_ylabel(name, rotation=0, ha="right", va="center", labelpad=8)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw_weights(axes: Axes, ray: Ray) -> None:
    """Draw alpha (outlined), weight T·α (filled) and transmittance of all contributions."""
    columns, filled = ray.columns, ray.shown(ray.rgb)
    begin, end, t = columns["begin"], columns["end"], columns["t"]
    edge = {"edgecolor": MUTED.light, "linewidth": 0.5}
    if not len(t):
        axes.text(0.5, 0.5, "nothing on this ray: it shows the background", ha="center", transform=axes.transAxes)
    elif ray.record.kind == "samples":
        axes.bar(begin, columns["alpha"], end - begin, align="edge", facecolor="none", **edge, label="α")
        axes.bar(begin, columns["weight"], end - begin, align="edge", color=filled, **edge, label="weight T·α", zorder=3)
        _shade_gaps(axes, ray)
    else:
        axes.vlines(t, 0, columns["alpha"], color=MUTED.light, linewidth=0.8, label="α", zorder=2)
        axes.plot(t, columns["alpha"], "_", color=MUTED.light, markersize=6, zorder=2)
        axes.vlines(t, 0, columns["weight"], color=INK.light, linewidth=5.4, zorder=2.9)
        axes.vlines(t, 0, columns["weight"], color=filled, linewidth=4.2, label="weight T·α", zorder=3)
    for index, earlier in enumerate(ray.record.passes):
        edges, weight = np.array([*earlier.t0, earlier.t1[-1]], float), np.array(earlier.weight, float)
        axes.stairs(weight, edges, color=PASS, linewidth=1.4, zorder=3.5, label=f"weights of pass {index + 1}, coarser")
    _draw_transmittance(axes, ray)
    axes.set_ylim(0, 1.06)
    axes.set_ylabel("share of the light")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(
            loc="upper right", bbox_to_anchor=(1.0, 0.93), frameon=True, framealpha=0.85, edgecolor="none", fontsize=10.5
        )


def _draw_transmittance(axes: Axes, ray: Ray) -> None:
    """Draw transmittance: a curve where the density profile is known, else a step function."""
    profile, marched = curve_of(ray.record.profile), curve_of(ray.record.marched)
    if profile:
        axes.plot(profile["t"], profile["transmittance"], color=LIGHT, linewidth=2.2, label="transmittance T", zorder=4)
    elif len(ray.rgb):
        # In the order of compositing, which is that of the centres: the line goes back where the ray has another order.
        t, left = ray.columns["t"], ray.columns["transmittance"]
        left = np.append(left, left[-1] * (1 - ray.columns["alpha"][-1]))
        low, high = axes.get_xlim()
        x, y = np.concatenate([[low], np.repeat(t, 2), [high]]), np.repeat(left, 2)
        order = "T, in the order of centres" if ray.record.kind == "splats" else "transmittance T"
        axes.plot(x, y, color=LIGHT, linewidth=1.8, label=order, zorder=4)
    if marched:
        style: dict[str, Any] = {"color": LIGHT, "linewidth": 1.4, "linestyle": (0, (4, 2)), "zorder": 3.8}
        axes.plot(marched["t"], marched["transmittance"], label="T if they were marched", **style)


def _shade_gaps(axes: Axes, ray: Ray) -> None:
    """Shade intervals of the ray without samples."""
    low, high = axes.get_xlim()
    begin, end = np.append(ray.columns["begin"], high), np.insert(ray.columns["end"], 0, low)
    named = False
    for start, stop in zip(end, begin, strict=True):
        if stop - start > 1e-3 * (high - low):
            axes.axvspan(
                start, stop, color=GRID.light, alpha=0.6, linewidth=0, zorder=0, label=None if named else "not sampled"
            )
            named = True


def _densities(axes: Axes, ray: Ray) -> None:
    """Draw density along the ray, and its samples."""
    curve = curve_of(ray.record.profile) or curve_of(ray.record.marched)
    if "density" in curve:
        axes.fill_between(curve["t"], 0, curve["density"], color=DENSITY, alpha=0.25, linewidth=0)
        axes.plot(curve["t"], curve["density"], color=DENSITY, linewidth=1.2)
        axes.set_ylim(0, 1.08 * max(float(curve["density"].max()), 1e-9))
    if ray.record.kind == "samples" and "density" in ray.columns:
        axes.plot(ray.columns["t"], ray.columns["density"], ".", color=DENSITY, markersize=4)
    unit = f"\nper {ray.record.length_unit} unit"
    axes.set_ylabel(f"density{unit}" if ray.record.kind != "splats" else f"density{unit}\nif marched")


def _depths(panels: tuple[Axes, ...], ray: Ray) -> None:
    """Draw vertical lines at true, expected and median depth, labelled above the first panel."""
    strip, shares = panels[0], panels[1]
    low, high = strip.get_xlim()
    found = sorted((value, *DEPTH_STYLES[key]) for key, value in ray.depths.items() if low <= value <= high)
    for value, _, colour, dash in found:
        for axes in panels[1:]:
            axes.axvline(value, color=colour, linestyle=dash, linewidth=1.4, zorder=4.5)
    to_axes = shares.transData + shares.transAxes.inverted()
    places = [float(to_axes.transform((value, 0.0))[0]) for value, *_ in found]
    line = {"arrowstyle": "-", "linewidth": 1.2}
    style: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 11.5, "fontweight": "bold", "annotation_clip": False}
    spread = spread_labels(places, 0.16, 0.09, 0.91)
    for place, true, (value, name, colour, _) in zip(spread, places, found, strict=True):
        style |= {"arrowprops": line | {"color": colour}, "color": colour}
        ends = {"xycoords": "axes fraction", "textcoords": "axes fraction"}
        strip.annotate(f"{name} {value:.3f}", (true, 1.0), (place, 1.7), **ends, **style)


def _pictures(figure: Canvas, places: Any, ray: Ray, folder: Path) -> None:
    """Draw rendering and ground truth, each with the pixel in a cross-hair and its colour below."""
    pixel = ray.record.pixel
    shown = ((PICTURE, pixel.rendered, "rendered"), (TRUTH, pixel.true, "truth"))
    for place, (name, values, title) in zip(places, shown, strict=True):
        axes = figure.add_subplot(place)
        _cross_hair(axes, read_picture(inside(folder, name)), ray)
        axes.set_title(title)
        colour = np.array(values, float)
        tone = ray.shown(colour)
        swatch = axes.inset_axes((0.0, -0.17, 1.0, 0.14))
        swatch.set_facecolor(tuple(tone))
        swatch.set(xticks=[], yticks=[])
        swatch.grid(False)
        swatch.spines[:].set_visible(True)
        ink = INK.light if tone @ LUMINANCE > 0.5 else PAGE.light
        words = ", ".join(f"{value:.3f}" for value in colour)
        swatch.text(0.5, 0.5, words, color=ink, ha="center", va="center", transform=swatch.transAxes, fontsize=11.5)


def _cross_hair(axes: Axes, picture: UInt8[ndarray, "h w 3"], ray: Ray) -> None:
    height, width = picture.shape[:2]
    axes.imshow(picture, interpolation="nearest", extent=(0, width, height, 0))
    x, y, gap = ray.record.pixel.column + 0.5, ray.record.pixel.row + 0.5, max(width, height) / 28
    for tone, thickness in ((PAGE.light, 3.2), (SERIES[1].light, 1.4)):
        style: dict[str, Any] = {"color": tone, "linewidth": thickness}
        axes.plot([0, max(x - gap, 0), np.nan, min(x + gap, width), width], [y] * 5, **style)
        axes.plot([x] * 5, [0, max(y - gap, 0), np.nan, min(y + gap, height), height], **style)
    axes.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
