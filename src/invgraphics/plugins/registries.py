"""The registries, their built-in parts, and a line for what is left out of them."""

from __future__ import annotations

import importlib
import sys
from functools import cache

from invgraphics.data import find

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
def own(registry: str) -> dict[str, str]:
    """Built-in parts of a registry, name -> ``"module:object"``."""
    module, name = REGISTRIES[registry]
    return dict(getattr(importlib.import_module(module), name))


def is_built_in(registry: str, name: str) -> bool:
    """Whether a name is that of a built-in part or recipe."""
    return name in own(registry) or (registry == "recipes" and (find("renderers") / f"{name}.toml").is_file())


@cache
def leave_out(sentence: str) -> None:
    """Print once on stderr that a broken third-party part is left out, so that what does not need it goes on."""
    print(f"Left out: {sentence}", file=sys.stderr)
