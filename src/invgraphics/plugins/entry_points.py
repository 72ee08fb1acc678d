"""Parts of installed packages, declared as entry points."""

from __future__ import annotations

import sys
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from invgraphics.errors import did_you_mean
from invgraphics.plugins.registries import BY_CLASS, GROUP, REGISTRIES, is_built_in, leave_out, own


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


def foreign(registry: str) -> dict[str, EntryPoint]:
    """A registry's entry points by name; second names, of built-in parts or of one class, are left out, with a warning.

    A resolved recipe names each part by its class, so that a class has one name.
    """
    points: dict[str, EntryPoint] = {}
    for point in _entry_points(tuple(sys.path)):
        if point.group != f"{GROUP}{registry}":
            continue
        named = own(registry) | {name: other.value for name, other in points.items()} if registry in BY_CLASS else {}
        twin = next((name for name, target in named.items() if target == point.value), None)
        if is_built_in(registry, point.name):
            leave_out(f"{_described(point)}: a built-in has this name.")
        elif twin is not None:
            leave_out(f"{_described(point)}: '{twin}' is the same.")
        else:
            points[point.name] = point
    return points


def package_of(point: EntryPoint) -> str:
    """Top-level package or module of an entry point."""
    return point.value.partition(":")[0].partition(".")[0]
