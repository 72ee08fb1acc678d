"""Recipes: methods as data, and the table of field x renderer that they make."""

RECIPES: dict[str, str] = {}
"""Methods that plug-ins bring, name ``renderer/recipe`` -> object holding the recipe's TOML text; our own are files."""
