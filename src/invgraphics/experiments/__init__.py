"""From a recipe to objects to a run folder, and from many runs to a comparison."""

RECIPES: dict[str, str] = {}
"""Methods that plug-ins bring, name ``renderer/recipe`` -> object holding the recipe's TOML text; our own are files."""

_GAUSSIANS = "invgraphics.experiments.export:export_gaussians"
EXPORTERS = {
    "ply": _GAUSSIANS,
    "splat": _GAUSSIANS,
    "spz": _GAUSSIANS,
    "mesh": "invgraphics.experiments.mesh_export:export_mesh",
}
"""What a run's model can be exported to, and the function that does it (see `invgraphics.experiments.export`)."""
