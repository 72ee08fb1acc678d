"""Recipes: methods as data, and the table of field x renderer that they make."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

RECIPES: dict[str, str] = {}
"""Methods that plug-ins bring, name ``renderer/recipe`` -> object holding the recipe's TOML text; our own are files."""

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
