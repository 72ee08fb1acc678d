"""Test views of a page: ground truth beside each method, with error, depth and normal maps."""

from __future__ import annotations

import importlib.util
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from invgraphics.errors import InputError
from invgraphics.report.data.assets import Folder, gradient, save_normals, save_scalar
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.pictures import Arrays, read_arrays, read_picture
from invgraphics.report.wording import MeasuredQuantity, quality_quantity
from invgraphics.runs.run import Run, truth_arrays, truth_picture

ERROR_COLOURS, DEPTH_COLOURS = "magma", "viridis_r"
EVENLY_SPACED = 4


SPLAT_DEPTH = "Of volumes and splats it is a mean over all that a pixel sees: at edges and in haze it lies between surfaces."
SPLAT_NORMALS = "A splat's is its shortest axis, so that round or few splats look faceted or noisy where the picture is right."
ERRORS = "Black is no error; thin bright lines are edges that are a fraction of a pixel off."
"""Notes below the depth, normal and error maps."""


@dataclass(frozen=True)
class Picture:
    """A picture or map of a test view with caption, or the reason why there is none.

    Attributes:
        url: relative link; empty where there is no picture.
        caption: its score in words; empty where there is none.
        missing: why there is no picture.
    """

    url: str = ""
    caption: str = ""
    missing: str = ""


@dataclass(frozen=True)
class Layer:
    """Maps of one quantity of a test view, ground truth beside every method.

    Attributes:
        key: ``colour``, ``error``, ``depth`` or ``normal``.
        title: its heading.
        note: how to read it.
        gradient: CSS gradient of the colour bar; empty where there is none.
        low: text at the bar's left end.
        high: text at its right end.
        truth: the truth's picture.
        methods: (method, series, picture).
    """

    key: str
    title: str
    note: str
    gradient: str
    low: str
    high: str
    truth: Picture
    methods: tuple[tuple[str, int, Picture], ...]


@dataclass(frozen=True)
class ViewPage:
    """All pictures of one test view.

    Attributes:
        index: its number.
        name: what the data set calls it.
        why: why it was chosen.
        width: of the picture, px.
        height: of the picture, px.
        layers: colour first.
    """

    index: int
    name: str
    why: str
    width: int
    height: int
    layers: tuple[Layer, ...]


@dataclass(frozen=True)
class _Shown:
    """A method's run, and its colour and arrays on one test view."""

    run: Run
    series: int
    colour: UInt8[ndarray, "h w 3"]
    arrays: Arrays


def choose_views(runs: Sequence[Run]) -> list[tuple[int, str]]:
    """(index, why) of the views to show: evenly spaced ones, and the one with the worst first metric over all runs."""
    total = len(runs[0].scores.views)
    count = min(EVENLY_SPACED, total)
    chosen = {round(i * (total - 1) / max(1, count - 1)): "" for i in range(count)}
    key = next((key for key, score in runs[0].scores.quality.items() if score.per_view), None)
    if key is not None:
        quantity = quality_quantity(key, runs[0].scores.quality[key])
        worst = max(range(total), key=lambda view: quantity.sort_key(_mean_over(runs, key, view, quantity)))
        chosen[worst] = f"worst {quantity.label} over all methods"
    return sorted(chosen.items())


def draw_views(comparison: Comparison, folder: Folder) -> tuple[ViewPage, ...]:
    """Write the maps of the chosen views below ``figures/views`` and link all pictures; the first seed stands for a method."""
    firsts = [(runs[0], series) for series, method in comparison.drawn_methods if (runs := comparison.runs_of(method))]
    if not firsts:
        return ()
    return tuple(_draw_view(firsts, index, why, folder) for index, why in choose_views(comparison.runs))


def publish_truth(run: Run, index: int, folder: Folder) -> str:
    """Link to the truth's picture of a test view."""
    return folder.publish(run.truth, truth_picture(run.truth, index).name, f"pictures/truth-{index:04d}.png")


def _mean_over(runs: Sequence[Run], key: str, view: int, quantity: MeasuredQuantity) -> float:
    found = [
        run.scores.quality[key].per_view[view] for run in runs if key in run.scores.quality and run.scores.quality[key].per_view
    ]
    known = [value for value in found if value is not None]
    return statistics.fmean(known) if known else (math.inf if quantity.better == "higher" else -math.inf)


def _draw_view(firsts: Sequence[tuple[Run, int]], index: int, why: str, folder: Folder) -> ViewPage:
    truth_png = truth_picture(firsts[0][0].truth, index)
    truth = read_picture(truth_png)
    geometry_file = truth_arrays(firsts[0][0].truth, index)
    geometry = read_arrays(geometry_file, truth.shape[:2]) if geometry_file.is_file() else {}
    shown = []
    for run, series in firsts:
        picture = run.files.picture(index)
        colour = read_picture(picture)
        if colour.shape != truth.shape:
            raise InputError(f"'{picture}' and '{truth_png}' differ in size.", "Score the run again.")
        shown.append(_Shown(run, series, colour, read_arrays(run.files.arrays(index), truth.shape[:2])))
    target = folder.figures / "views" / f"{index:04d}"
    layers = (
        _colour_layer(shown, index, folder),
        _error_layer(shown, truth, index, folder, target),
        _depth_layer(shown, geometry, index, folder, target),
        _normal_layer(shown, geometry, index, folder, target),
    )
    name = firsts[0][0].scores.views[index]
    return ViewPage(index, name, why, truth.shape[1], truth.shape[0], tuple(layer for layer in layers if _any(layer)))


def _any(layer: Layer) -> bool:
    return any(picture.url for _, _, picture in layer.methods)


def _captioned(shown: Sequence[_Shown], pictures: Sequence[Picture], keys: Sequence[str], index: int) -> list[Picture]:
    """Add each run's scores on the view; none is marked, since a single picture cannot be told from chance."""
    captions: list[list[str]] = [[] for _ in shown]
    for key in keys:
        values = [_view_score(one.run, key, index) for one in shown]
        quantities = [quality_quantity(key, one.run.scores.quality[key]) for one in shown if key in one.run.scores.quality]
        for i, value in enumerate(values):
            if value is not None:
                captions[i].append(f"{quantities[0].label} {quantities[0].text(value)}{_unit(quantities[0])}")
    return [replace(picture, caption=" · ".join(caption)) for picture, caption in zip(pictures, captions, strict=True)]


def _unit(quantity: MeasuredQuantity) -> str:
    return quantity.unit if quantity.unit == "°" else f" {quantity.unit}" if quantity.unit else ""


def _view_score(run: Run, key: str, index: int) -> float | None:
    score = run.scores.quality.get(key)
    return score.per_view[index] if score is not None and score.per_view else None


def _with_methods(shown: Sequence[_Shown], pictures: Sequence[Picture]) -> tuple[tuple[str, int, Picture], ...]:
    return tuple((one.run.method, one.series, picture) for one, picture in zip(shown, pictures, strict=True))


def _colour_layer(shown: Sequence[_Shown], index: int, folder: Folder) -> Layer:
    pictures = []
    for one in shown:
        place = f"pictures/method-{one.series}-{index:04d}.png"
        pictures.append(Picture(folder.publish(one.run.folder, f"test/{index:04d}.png", place)))
    captioned = _captioned(shown, pictures, ("psnr", "ssim"), index)
    truth = Picture(publish_truth(shown[0].run, index, folder))
    return Layer("colour", "Picture", "", "", "", "", truth, _with_methods(shown, captioned))


@cache
def has_flip() -> bool:
    """Whether error maps are FLIP maps; otherwise they show the absolute error."""
    return importlib.util.find_spec("flip_evaluator") is not None


def error_map(truth: UInt8[ndarray, "h w 3"], image: UInt8[ndarray, "h w 3"]) -> Float[ndarray, "h w"]:
    """The visible difference of two pictures, 0 to 1: LDR-FLIP at 67 pixels per degree, or the mean absolute difference."""
    reference, test = (picture.astype(np.float32) / 255 for picture in (truth, image))
    if not has_flip():
        return np.abs(reference - test).mean(axis=-1)
    import flip_evaluator

    result, _, _ = flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False, computeMeanError=False)
    return np.asarray(result)[..., 0]


def _error_layer(shown: Sequence[_Shown], truth: UInt8[ndarray, "h w 3"], index: int, folder: Folder, target: Path) -> Layer:
    pictures, means = [], []
    for one in shown:
        error = error_map(truth, one.colour)
        path = target / f"error-{one.series}.png"
        save_scalar(path, error, np.ones(error.shape, bool), ERROR_COLOURS)
        pictures.append(Picture(folder.url(path)))
        means.append(float(error.mean()))
    if has_flip():
        pictures = _captioned(shown, pictures, ("flip",), index)
        title, note = (
            "FLIP error",
            f"Visible difference when flipping between truth and method, at 67 pixels per degree. {ERRORS}",
        )
    else:
        pictures = [replace(picture, caption=f"mean {mean:.3f}") for picture, mean in zip(pictures, means, strict=True)]
        title, note = "Absolute error", f"Mean absolute difference of the colour channels. {ERRORS}"
    no_truth = Picture(missing="truth has no error")
    return Layer("error", title, note, gradient(ERROR_COLOURS), "0", "1", no_truth, _with_methods(shown, pictures))


def _solid(arrays: Arrays, key: str) -> Bool[ndarray, "h w"] | None:
    """Mask of surface pixels: alpha at least one half and a finite value; ``None`` without that quantity."""
    if key not in arrays:
        return None
    values = arrays[key] if arrays[key].ndim == 2 else np.linalg.norm(arrays[key], axis=-1)
    mask = np.isfinite(values) & (values > 0)
    return mask & (arrays["alpha"] >= 0.5) if "alpha" in arrays else mask


def _depth_layer(shown: Sequence[_Shown], truth: Arrays, index: int, folder: Folder, target: Path) -> Layer:
    """Depth through one colour map and one range: the truth's where it is known, else all methods'."""
    sources = [truth] if "depth" in truth else [one.arrays for one in shown]
    found = [arrays["depth"][mask] for arrays in sources if (mask := _solid(arrays, "depth")) is not None]
    values = np.concatenate(found) if found else np.zeros(0)
    low, high = np.percentile(values, [1, 99]).tolist() if len(values) else (0.0, 1.0)
    span = max(high - low, 1e-6)

    def save(arrays: Arrays, mask: Bool[ndarray, "h w"], path: Path) -> None:
        save_scalar(path, (arrays["depth"] - low) / span, mask, DEPTH_COLOURS)

    note = f"Distance along the ray in world units, one range for all; blank where opacity is below one half. {SPLAT_DEPTH}"
    bar = gradient(DEPTH_COLOURS)
    truth_picture, pictures = _maps(shown, truth, "depth", (folder, target), save)
    methods = _with_methods(shown, _captioned(shown, pictures, ("depth_abs_rel",), index))
    return Layer("depth", "Depth", note, bar, f"{low:.2f}", f"{high:.2f} world units", truth_picture, methods)


def _normal_layer(shown: Sequence[_Shown], truth: Arrays, index: int, folder: Folder, target: Path) -> Layer:
    def save(arrays: Arrays, mask: Bool[ndarray, "h w"], path: Path) -> None:
        save_normals(path, arrays["normal"], mask)

    note = f"x, y, z in the scene's local frame as red, green, blue; blank where opacity is below one half. {SPLAT_NORMALS}"
    truth_picture, pictures = _maps(shown, truth, "normal", (folder, target), save)
    methods = _with_methods(shown, _captioned(shown, pictures, ("normal_deg",), index))
    return Layer("normal", "Normals", note, "", "", "", truth_picture, methods)


def _maps(
    shown: Sequence[_Shown],
    truth: Arrays,
    key: str,
    place: tuple[Folder, Path],
    save: Callable[[Arrays, Bool[ndarray, "h w"], Path], None],
) -> tuple[Picture, list[Picture]]:
    """Write the maps of one quantity, of the truth and of each method; a missing one states the reason."""
    folder, target = place

    def one(arrays: Arrays, name: str, missing: str) -> Picture:
        mask = _solid(arrays, key)
        if mask is None or not mask.any():
            return Picture(missing=missing if mask is None else "nothing opaque here")
        path = target / f"{key}-{name}.png"
        save(arrays, mask, path)
        return Picture(folder.url(path))

    what = "normals" if key == "normal" else key
    pictures = [one(method.arrays, str(method.series), f"this method gives no {what}") for method in shown]
    return one(truth, "truth", f"no ground-truth {what}"), pictures
