"""Predictions on disk with their ground truth: those of a run, or a folder of another tool's pictures."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from invgraphics.core import Bounds, Rendering, Scene, View
from invgraphics.errors import InputError
from invgraphics.metrics.conventions import BLACK, Colour
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.inside import inside
from invgraphics.runs.provenance import Provenance
from invgraphics.scenes.pictures.images import image_files, read_pixels
from invgraphics.tools.saved_pictures import has_transparency, is_baked, read_picture, read_saved, read_truth

LAYOUTS = (("renders", "gt"), ("color", "gt-color"))
"""Sub-folders of predictions and truth: of 3DGS's render.py and of nerfbaselines."""


@dataclass(frozen=True, eq=False)
class PictureSet:
    """Predicted pictures with their ground truth, backgrounds and transparency.

    Attributes:
        folder: where the predictions came from.
        names: of the views.
        scene: background and colour space; holds no views, which are read one at a time.
        background: the data set's background; ``None`` where it is unknown.
        transparency: ``open``: both sides can be put in front of any background; ``fixed``: one side is already in front of
            ``background``; ``opaque``: photographs, which have none.
        eight_bit: whether unrounded predictions are missing.
        truth: the truth of a view by index.
        prediction: the prediction of a view by index; with ``True`` its colours over the scene's background are exactly
            those of its 8-bit picture.
        sha256: of the truth's pixels, all views; made like `Scene.digest`.
        size: width and height of the first view.
        provenance: the run's, ``None`` for other folders.
        notes: what was assumed, in sentences.
    """

    folder: Path
    names: tuple[str, ...]
    scene: Scene
    background: Colour | None
    transparency: Literal["open", "fixed", "opaque"]
    eight_bit: bool
    truth: Callable[[int], View]
    prediction: Callable[[int, bool], Rendering]
    sha256: str
    size: tuple[int, int]
    provenance: Provenance | None = None
    notes: tuple[str, ...] = ()


def open_pictures(folder: Path, truth: Path | None = None, background: Colour | None = None) -> PictureSet:
    """Open a run, or a folder of predicted pictures, for scoring.

    Args:
        folder: a run; or pictures, possibly in a layout of `LAYOUTS` or in a 3DGS model's ``test/ours_N``.
        truth: folder of the true pictures; needed unless ``folder`` brings its own.
        background: what pictures without alpha show where the scene is transparent. Runs know it.

    Raises:
        InputError: something is missing, unreadable, or does not fit together, such as a background that is not a run's.
    """
    if not folder.is_dir():
        raise InputError(f"There is no folder '{folder}'.", "Give a run, or a folder of predicted pictures.")
    if not RunFolder(folder).has(Provenance):
        return _open_folder(folder, truth, background)
    pictures = _open_run(folder, truth)
    if background is not None and pictures.background is not None and tuple(background) != tuple(pictures.background):
        known = ",".join(f"{value:g}" for value in pictures.background)
        raise InputError(f"The scene of the run '{folder}' has the background {known}.", "Leave --background out.")
    return pictures


def _open_run(folder: Path, truth: Path | None) -> PictureSet:
    run = RunFolder(folder)
    provenance, predictions = run.read(Provenance), run.predictions
    if not predictions:
        raise InputError(f"The run '{folder}' has no saved predictions (test/*.npz).", "Let it finish: fit --resume.")
    true = run.truth(provenance) if truth is None else truth
    matched, notes = _match(predictions, _pictures_in(true))
    _check_inside(run.path("test"), predictions)
    if truth is None:
        _check_inside(true, [path for _, path in matched])
    names = run.read_scores().views if run.finished else ()
    scene = _scene(provenance.background, provenance.colour)

    def true_view(index: int) -> View:
        return read_truth(matched[index][1], scene)

    def predicted(index: int, exact: bool) -> Rendering:
        return read_saved(matched[index][0], scene, exact)

    digest, transparent, size = _survey(true_view, len(matched))
    baked = not transparent and any(is_baked(path) for _, path in matched)
    return PictureSet(
        folder=folder,
        names=names if len(names) == len(matched) else tuple(path.stem for path, _ in matched),
        scene=scene,
        background=provenance.background,
        transparency="open" if transparent else "fixed" if baked else "opaque",
        eight_bit=False,
        truth=true_view,
        prediction=predicted,
        sha256=digest,
        size=size,
        provenance=provenance,
        notes=notes,
    )


def _open_folder(folder: Path, truth: Path | None, background: Colour | None) -> PictureSet:
    predictions, truths = _sides(folder, truth)
    matched, notes = _match(_pictures_in(predictions), _pictures_in(truths))
    scene = _scene(background or BLACK, "srgb")

    def true_view(index: int) -> View:
        return read_truth(matched[index][1], scene)

    def predicted(index: int, exact: bool) -> Rendering:
        return read_picture(matched[index][0])

    digest, transparent, size = _survey(true_view, len(matched))
    open_sides = _any_alpha(matched), transparent
    if background is None and (open_sides[0] != open_sides[1] or any(is_baked(path) for _, path in matched)):
        closed = "truth" if open_sides[0] else "predictions"
        raise InputError(
            f"In '{folder}' the scene has transparent pixels, and the pictures of the {closed} have no alpha channel.",
            "Say what they show there, for instance --background white.",
        )
    transparency = "open" if all(open_sides) else "opaque" if background is None else "fixed"
    if transparency == "opaque":
        notes += ("No picture has an alpha channel: scored as photographs. If they show a background, name it: --background.",)
    return PictureSet(
        folder=folder,
        names=tuple(path.stem for path, _ in matched),
        scene=scene,
        background=background,
        transparency=transparency,
        eight_bit=True,
        truth=true_view,
        prediction=predicted,
        sha256=digest,
        size=size,
        notes=notes,
    )


def _sides(folder: Path, truth: Path | None) -> tuple[Path, Path]:
    """Find the folders of predictions and of ground truth."""
    models = sorted(path for path in folder.glob("test/ours_*") if path.is_dir())
    if len(models) > 1:
        raise InputError(f"'{folder}' holds the pictures of {len(models)} models.", f"Give one, for instance '{models[-1]}'.")
    root = models[0] if models else folder
    for predictions, true in LAYOUTS:
        if (root / predictions).is_dir() and (truth is not None or (root / true).is_dir()):
            return root / predictions, truth or root / true
    if truth is None:
        layouts = " and ".join("/ + ".join(pair) + "/" for pair in LAYOUTS)
        raise InputError(f"'{root}' is no run and has no true pictures.", f"Name them with --truth DIR (known: {layouts}).")
    return root, truth


def _pictures_in(folder: Path) -> list[Path]:
    files = sorted(image_files(folder), key=_natural)
    if not files:
        raise InputError(f"There is no picture in '{folder}'." if folder.is_dir() else f"There is no folder '{folder}'.")
    return files


def _check_inside(folder: Path, files: Sequence[Path]) -> None:
    """Refuse links that lead outside ``folder``, of ``files`` and of the picture or the arrays beside each.

    Raises:
        InputError: there is such a link.
    """
    for name in {name for path in files for name in (path.name, f"{path.stem}.png", f"{path.stem}.npz")}:
        inside(folder, name)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key in natural order: r_2 before r_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.stem) if part]


def _match(predictions: Sequence[Path], truths: Sequence[Path]) -> tuple[list[tuple[Path, Path]], tuple[str, ...]]:
    """Pair predictions with truths by name where all names are equal, else by their order."""
    if len(predictions) != len(truths):
        raise InputError(
            f"'{predictions[0].parent}' holds {len(predictions)} predictions, '{truths[0].parent}' {len(truths)} truths.",
            "Every prediction needs its truth, and every truth its prediction: move other pictures elsewhere.",
        )
    by_name = {path.stem: path for path in truths}
    if set(by_name) == {path.stem for path in predictions}:
        return [(path, by_name[path.stem]) for path in predictions], ()
    first, last = (f"{predictions[i].name} with {truths[i].name}" for i in (0, -1))
    return list(zip(predictions, truths, strict=True)), (f"Names differ: matched in order, from {first} to {last}.",)


def _any_alpha(matched: Sequence[tuple[Path, Path]]) -> bool:
    """Whether any prediction has transparent pixels; all are read, and must have the size of their truth."""
    clear = False
    for path, true in matched:
        pixels, true_pixels = read_pixels(path), read_pixels(true)
        if pixels.shape[:2] != true_pixels.shape[:2]:
            (height, width), (true_height, true_width) = pixels.shape[:2], true_pixels.shape[:2]
            raise InputError(f"'{path}' is {width}x{height} pixels, its truth '{true}' is {true_width}x{true_height}.")
        clear = clear or has_transparency(pixels)
    return clear


def _survey(true_view: Callable[[int], View], count: int) -> tuple[str, bool, tuple[int, int]]:
    """Hash all true pixels; also returns whether any is transparent, and the first view's size."""
    sha, transparent, size = hashlib.sha256(), False, (0, 0)
    for index in range(count):
        view = true_view(index)
        size = size if index else (view.image.shape[1], view.image.shape[0])
        transparent = transparent or view.alpha is not None
        for values in (view.image, view.alpha):
            if values is not None:
                sha.update(repr((tuple(values.shape), str(values.dtype))).encode())
                sha.update(np.ascontiguousarray(values.numpy()).tobytes())
    return sha.hexdigest(), transparent, size


def _scene(background: Sequence[float], colour: Literal["srgb", "linear"]) -> Scene:
    cube = Bounds(-torch.ones(3), torch.ones(3))
    return Scene("pictures", (), (), torch.tensor(list(background), dtype=torch.float32), cube, colour=colour)
