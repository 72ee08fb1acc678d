"""Cross-rendering of a fitted field by other renderers, which separates effects of representation and renderer.

A rendering is a run folder without a fit, ``RUN/rendered/NAME``; it names the run whose checkpoint it shows. The run holds what
the pictures of one fit differ in (`invgraphics.runs.renderings`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from invgraphics.arrays import read_arrays
from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model
from invgraphics.experiments.evaluate import evaluate_saved
from invgraphics.experiments.job import Job
from invgraphics.experiments.variants import RendererVariant, with_renderer
from invgraphics.files import write_text
from invgraphics.recipes.recipe import Method
from invgraphics.runs.environment import Environment
from invgraphics.runs.folder import RENDERED, RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.runs.renderings import OWN, Difference, Rendering, Renderings
from invgraphics.text import sha256_of


def check_variants(variants: Sequence[RendererVariant], methods: Iterable[Method], scene: Scene) -> None:
    """Check before fitting that each renderer can render the methods' fields.

    Raises:
        InputError: a renderer is named twice, has learnt state without a constant substitute, or needs what a field does
            not provide.
    """
    if len({variant.folder for variant in variants}) != len(variants):
        raise InputError("A renderer is named twice in --render-with.")
    for method in methods if variants else ():
        for variant in variants:
            try:
                model = build_model(with_renderer(method, variant), scene, 0, torch.device("cpu"), shown=True)
                if variant.table != method.table["renderer"]:
                    model.renderer.untrained()
            except InputError as error:
                sentence = f"{method.name} cannot be rendered with {variant.name}: {error.sentence}"
                raise InputError(sentence, error.remedy) from error


def renderings_complete(job: Job) -> bool:
    """Whether every rendering requested by a job exists and belongs to the current fit."""
    if not job.variants:
        return True
    try:
        record = job.folder.read(Renderings)
    except InputError:
        return False
    same = record.identity == _identity(job.folder, job.variants, job.method)
    places = [RunFolder(job.folder.root / one.run) for one in record.renderings]
    return same and all(place.scores_path(protocol).is_file() for place in places for protocol in job.protocols)


def is_kept(job: Job) -> bool:
    """Whether a finished run is kept although the code has changed since: by the same recipe, scored and shown as requested.

    Its folder, or `check_replaceable`, ensures that scene and request are the same.
    """
    return is_kept_fit(job) and not job.unscored() and renderings_complete(job)


def is_kept_fit(job: Job) -> bool:
    """The same, whatever scores and renderings there are: they can be made from its checkpoint."""
    return job.folder.finished and job.folder.read(Provenance).recipe_sha256 in job.recipe_digests


def render_missing(job: Job, scene: Scene) -> None:
    """Render and score a finished fit by every requested renderer; existing renderings are kept.

    Args:
        job: of the fit.
        scene: the scene as loaded.
    """
    if renderings_complete(job):
        return
    folder, method = job.folder, job.method
    folder.remove(Renderings)
    shown = {}
    for variant in _with_own(job.variants, method):
        if variant.table == method.table["renderer"]:
            shown[variant.name] = OWN
        else:
            shown[variant.name] = f"{RENDERED}/{variant.folder}"
            _render(RunFolder(folder.root / RENDERED / variant.folder), folder, (method, variant), scene, job.protocols)
    pictures = {name: _pictures(folder.root / place, scene) for name, place in shown.items()}
    record = Renderings(
        identity=_identity(folder, job.variants, method),
        fitted_by=method.name,
        views=tuple(view.name for view in scene.test),
        renderings=tuple(Rendering(renderer=name, run=place) for name, place in shown.items()),
        differences=tuple(_difference(pair, *(pictures[name] for name in pair)) for pair in combinations(shown, 2)),
    )
    folder.write(record)


def _render(
    folder: RunFolder, fit: RunFolder, model: tuple[Method, RendererVariant], scene: Scene, protocols: Sequence[str]
) -> None:
    """Render and score the fit by one renderer, under the protocols under which that was not done before."""
    method, variant = model
    seen = with_renderer(method, variant)
    identity = sha256_of([fit.identity, variant.digest])
    if folder.finished and folder.identity == identity:
        for rules in protocols:
            if not folder.scores_path(rules).is_file():
                evaluate_saved(folder, scene, rules)
        return
    folder.create()
    folder.clear()
    folder.write_recipe(seen.table)
    folder.write(fit.read(Environment))
    write_text(folder.history, "")
    provenance = fit.read(Provenance)
    up = Path(*[".."] * len(folder.root.relative_to(fit.root).parts))
    changed = replace(
        provenance,
        cell_sha256=identity,
        method=seen.name,
        recipe_sha256=seen.digest,
        truth=(up / provenance.truth).as_posix(),
        fitted_run=up.as_posix(),
        fitted_by=method.name,
        rendered_by=variant.name,
    )
    folder.write(changed)
    for rules in protocols:
        evaluate_saved(folder, scene, rules)


def _with_own(variants: Sequence[RendererVariant], method: Method) -> list[RendererVariant]:
    """List the fit's own renderer, under its requested name if it has one, and all others."""
    own = method.table["renderer"]
    named = [variant for variant in variants if variant.table == own]
    others = [variant for variant in variants if variant.table != own]
    taken = any(variant.name == method.name for variant in others)
    return [*(named or [RendererVariant(f"{method.name} as fitted" if taken else method.name, own)]), *others]


def _identity(folder: RunFolder, variants: Sequence[RendererVariant], method: Method) -> str:
    return sha256_of([folder.identity, *([variant.name, variant.digest] for variant in _with_own(variants, method))])


@dataclass(frozen=True, eq=False)
class _Pictured:
    """A saved prediction: colour over the background, and depth, which is not finite where no surface is shown."""

    colour: Float[ndarray, "h w 3"]
    depth: Float[ndarray, "h w"]


def _pictures(run: Path, scene: Scene) -> list[_Pictured]:
    """Composite saved predictions over the scene's background, in its colour space, without rounding to 8 bits."""
    background = scene.background.numpy()
    pictures = []
    for index in range(len(scene.test)):
        arrays = read_arrays(RunFolder(run).arrays(index))
        clear = 1 - arrays["alpha"].astype(np.float64)[..., None]
        colour = (arrays["rgb"].astype(np.float64) + clear * background).clip(0, 1)
        pictures.append(_Pictured(colour, np.where(clear[..., 0] <= 0.5, arrays["depth"].astype(np.float64), np.nan)))
    return pictures


def _difference(renderers: tuple[str, str], one: Sequence[_Pictured], other: Sequence[_Pictured]) -> Difference:
    """Differences of colour and depth per view between pictures of one fit by two renderers."""
    gaps = [a.colour - b.colour for a, b in zip(one, other, strict=True)]
    with np.errstate(invalid="ignore"):  # no surface in either: infinity minus infinity
        depths = [np.abs(a.depth - b.depth) for a, b in zip(one, other, strict=True)]
    depth = tuple(float(np.median(gap[np.isfinite(gap)])) for gap in depths if np.isfinite(gap).any())
    rmse, largest = [float(np.sqrt((gap**2).mean())) for gap in gaps], [float(np.abs(gap).max()) for gap in gaps]
    return Difference(renderers=renderers, rmse=tuple(rmse), largest=tuple(largest), depth=depth)
