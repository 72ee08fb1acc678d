"""From a recipe to objects to a run folder, and from many runs to a comparison."""

RECIPES: dict[str, str] = {}
"""Methods that plug-ins bring, name ``renderer/recipe`` -> object holding the recipe's TOML text; our own are files."""
