"""The one way to open a scene: a built-in scene's name, or a path to a data set in any known format."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol
from weakref import WeakKeyDictionary

from invgraphics import plugins
from invgraphics.core import Scene
from invgraphics.data import has_method
from invgraphics.errors import InputError, did_you_mean
from invgraphics.scenes.layout import SceneOptions, evenly
from invgraphics.scenes.pictures.images import image_files
from invgraphics.scenes.validation import validate

DATA = "INVGRAPHICS_DATA"
"""Environment variable: the folder of real data sets that recipes and studies name."""

__all__ = [
    "Loader",
    "SceneOptions",
    "SceneSource",
    "find_loader",
    "is_rendered",
    "missing_data_reason",
    "open_scene",
    "selection_notes",
    "source_of",
    "space_note",
    "validate",
]


class Loader(Protocol):
    """Interface of a loader: recognises and reads one format of data sets."""

    def matches(self, path: Path) -> bool:
        """Whether ``path`` is in this format."""
        ...

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Load the data set; bad input raises `InputError`."""
        ...


@dataclass(frozen=True)
class SceneSource:
    """Arguments with which a scene was opened, so that another process can open the same.

    Attributes:
        spec: a built-in scene's name or the path of a data set.
        options: with which it was opened.
    """

    spec: str
    options: SceneOptions


_SOURCES: WeakKeyDictionary[Scene, SceneSource] = WeakKeyDictionary()


def source_of(scene: Scene) -> SceneSource | None:
    """Arguments with which a scene was opened; ``None`` for scenes made or changed in Python."""
    return _SOURCES.get(scene)


def open_scene(
    spec: str, options: SceneOptions | None = None, progress: Callable[[int, int, str], None] | None = None
) -> Scene:
    """Open a built-in scene or a data set, and validate it.

    Args:
        spec: a built-in scene's name, which is rendered first unless its truth is in the cache, at this size or at a larger
            one to average; the path of one's own ``scene.toml``; or the path of a data set, which may begin with a variable:
            ``$INVGRAPHICS_DATA/fox``.
        options: size, number of views, samples per pixel.
        progress: called while a scene is rendered with (views done, views in all, what is being done).

    Raises:
        InputError: nothing is known by this name, no format fits, or the data cannot be used.
    """
    options = options or SceneOptions()
    scene = validate(_load(spec, options, progress))
    if words := _bounds_words(scene):
        scene = replace(scene, notes=scene.notes | {"bounds": words})
    _SOURCES[scene] = SceneSource(spec, options)
    return scene


def _load(spec: str, options: SceneOptions, progress: Callable[[int, int, str], None] | None) -> Scene:
    description = _description(spec)
    if description is not None:
        path = _render(description, options, progress)
        return plugins.load("scenes", "truth")().load(path, options)
    path = _path(spec)
    if not path.exists():
        if reason := missing_data_reason(spec):
            folder = _path(spec).parent
            there = sorted(each.name for each in folder.iterdir()) if folder.is_dir() else []
            remedy = f"It holds {', '.join(there[:20])}." if there else "Set the variable to the folder that holds it."
            raise InputError(f"'{spec}' cannot be opened: {reason}.", remedy)
        raise InputError(
            f"'{spec}' is neither a built-in scene nor an existing path.{_guess(spec)}",
            f"Built-in scenes: {', '.join(_built_in())}. Real captures: '${DATA}/NAME' (docs/files.md, Real data).",
        )
    if options.spp is not None:
        raise InputError(f"{path} holds pictures, whose samples per pixel are what they are.", "Leave out --spp.")
    return _loaded(find_loader(path), path, options)


def _guess(spec: str) -> str:
    """What a name that is no scene's may mean, as a sentence after a space; empty where nothing is like it."""
    if has_method(spec):
        return f" '{spec}' is a method; the order is `fit METHOD SCENE`, `compare SCENE --methods A,B`."
    if os.environ.get(DATA) and len(spec) > 2 and "/" not in spec:
        captures = sorted(path.name for path in Path(os.environ[DATA]).glob(f"*{glob.escape(spec)}*"))
        if captures:
            return f" Did you mean '${DATA}/{spec if spec in captures else captures[0]}'?"
    return did_you_mean(spec, _built_in())


def find_loader(path: Path) -> Loader:
    """Find the first loader that matches ``path``, in the registry's order.

    Raises:
        InputError: none fits; the sentence says what was looked for.
    """
    for name, kind in plugins.load_all("scenes"):
        loader: Loader = kind()
        if _matches(loader, name, path):
            return loader
    if image_files(path):
        raise InputError(
            f"{path} holds photographs without poses.", f"Run `invgraphics import-photos {path} --out SCENE`, then give SCENE."
        )
    what = "is an empty folder" if path.is_dir() and not any(path.iterdir()) else "is not a data set of a known format"
    raise InputError(
        f"{path} {what}.",
        "Looked for truth.json, transforms_train.json, transforms.json, poses_bounds.npy, sparse/0/cameras.bin, cameras*.npz "
        f"and .npz (formats: {', '.join(plugins.names('scenes'))}).",
    )


def _matches(loader: Loader, name: str, path: Path) -> bool:
    """Whether a loader recognises a path; a third-party one that fails at it is left out, with a warning."""
    try:
        return loader.matches(path)
    except Exception as error:  # it may raise anything, and another format may be the right one
        if (source := plugins.origin("scenes", name)) == "built in":
            raise
        plugins.leave_out(f"'{name}' of the scenes ({source}) cannot tell whether it knows {path}: {error!r}.")
        return False


def _loaded(loader: Loader, path: Path, options: SceneOptions) -> Scene:
    """Load a data set; of a third-party loader, check what it returns, and choose the test views if it has not.

    Raises:
        InputError: the loader returned no scene, or pictures of another size than was asked for.
    """
    if type(loader).__module__.partition(".")[0] == "invgraphics":
        return loader.load(path, options)
    scene: object = loader.load(path, options)
    who = f"{type(loader).__module__}.{type(loader).__name__}.load"
    if not isinstance(scene, Scene):
        raise InputError(f"{who} returned {type(scene).__name__}, no Scene.", "See docs/extending.md.")
    sizes = {(view.camera.width, view.camera.height) for view in (*scene.train, *scene.val, *scene.test)}
    if sizes and options.size is not None and options.size not in (max(map(max, sizes)), *sizes):
        found = ", ".join(f"{width}x{height}" for width, height in sorted(sizes)[:3])
        asked = options.size if isinstance(options.size, int) else "{}x{}".format(*options.size)
        raise InputError(f"{who} returned pictures of {found} pixels, though --size asks for {asked}.")
    return replace(scene, test=tuple(evenly(scene.test, options.test_views)))


def missing_data_reason(spec: str) -> str:
    """Reason why data behind an environment variable is absent here; empty where it exists, and for other paths."""
    variable, slash, name = spec.removeprefix("$").partition("/")
    if not spec.startswith("$") or not slash:
        return ""
    if not os.environ.get(variable):
        return f"{variable} is not set"
    return "" if _path(spec).exists() else f"{name} is not in ${variable}"


def _path(spec: str) -> Path:
    """Expand environment variables and ``~`` in a path."""
    return Path(os.path.expandvars(spec)).expanduser()


def is_rendered(spec: str) -> bool:
    """Whether a scene is rendered here (built in, or a ``scene.toml``), so that its samples per pixel can be chosen."""
    return _description(spec) is not None


def longest_edge(spec: str, size: int | Sequence[int] | None) -> int | None:
    """Longest edge in pixels of a scene's pictures; ``None`` where it is known only once the scene is loaded.

    Args:
        spec: the scene's name or path.
        size: as requested; ``None`` where it was not.
    """
    from invgraphics.scenes.mitsuba.spec import description_path, read

    if size is None:
        try:
            size = read(description_path(spec)).size
        except InputError:
            return None
    return size if isinstance(size, int) else max(size)


def selection_notes(scene: Scene) -> str:
    """Format the scene's notes on the chosen model and on missing photographs, a line each; mostly empty."""
    return "".join(f"\n  {key}: {scene.notes[key]}" for key in ("model", "missing") if key in scene.notes)


def space_note(scene: Scene) -> str:
    """Describe the bounds that were chosen for a scene without end, on a line; empty for a scene in a box."""
    words = _bounds_words(scene)
    return f"\n  space: {words}" if words else ""


def _bounds_words(scene: Scene) -> str:
    """Describe the bounds of a scene without end and what they were chosen from; empty for a scene in a box."""
    if scene.bounds.space == "box":
        return ""
    half, near = float(scene.bounds.half.max()), scene.bounds.near
    source = f"three quarters of {len(scene.points):,} known points" if scene.points else "the cameras: no points are known"
    return (
        f"endless, contracted around a box of half-edge {half:.2g} (from {source}); no sample nearer than {near:.2g}"
        " to a camera, where the farthest camera is at 1"
    )


def _built_in() -> tuple[str, ...]:
    from invgraphics.scenes.mitsuba import spec

    return spec.names()


def _description(spec: str) -> str | None:
    """Name for `make`: a built-in scene or the path of a ``scene.toml``; ``None`` for a data set."""
    from invgraphics.scenes.mitsuba.spec import FILE

    path = _path(spec)
    if spec in _built_in():
        return spec
    own = path if path.name == FILE else path / FILE
    return str(own) if own.is_file() else None


def _render(description: str, options: SceneOptions, progress: Callable[[int, int, str], None] | None) -> Path:
    from invgraphics.scenes.mitsuba import make
    from invgraphics.scenes.mitsuba.maker import cached_with_more_tests
    from invgraphics.scenes.mitsuba.spec import description_path, read

    size, spec = options.size, read(description_path(description))
    if isinstance(size, int):
        width, height = spec.size
        size = (round(size * width / max(width, height)), round(size * height / max(width, height)))
    # Of a class, every instance has its own number of views.
    train, test = (None, None) if spec.instances else (options.train_views, options.test_views)
    made = cached_with_more_tests(description, size, (train, test), options.spp, options.seed)
    if made is not None:
        return made
    return make(description, size=size, train=train, test=test, spp=options.spp, seed=options.seed, progress=progress)


def is_found(spec: str) -> bool:
    """Whether a scene is a built-in one or a path that exists from here; also where a variable says where it is."""
    return spec.startswith("$") or _description(spec) is not None or _path(spec).exists()
