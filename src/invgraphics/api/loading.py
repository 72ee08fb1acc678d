"""Loading of scenes, methods and runs by name or path, and their names or files for other processes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, cast

import tomlkit

from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.experiments.build import open_with_progress
from invgraphics.experiments.fitted import load_fitted, open_fitted
from invgraphics.experiments.request import DATA, check_size, python_ints
from invgraphics.experiments.session import FolderRun
from invgraphics.files import write_text
from invgraphics.recipes import recipe
from invgraphics.recipes.recipe import Method
from invgraphics.runs.folder import RunFolder, check_run
from invgraphics.scenes.npz_writer import save_npz
from invgraphics.scenes.open import SceneOptions, validate
from invgraphics.studies.factors import override
from invgraphics.tables import plain
from invgraphics.text import sha256_of
from invgraphics.training.budget import Budget

T = TypeVar("T")

MethodLike: TypeAlias = str | os.PathLike[str] | Mapping[str, Any] | Method
"""A method's name, the path of a recipe, a recipe as a table, or a method that `load_method` returned."""


def load_scene(
    spec: str | os.PathLike[str],
    *,
    size: int | tuple[int, int] | None = None,
    test_views: int | Literal["all"] | None = 16,
    spp: int | None = None,
) -> Scene:
    """Open a scene: posed training views to fit, and held-out views to score.

    Args:
        spec: a built-in scene (``bricks``; it is rendered at first use and cached), the path of a data set in a known format,
            or a folder that ``invgraphics import-photos`` wrote.
        size: longest side of the pictures in pixels, or (width, height); ``None`` for the scene's own.
        test_views: how many views score, evenly spaced; ``"all"`` or ``None`` for all.
        spp: samples per pixel of a scene that is rendered; ``None`` for its own.

    Raises:
        InputError: nothing is known by this name, no format fits, or the data cannot be used.

    Example:
        >>> import invgraphics as ig
        >>> scene = ig.load_scene("toy.npz", size=16)
        >>> len(scene.train), scene.test[0].camera.width
        (8, 16)
    """
    check_size(size)
    views = None if test_views == "all" else test_views
    return open_with_progress(os.fspath(spec), SceneOptions(*python_ints((size, views)), spp=python_ints(spp)))


def save_scene(scene: Scene, path: str | os.PathLike[str]) -> Path:
    """Write a scene as one ``.npz`` that `load_scene` opens: views, cameras, bounds and points.

    Args:
        scene: of 8-bit sRGB pictures of one size in a box, without masks. Names of views, noise level and spread of exposures
            are not kept, nor which photographs show which points.
        path: to write, ending in ``.npz``.

    Returns:
        The file.

    Raises:
        InputError: the format cannot hold what the scene has, or the file cannot be written.

    Example:
        >>> import invgraphics as ig
        >>> scene = ig.load_scene("toy.npz", size=16)
        >>> kept = ig.load_scene(ig.save_scene(scene, "small.npz"))
        >>> kept.digest("train") == scene.digest("train")
        True
    """
    target = Path(path)
    if target.suffix != ".npz":
        raise InputError(f"A scene cannot be saved as '{target}'.", "Expected a file name that ends in .npz.")
    try:
        save_npz(scene, target)
    except OSError as error:
        raise InputError(f"The scene cannot be written to '{target}': {error}.", "Choose another place.") from error
    return target


def load_method(
    method: str | os.PathLike[str] | Mapping[str, Any], *, preset: str | None = None, set: Mapping[str, Any] | None = None
) -> Method:
    """Read a method's recipe, with values of it changed.

    Args:
        method: ``renderer/recipe``, the path of a recipe, or a recipe as a table, as ``tomllib.loads`` reads it.
        preset: one of the recipe's presets; ``None`` leaves the choice to the budget of the fit that gets the method, and shows
            the one for short budgets.
        set: dotted path of a value in the recipe -> its new value. What changes the training data instead (``data.init``) is
            no part of a method: `fit` and `compare` take it as their ``data``.

    Raises:
        InputError: unknown method, preset or key, or a value of the wrong type.

    Example:
        >>> import invgraphics as ig
        >>> wide = ig.load_method("volumetric/hash", set={"field.width": 64})
        >>> wide.recipe.field.width, wide.name
        (64, 'volumetric/hash:field.width=64')
    """
    if set is not None and not isinstance(set, Mapping):
        raise InputError(f"'set' cannot be {set!r}.", 'Expected: a table such as {"field.width": 64}.')
    for path, value in (set or {}).items():
        if path.startswith(DATA):
            key = path.removeprefix(DATA)
            remedy = f"Give it to ig.fit or ig.compare: data={{{key!r}: {value!r}}}."
            raise InputError(f"'{path}' changes the training data, which is no part of a method.", remedy)
    changes = [override(path, value) for path, value in (set or {}).items()]
    if isinstance(method, Mapping):
        return recipe.method_from(_plain_table(method), "recipe", preset, changes)
    if not isinstance(method, str | os.PathLike):
        raise InputError(
            f"A method cannot be {type(method).__name__}.", "Expected: its name, the path of a recipe, or a table."
        )
    if "\n" in (name := os.fspath(method)):
        raise InputError("A method's name has one line.", "Of a recipe's text, give the table: tomllib.loads(text).")
    return recipe.load_method(":".join([name, *([f"preset={preset}"] if preset else []), *changes]))


def load_run(folder: str | os.PathLike[str], scene: Scene | str | None = None) -> FolderRun:
    """Open a run that `fit`, `compare` or the command line wrote: its model, its scene, its history, its scores.

    Args:
        folder: of the run.
        scene: another copy of its scene, where that has moved; or a loaded scene, whose test views may be others.

    Raises:
        InputError: the folder holds no run, its scene cannot be opened, or its checkpoint does not fit its recipe.

    Example:
        >>> import invgraphics as ig
        >>> fit = ig.fit("splatting/gaussians", "toy.npz", budget="20steps", out="runs/toy")
        >>> run = ig.load_run("runs/toy")
        >>> run.scores["psnr"] == fit.scores["psnr"]
        True
        >>> exact = run.through("gaussian-volume/exact")  # the same Gaussians, integrated instead of splatted
        >>> exact.render(run.scene.test[0].camera.resized(24, 24)).alpha.shape
        torch.Size([24, 24])
    """
    root = Path(folder)
    check_run(root)
    if isinstance(scene, Scene):
        return FolderRun(load_fitted(RunFolder(root), validate(scene)))
    return FolderRun(open_fitted(root, scene))


def as_scene(scene: Scene | str | os.PathLike[str]) -> Scene:
    """Open a scene by name, or check one that is already open.

    Raises:
        InputError: it cannot be opened, or not be used.
    """
    return validate(scene) if isinstance(scene, Scene) else load_scene(scene)


def data_overrides(data: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Changes of the training data as a request holds them, as ``--set data.KEY=value`` makes them.

    Raises:
        InputError: it is no table, or TOML has no such value.
    """
    if data is None:
        return ()
    if not isinstance(data, Mapping):
        raise InputError(f"The data cannot be {data!r}.", 'Expected: a table of what to change, such as {"train_views": 4}.')
    return tuple(override(f"{DATA}{key}", value) for key, value in data.items())


def listed(items: T | Iterable[T], lone: type | tuple[type, ...]) -> list[T]:
    """Items in a list, and a lone one, which has a type of ``lone``, in a list of its own."""
    if isinstance(items, lone) or not isinstance(items, Iterable):
        return [cast(T, items)]
    return list(cast(Iterable[T], items))


def whole_seeds(seeds: Sequence[int] | int) -> tuple[int, ...]:
    """Seeds, or a lone one, with numpy's whole numbers as plain ones; what is no number stays, for the request to refuse."""
    return python_ints(tuple(listed(seeds, str)))


def resolved(method: MethodLike, budget: str, name: str = "recipe") -> tuple[str, Method | None]:
    """Name by which other processes load a method, and of a method without one the method itself, called ``name``.

    Args:
        method: of any kind.
        budget: that chooses a table's preset.
        name: for a table, such as the path where its recipe will be.

    Raises:
        InputError: the table is no recipe.
    """
    known = _name_or_table(method)
    if isinstance(known, str):
        return known, None
    return name, replace(recipe.method_from(known, "recipe", budget=Budget.parse(budget)), name=name)


def name_of(method: MethodLike, folder: Path) -> str:
    """Name by which other processes load a method: a table's is its file in ``folder``, which is called after the content.

    So another table never replaces a file that the provenance of a run names.
    """
    known = _name_or_table(method)
    if isinstance(known, str):
        return known
    file = folder / f"{sha256_of(known)[:12]}.toml"
    folder.mkdir(parents=True, exist_ok=True)
    write_text(file, tomlkit.dumps(known))
    return str(file)


def _name_or_table(method: MethodLike) -> str | dict[str, Any]:
    if isinstance(method, str | os.PathLike):
        return os.fspath(method)
    if isinstance(method, Method):
        with suppress(InputError):  # a name that was given to a table
            if recipe.load_method(method.name, method.preset or None).digest == method.digest:
                return method.name
    return _plain_table(method.table if isinstance(method, Method) else method)


def _plain_table(table: Mapping[str, Any]) -> dict[str, Any]:
    """A recipe's table as plain values, as TOML has them.

    Raises:
        InputError: TOML has no such values.
    """
    try:
        return plain(table)
    except ValueError as error:
        raise InputError(f"The table is no recipe: {error}.") from error
