"""Tools for finished runs: films, exports, camera localisation, pixel explanations, scores under other protocols."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

_GAUSSIANS = "invgraphics.tools.export:export_gaussians"
EXPORTERS = {
    "ply": _GAUSSIANS,
    "splat": _GAUSSIANS,
    "spz": _GAUSSIANS,
    "mesh": "invgraphics.tools.mesh:export_mesh",
    "mpi": "invgraphics.tools.mpi:export_mpi",
}
"""What a run's model can be exported to, and the function that does it (see `invgraphics.tools.export`)."""
CONVERSION_SIZES = {
    "gaussians": (10_000, "Gaussians"),
    "lattice": (96, "vertices"),
    "mesh": (128, "voxels"),
    "points": (15_000, "points"),
}
"""Number of primitives, or of what lies along the longest edge, that conversions make by default, and what these are."""

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
