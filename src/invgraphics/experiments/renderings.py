"""The same fitted field through other renderers: what of a picture is the representation, and what is the renderer.

A rendering is a run folder without a fit, ``RUN/rendered/NAME``; it knows the run whose checkpoint it shows. What the pictures
of one fit differ in is in ``RUN/renderings.json``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model
from invgraphics.experiments.evaluate import evaluate_saved
from invgraphics.experiments.job import Job
from invgraphics.experiments.variants import RendererVariant, with_renderer
from invgraphics.recipes.recipe import Method
from invgraphics.runs.folder import RunFolder

RECORD = "renderings.json"
"""What a fit's folder holds about its renderings."""
FOLDER = "rendered"


def check_variants(variants: Sequence[RendererVariant], methods: Iterable[Method], scene: Scene) -> None:
    """Refuse renderers that cannot show what the methods fit, before anything is fitted.

    Raises:
        InputError: a renderer is named twice, has learnt state for which no constants stand in, or needs what a field does
            not provide.
    """
    if len({variant.folder for variant in variants}) != len(variants):
        raise InputError("A renderer is named twice in --render-with.")
    for method in methods if variants else ():
        for variant in variants:
            try:
                model = build_model(with_renderer(method, variant), scene, 0, torch.device("cpu"))
                if variant.table != method.table["renderer"]:
                    model.renderer.untrained()
            except InputError as error:
                sentence = f"{method.name} cannot be rendered with {variant.name}: {error.sentence}"
                raise InputError(sentence, error.remedy) from error


def rendered(job: Job) -> bool:
    """Whether every rendering that a job asks for is there, of the fit that is there."""
    if not job.variants:
        return True
    try:
        record = job.folder.read_json(RECORD)
    except InputError:
        return False
    return record.get("identity") == _identity(job.folder, job.variants, job.method)


def render_missing(job: Job, scene: Scene) -> None:
    """Show a finished fit through every renderer that its job names; renderings that are there are kept.

    Args:
        job: of the fit.
        scene: the scene as loaded.
    """
    if rendered(job):
        return
    folder, method = job.folder, job.method
    (folder.root / RECORD).unlink(missing_ok=True)
    shown = {}
    for variant in _with_own(job.variants, method):
        if variant.table == method.table["renderer"]:
            shown[variant.name] = "."
        else:
            shown[variant.name] = f"{FOLDER}/{variant.folder}"
            _render(RunFolder(folder.root / FOLDER / variant.folder), folder, (method, variant), scene, job.protocols)
    pictures = {name: _pictures(folder.root / place, scene) for name, place in shown.items()}
    folder.write_json(
        RECORD,
        {
            "schema": 1,
            "identity": _identity(folder, job.variants, method),
            "fitted_by": method.name,
            "views": [view.name for view in scene.test],
            "renderings": [{"renderer": name, "run": place} for name, place in shown.items()],
            "differences": [
                {"renderers": [one, other], **_difference(pictures[one], pictures[other])}
                for one, other in combinations(shown, 2)
            ],
        },
    )


def _render(
    folder: RunFolder, fit: RunFolder, model: tuple[Method, RendererVariant], scene: Scene, protocols: Sequence[str]
) -> None:
    """Make one rendering, unless it is there."""
    method, variant = model
    seen = with_renderer(method, variant)
    identity = _sha256([fit.identity, variant.digest])
    if folder.finished and folder.identity == identity:
        return
    folder.create()
    folder.clear()
    (folder.root / "test").mkdir(exist_ok=True)
    folder.write_recipe(seen.table)
    folder.write_json("environment.json", fit.read_json("environment.json"))
    folder.history.write_text("")
    provenance = fit.read_json("provenance.json")
    up = Path(*[".."] * len(folder.root.relative_to(fit.root).parts))
    changed = {
        "cell_sha256": identity,
        "method": seen.name,
        "recipe_sha256": seen.digest,
        "truth": (up / provenance["truth"]).as_posix(),
        "fitted_run": up.as_posix(),
        "fitted_by": method.name,
        "rendered_by": variant.name,
    }
    folder.write_json("provenance.json", provenance | changed)
    for rules in protocols:
        evaluate_saved(folder, scene, rules)


def _with_own(variants: Sequence[RendererVariant], method: Method) -> list[RendererVariant]:
    """The renderer of the fit, under the name that was asked for if it was, and all others."""
    own = method.table["renderer"]
    named = [variant for variant in variants if variant.table == own]
    others = [variant for variant in variants if variant.table != own]
    taken = any(variant.name == method.name for variant in others)
    return [*(named or [RendererVariant(f"{method.name} as fitted" if taken else method.name, own)]), *others]


def _identity(folder: RunFolder, variants: Sequence[RendererVariant], method: Method) -> str:
    return _sha256([folder.identity, *([variant.name, variant.digest] for variant in _with_own(variants, method))])


def _sha256(parts: Any) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _pictures(run: Path, scene: Scene) -> list[Float[ndarray, "h w 3"]]:
    """Kept predictions over the scene's background, in its colour space and before rounding to 8 bits."""
    background = scene.background.numpy()
    pictures = []
    for index in range(len(scene.test)):
        with np.load(run / "test" / f"{index:04d}.npz", allow_pickle=False) as arrays:
            clear = 1 - arrays["alpha"].astype(np.float64)[..., None]
            pictures.append((arrays["rgb"].astype(np.float64) + clear * background).clip(0, 1))
    return pictures


def _difference(one: Sequence[Float[ndarray, "h w 3"]], other: Sequence[Float[ndarray, "h w 3"]]) -> dict[str, list[float]]:
    """Per view, between pictures of one fit by two renderers: root of the mean square and the largest, colours in [0, 1]."""
    gaps = [a - b for a, b in zip(one, other, strict=True)]
    return {"rmse": [float(np.sqrt((gap**2).mean())) for gap in gaps], "largest": [float(np.abs(gap).max()) for gap in gaps]}
