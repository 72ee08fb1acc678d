"""Third-party parts that a recipe uses: their packages, and hashes of their sources."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import sys
import uuid
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import EntryPoint, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from invgraphics.plugins.entry_points import foreign, package_of
from invgraphics.plugins.registered import Registered, names_in, of_module, registered
from invgraphics.plugins.registries import REGISTRIES

_UNIQUE = uuid.uuid4().hex
"""Stands for sources that cannot be read, as of a console: another process may have others."""


def used_plugins(table: Mapping[str, Any], method: str = "") -> dict[str, str]:
    """Map the plug-ins among a recipe's ``type`` entries, and the recipe itself, to distribution and version.

    Args:
        table: a resolved recipe.
        method: its name.
    """
    used = {name: f"{point.dist.name} {point.dist.version}" for name, point in _used(table, method) if point.dist is not None}
    return used | {name: of_module(one) for name, one in _used_registered(table, method)}


def plugin_sources(table: Mapping[str, Any], method: str = "") -> dict[str, str]:
    """Map the same plug-ins to a hash of the Python files of the packages that hold them, without importing any."""
    tops = {name: package_of(point) for name, point in _used(table, method)}
    hashes = {top: _source_hash(top) for top in set(tops.values())}
    registered = {name: _module_hash(one) for name, one in _used_registered(table, method)}
    return {name: hashes[top] for name, top in tops.items()} | registered


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


def _module_hash(one: Registered) -> str:
    """Hash of the file of a registered part's module, or of the part's own source in a notebook."""
    file = getattr(sys.modules.get(one.module), "__file__", None)
    if file is not None and Path(file).is_file():
        return hashlib.sha256(Path(file).read_bytes()).hexdigest()
    source = _UNIQUE
    with suppress(OSError, TypeError):
        source = one.part if isinstance(one.part, str) else inspect.getsource(one.part)
    return hashlib.sha256(source.encode()).hexdigest()


def packages() -> dict[str, str]:
    """Map the top-level packages of all third-party parts to their distributions and versions; to "" where there is none."""
    points = [point for registry in REGISTRIES for point in foreign(registry).values()]
    known = {package_of(point): "" if point.dist is None else f"{point.dist.name} {point.dist.version}" for point in points}
    return known | {one.module.partition(".")[0]: "" for one in registered().values()}


def _used(table: Mapping[str, Any], method: str) -> list[tuple[str, EntryPoint]]:
    """Names and entry points of the plug-ins that a recipe names."""
    used = names_in(table, method)
    points = [pair for registry in REGISTRIES for pair in foreign(registry).items()]
    return [(name, point) for name, point in points if name in used]


def _used_registered(table: Mapping[str, Any], method: str) -> list[tuple[str, Registered]]:
    """Names of the registered parts that a recipe names, with the parts."""
    used = names_in(table, method)
    return [(name, one) for (_, name), one in registered().items() if name in used]


def installed(package: str) -> bool:
    """Whether what `used_plugins` names is here: a distribution, ``name version``, in any version; or a registered module."""
    if package in map(of_module, registered().values()):
        return True
    try:
        distribution(package.partition(" ")[0])
    except PackageNotFoundError:
        return False
    return True
