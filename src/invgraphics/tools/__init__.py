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

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
