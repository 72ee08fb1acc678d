"""The same fitted field through other renderers: what of a picture is the representation, and what is the renderer.

A rendering is a run folder without a fit, ``RUN/rendered/NAME``; it knows the run whose checkpoint it shows. The run holds what
the pictures of one fit differ in (`invgraphics.runs.renderings`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
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
from invgraphics.experiments.request import FitRequest
from invgraphics.recipes.recipe import Method, load_method, resolve
from invgraphics.runs.environment import Environment
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.runs.renderings import OWN, Difference, Rendering, Renderings
from invgraphics.text import sha256_of, slug

FOLDER = "rendered"


@dataclass(frozen=True)
class Eye:
    """A renderer to look at a fitted field with.

    Attributes:
        name: as it was asked for, ``METHOD`` or ``METHOD:key=value:key=value`` with keys of the recipe's renderer.
        table: the resolved ``[renderer]`` of its recipe.
    """

    name: str
    table: dict[str, Any]

    @property
    def digest(self) -> str:
        """SHA-256 of the settings."""
        return sha256_of(self.table)

    @property
    def folder(self) -> str:
        """The name as one folder name."""
        method, *settings = re.split(_SETTING, self.name)
        return re.sub(r"[^\w.=+-]+", "-", "-".join([slug(method), *settings]))


_SETTING = r":(?=[\w.]+=)"


def eye_named(name: str) -> Eye:
    """Read what ``--render-with`` names.

    Raises:
        InputError: unknown method or setting, or a renderer of several parts whose recipe does not say which.
    """
    method, *settings = re.split(_SETTING, name)
    recipe = load_method(method, None, tuple(f"renderer.{item}" for item in settings))
    return Eye(name, recipe.table["renderer"])


def check_eyes(names: Sequence[str], methods: Iterable[Method], scene: Scene) -> None:
    """Refuse renderers that cannot show what the methods fit, before anything is fitted.

    Raises:
        InputError: a renderer is named twice, has parameters of its own, which only a fit could set, or needs what a field
            does not provide.
    """
    eyes = [eye_named(name) for name in names]
    if len({eye.folder for eye in eyes}) != len(eyes):
        raise InputError("A renderer is named twice in --render-with.")
    for method in methods if eyes else ():
        for eye in eyes:
            try:
                _, renderer = build_model(through(method, eye), scene, 0, torch.device("cpu"))
            except InputError as error:
                raise InputError(f"{method.name} cannot be rendered with {eye.name}: {error.sentence}", error.remedy) from error
            if renderer.state_dict() and eye.table != method.table["renderer"]:
                raise InputError(
                    f"{eye.name} cannot render what {method.name} fits: its renderer learns, so it needs a fit of its own."
                )


def rendered(folder: RunFolder, request: FitRequest, method: Method) -> bool:
    """Whether every rendering that ``request`` asks for is there, of the fit that is there."""
    if not request.render_with:
        return True
    try:
        record = folder.read(Renderings)
    except InputError:
        return False
    return record.identity == _identity(folder, [eye_named(name) for name in request.render_with], method)


def render_missing(folder: RunFolder, request: FitRequest, method: Method, scene: Scene) -> None:
    """Show a finished fit through every renderer that ``request`` names; renderings that are there are kept.

    Args:
        folder: of the fit.
        request: what it was asked to do.
        method: its resolved recipe.
        scene: the undisturbed scene.
    """
    if rendered(folder, request, method):
        return
    folder.remove(Renderings)
    eyes = [eye_named(name) for name in request.render_with]
    shown = {}
    for eye in _with_own(eyes, method):
        if eye.table == method.table["renderer"]:
            shown[eye.name] = OWN
        else:
            shown[eye.name] = f"{FOLDER}/{eye.folder}"
            _render(RunFolder(folder.root / FOLDER / eye.folder), folder, (method, eye), scene, request.protocol)
    pictures = {name: _pictures(folder.root / place, scene) for name, place in shown.items()}
    record = Renderings(
        identity=_identity(folder, eyes, method),
        fitted_by=method.name,
        views=tuple(view.name for view in scene.test),
        renderings=tuple(Rendering(renderer=name, run=place) for name, place in shown.items()),
        differences=tuple(_difference(pair, *(pictures[name] for name in pair)) for pair in combinations(shown, 2)),
    )
    folder.write(record)


def _render(folder: RunFolder, fit: RunFolder, model: tuple[Method, Eye], scene: Scene, protocol: str) -> None:
    """Make one rendering, unless it is there."""
    method, eye = model
    seen = through(method, eye)
    identity = sha256_of([fit.identity, eye.digest])
    if folder.finished and folder.identity == identity:
        return
    folder.create()
    folder.clear()
    folder.write_recipe(seen.table)
    folder.write(fit.read(Environment))
    folder.history.write_text("")
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
        rendered_by=eye.name,
    )
    folder.write(changed)
    for rules in dict.fromkeys([protocol, "default"]):
        evaluate_saved(folder, scene, rules)


def through(method: Method, eye: Eye) -> Method:
    """A method with another renderer."""
    name = f"{method.name} rendered with {eye.name}"
    return resolve(name, method.preset, method.table | {"renderer": eye.table})


def _with_own(eyes: Sequence[Eye], method: Method) -> list[Eye]:
    """The renderer of the fit, under the name that was asked for if it was, and all others."""
    own = method.table["renderer"]
    named = [eye for eye in eyes if eye.table == own]
    others = [eye for eye in eyes if eye.table != own]
    taken = any(eye.name == method.name for eye in others)
    return [*(named or [Eye(f"{method.name} as fitted" if taken else method.name, own)]), *others]


def _identity(folder: RunFolder, eyes: Sequence[Eye], method: Method) -> str:
    return sha256_of([folder.identity, *([eye.name, eye.digest] for eye in _with_own(eyes, method))])


def _pictures(run: Path, scene: Scene) -> list[Float[ndarray, "h w 3"]]:
    """Kept predictions over the scene's background, in its colour space and before rounding to 8 bits."""
    background = scene.background.numpy()
    pictures = []
    for index in range(len(scene.test)):
        with np.load(RunFolder(run).arrays(index), allow_pickle=False) as arrays:
            clear = 1 - arrays["alpha"].astype(np.float64)[..., None]
            pictures.append((arrays["rgb"].astype(np.float64) + clear * background).clip(0, 1))
    return pictures


def _difference(
    renderers: tuple[str, str], one: Sequence[Float[ndarray, "h w 3"]], other: Sequence[Float[ndarray, "h w 3"]]
) -> Difference:
    """Per view, between pictures of one fit by two renderers."""
    gaps = [a - b for a, b in zip(one, other, strict=True)]
    rmse, largest = [float(np.sqrt((gap**2).mean())) for gap in gaps], [float(np.abs(gap).max()) for gap in gaps]
    return Difference(renderers=renderers, rmse=tuple(rmse), largest=tuple(largest))
