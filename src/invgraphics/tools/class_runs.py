"""Runs on one class of objects: opened on one scene, and named by what distinguishes them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from invgraphics.core import Scene, View
from invgraphics.errors import InputError
from invgraphics.experiments.fitted import Fitted, load_fitted
from invgraphics.report.data.variants import level_words, short_names
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.runs.study import level_text
from invgraphics.scenes.open import SceneOptions, open_scene

MOST_WORDS = 3
"""Settings that a run's name may list; beyond them its folder does."""


def open_class_runs(folders: Sequence[Path], scene_spec: str | None = None) -> list[Fitted]:
    """Open runs on one class, with all of its views.

    Raises:
        InputError: one is no run of a class, or shows another one.
    """
    provenance = RunFolder(folders[0]).read(Provenance)
    options = SceneOptions(provenance.options.size, None, spp=None if scene_spec else provenance.options.spp)
    scene = open_scene(scene_spec or provenance.scene, options)
    if not scene.is_class:
        raise InputError(
            f"{folders[0]} is a fit to '{scene.name}', which shows one subject.", "Give a fit to a class, such as chairs."
        )
    digest, fitted = scene.digest("train"), []
    for path in folders:
        folder = RunFolder(path)
        if folder.read(Provenance).train_sha256 != digest:
            raise InputError(f"{path} was fitted to other pictures than '{scene.name}'.", "Give runs on the same class.")
        fitted.append(load_fitted(folder, scene))
    return fitted


def observed_views(scene: Scene, subjects: Sequence[int], count: int) -> dict[int, list[View]]:
    """The first ``count`` observed views of each instance.

    Raises:
        InputError: an instance has fewer.
    """
    observed = {subject: [view for view in scene.observed if view.subject == subject][:count] for subject in subjects}
    for subject, views in observed.items():
        if len(views) < count:
            raise InputError(f"Instance {subject} of '{scene.name}' has {len(views)} observed views, not {count}.")
    return observed


def run_names(fitted: Sequence[Fitted]) -> list[str]:
    """Names of runs: their methods; equal methods also by the settings that differ, and else by their folders."""
    names = [one.method.name for one in fitted]
    for name in {name for name in names if names.count(name) > 1}:
        places = [place for place, other in enumerate(names) if other == name]
        words = _differences([fitted[place].method.table for place in places])
        for place, differing in zip(places, words, strict=True):
            names[place] = ", ".join([name, *differing])
    return [
        name if names.count(name) == 1 else f"{name} ({one.folder.root.name})" for name, one in zip(names, fitted, strict=True)
    ]


def _differences(recipes: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """In words, the settings of each recipe in which they differ; none where these are too many to be read."""
    flat = [dict(_flat(recipe)) for recipe in recipes]
    paths = list(dict.fromkeys(path for table in flat for path in table))
    differing = [path for path in paths if len({level_text(table.get(path)) for table in flat}) > 1]
    if len(differing) > MOST_WORDS:
        return [[] for _ in recipes]
    short = short_names(differing)
    return [
        [
            value if isinstance(value := table.get(path), str) else level_words(short[path], level_text(value))
            for path in differing
        ]
        for table in flat
    ]


def _flat(table: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted path and value of every setting of a recipe."""
    if isinstance(table, Mapping):
        for key, value in table.items():
            yield from _flat(value, f"{path}.{key}" if path else str(key))
    else:
        yield path, table
