"""Registries: literal dictionaries of ``"module:object"``, extended by entry points.

Nothing heavy is imported to *list* what there is; an object is imported when it is used.
A third-party package joins by declaring an entry point in the group ``invgraphics.<registry>``,
for instance ``[project.entry-points."invgraphics.fields"] mine = "my_package:MyFieldConfig"``.
A built-in part keeps its name: an entry point of the same name is left out, with a warning.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, PackageNotFoundError, distribution, entry_points
from pathlib import Path
from typing import Any

from invgraphics.data import find
from invgraphics.errors import InputError, did_you_mean

REGISTRIES = {
    "fields": ("invgraphics.fields", "FIELDS"),
    "encodings": ("invgraphics.fields.encodings", "ENCODINGS"),
    "renderers": ("invgraphics.renderers", "RENDERERS"),
    "samplers": ("invgraphics.renderers", "SAMPLERS"),
    "losses": ("invgraphics.training", "LOSSES"),
    "penalties": ("invgraphics.training", "PENALTIES"),
    "hooks": ("invgraphics.training", "HOOKS"),
    "scenes": ("invgraphics.scenes", "LOADERS"),
    "metrics": ("invgraphics.metrics", "METRICS"),
    "formats": ("invgraphics.formats", "FORMATS"),
    "exporters": ("invgraphics.tools", "EXPORTERS"),
    "recipes": ("invgraphics.recipes", "RECIPES"),
    "executors": ("invgraphics.experiments.executors", "EXECUTORS"),
}
"""Registry name -> (module, dictionary). ``recipes`` starts empty: built-in recipes are TOML files."""
GROUP = "invgraphics."
"""How the groups of entry points begin."""
BY_CLASS = ("fields", "encodings", "renderers", "samplers", "losses", "penalties", "hooks")
"""Registries whose parts `name_of` finds by their class."""


@cache
def _own(registry: str) -> dict[str, str]:
    module, name = REGISTRIES[registry]
    return dict(getattr(importlib.import_module(module), name))


@cache
def _entry_points(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Entry points of this package's groups found on ``path``, cached because scanning installed packages is slow."""
    known = entry_points()
    groups = sorted(group for group in known.groups if group.startswith(GROUP))
    found = [point for group in groups for point in known.select(group=group)]
    for point in found:
        group = point.group.removeprefix(GROUP)
        if group not in REGISTRIES:
            leave_out(f"{_described(point)}: there is no group '{point.group}'.{did_you_mean(group, REGISTRIES)}")
    return tuple(found)


def _described(point: EntryPoint) -> str:
    """An entry point with its target and its package."""
    package = point.dist.name if point.dist is not None else "unknown package"
    return f"'{point.name}' of the {point.group.removeprefix(GROUP)} ({point.value}, {package})"


def _foreign(registry: str) -> dict[str, EntryPoint]:
    """A registry's entry points by name; second names, of built-in parts or of one class, are left out, with a warning.

    A resolved recipe names each part by its class, so that a class has one name.
    """
    points: dict[str, EntryPoint] = {}
    for point in _entry_points(tuple(sys.path)):
        if point.group != f"{GROUP}{registry}":
            continue
        named = _own(registry) | {name: other.value for name, other in points.items()} if registry in BY_CLASS else {}
        twin = next((name for name, target in named.items() if target == point.value), None)
        if _is_built_in(registry, point.name):
            leave_out(f"{_described(point)}: a built-in has this name.")
        elif twin is not None:
            leave_out(f"{_described(point)}: '{twin}' is the same.")
        else:
            points[point.name] = point
    return points


def _is_built_in(registry: str, name: str) -> bool:
    return name in _own(registry) or (registry == "recipes" and (find("renderers") / f"{name}.toml").is_file())


def names(registry: str) -> dict[str, str]:
    """List a registry's entries, name -> ``"module:object"``, built-in ones first; imports no implementation."""
    return _own(registry) | {name: point.value for name, point in _foreign(registry).items()}


def origin(registry: str, name: str) -> str:
    """Distribution that provides ``name``, or ``"built in"``."""
    if _is_built_in(registry, name):
        return "built in"
    point = _foreign(registry).get(name)
    return point.dist.name if point is not None and point.dist is not None else "unknown package"


def used_plugins(table: Mapping[str, Any], method: str = "") -> dict[str, str]:
    """Map the plug-ins among a recipe's ``type`` entries, and the recipe itself, to distribution and version.

    Args:
        table: a resolved recipe.
        method: its name.
    """
    return {name: f"{point.dist.name} {point.dist.version}" for name, point in _used(table, method) if point.dist is not None}


def plugin_sources(table: Mapping[str, Any], method: str = "") -> dict[str, str]:
    """Map the same plug-ins to a hash of the Python files of the packages that hold them, without importing any."""
    tops = {name: _package(point) for name, point in _used(table, method)}
    hashes = {top: _source_hash(top) for top in set(tops.values())}
    return {name: hashes[top] for name, top in tops.items()}


def _package(point: EntryPoint) -> str:
    """Top-level package or module of an entry point."""
    return point.value.partition(":")[0].partition(".")[0]


def _source_hash(package: str) -> str:
    """Hash of all Python files of a package or module; empty where it is not found."""
    spec, sha = importlib.util.find_spec(package), hashlib.sha256()
    if spec is None:
        return ""
    roots = [Path(root) for root in spec.submodule_search_locations or ()]
    files = [(path.relative_to(root), path) for root in roots for path in sorted(root.rglob("*.py"))]
    if not files and spec.origin is not None and Path(spec.origin).is_file():
        files = [(Path(package), Path(spec.origin))]
    for name, path in files:
        sha.update(name.as_posix().encode() + path.read_bytes())
    return sha.hexdigest()


def raised_in(error: BaseException) -> str:
    """The third-party function in which an error was raised, and its distribution; empty where no frame is of a plug-in."""
    points = [point for registry in REGISTRIES for point in _foreign(registry).values()]
    packages = {_package(point): point.dist for point in points}
    found, trace = "", error.__traceback__
    while trace is not None:
        module = str(trace.tb_frame.f_globals.get("__name__", ""))
        if (top := module.partition(".")[0]) in packages:
            dist = packages[top]
            version = "" if dist is None else f" ({dist.name} {dist.version})"
            found = f"{module}.{trace.tb_frame.f_code.co_qualname}{version}"
        trace = trace.tb_next
    return found


def unexpected(error: BaseException) -> tuple[str, str]:
    """What an error is that no input should cause, and whose fault: of a plug-in where it was raised in one, or may be."""
    first = (str(error).splitlines() or [""])[0]
    if where := raised_in(error):
        fault = f"It was raised in {where}"
    else:
        fault = f"This is a fault of {' or '.join(['invgraphics', *_imported()])}, not of your input"
    return f"Unexpected {type(error).__name__}: {first}", fault


def _imported() -> list[str]:
    """Distributions of the plug-ins that this process has imported."""
    points = [point for registry in REGISTRIES for point in _foreign(registry).values()]
    used = [point.dist for point in points if point.dist is not None and _package(point) in sys.modules]
    return list(dict.fromkeys(f"{dist.name} {dist.version}" for dist in used))


def _used(table: Mapping[str, Any], method: str) -> list[tuple[str, EntryPoint]]:
    """Names and entry points of the plug-ins that a recipe names."""
    used = {method}
    waiting: list[Any] = [table]
    while waiting:
        part = waiting.pop()
        if isinstance(part, Mapping):
            used |= {part["type"]} if isinstance(part.get("type"), str) else set()
            waiting += part.values()
        elif isinstance(part, list | tuple):
            waiting += part
    points = [pair for registry in REGISTRIES for pair in _foreign(registry).items()]
    return [(name, point) for name, point in points if name in used]


def installed(package: str) -> bool:
    """Whether the distribution that `used_plugins` names as ``name version`` is installed, in any version."""
    try:
        distribution(package.partition(" ")[0])
    except PackageNotFoundError:
        return False
    return True


def load(registry: str, name: str) -> Any:
    """Import and return the object registered as ``name``.

    Raises:
        InputError: unknown name (the known ones are listed), or a plug-in that fails to import, however it fails.
    """
    target = names(registry).get(name)
    if target is None:
        known = ", ".join(sorted(names(registry))) or "none"
        raise InputError(
            f"There is no '{name}' among the {registry}.{did_you_mean(name, names(registry))}", f"Known {registry}: {known}."
        )
    module, _, attribute = target.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (Exception, SystemExit) as error:  # a third-party module may raise anything, or leave
        source = origin(registry, name)
        if source == "built in" and not isinstance(error, ImportError | AttributeError):
            raise
        cause = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".")
        raise InputError(f"'{name}' of the {registry} ({target}, {source}) cannot be imported: {cause}.") from error


def load_all(registry: str, known: Iterable[str] | None = None) -> Iterator[tuple[str, Any]]:
    """Import objects of a registry one by one, as (name, object); a third-party one that fails is left out with a warning.

    Args:
        registry: that holds them.
        known: their names; ``None`` for all.
    """
    for name in names(registry) if known is None else known:
        try:
            found = load(registry, name)
        except InputError as error:
            if name in _own(registry):
                raise
            leave_out(error.sentence)
        else:
            yield name, found


@cache
def leave_out(sentence: str) -> None:
    """Print once on stderr that a broken third-party part is left out, so that what does not need it goes on."""
    print(f"Left out: {sentence}", file=sys.stderr)


def name_of(registry: str, kind: type) -> str:
    """Registered name of the class ``kind`` (inverse of `load`)."""
    wanted = f"{kind.__module__}:{kind.__qualname__}"
    for name, target in names(registry).items():
        if target == wanted:
            return name
    for name, found in load_all(registry, _foreign(registry)):
        if found is kind:
            return name
    how = f'Declare an entry point in the group "{GROUP}{registry}", and install its package (docs/extending.md).'
    raise InputError(f"{wanted} is not registered among the {registry}.", how)
