"""Listing and loading of parts by name, wherever they come from."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from typing import Any

from invgraphics.errors import InputError, did_you_mean
from invgraphics.plugins.entry_points import foreign
from invgraphics.plugins.registered import of_module, registered
from invgraphics.plugins.registries import is_built_in, leave_out, own


def names(registry: str) -> dict[str, str]:
    """List a registry's entries, name -> ``"module:object"``, built-in ones first; imports no implementation."""
    installed = {name: point.value for name, point in foreign(registry).items()}
    return own(registry) | installed | {name: one.target for (kind, name), one in registered().items() if kind == registry}


def origin(registry: str, name: str) -> str:
    """Distribution that provides ``name``, or ``"built in"``."""
    if is_built_in(registry, name):
        return "built in"
    if (registry, name) in registered():
        return of_module(registered()[registry, name])
    point = foreign(registry).get(name)
    return point.dist.name if point is not None and point.dist is not None else "unknown package"


def load(registry: str, name: str) -> Any:
    """Import and return the object registered as ``name``.

    Raises:
        InputError: unknown name (the known ones are listed), or a plug-in that fails to import, however it fails.
    """
    if (registry, name) in registered():
        return registered()[registry, name].part
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
            if name in own(registry):
                raise
            leave_out(error.sentence)
        else:
            yield name, found


def name_of(registry: str, kind: type) -> str:
    """Registered name of the class ``kind`` (inverse of `load`)."""
    for (group, name), one in registered().items():
        if group == registry and one.part is kind:
            return name
    wanted = f"{kind.__module__}:{kind.__qualname__}"
    for name, target in names(registry).items():
        if target == wanted:
            return name
    for name, found in load_all(registry, foreign(registry)):
        if found is kind:
            return name
    how = f'Decorate it with @ig.register("{registry}", NAME), or declare an entry point (docs/extending.md).'
    raise InputError(f"{wanted} is not registered among the {registry}.", how)
