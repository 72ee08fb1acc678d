"""Names of methods in the literature, and suggestions made from them."""

from __future__ import annotations

import difflib
from collections.abc import Collection

from invgraphics.errors import did_you_mean

ALIASES = {
    "hash": "volumetric/hash",
    "hash-grid": "volumetric/hash",
    "instant-ngp": "volumetric/hash",
    "ingp": "volumetric/hash",
    "ngp": "volumetric/hash",
    "nerfacto": "volumetric/hash-proposal",
    "zip-nerf": "volumetric/hash-proposal",
    "vanilla-nerf": "volumetric/nerf",
    "mipnerf": "volumetric/mip-nerf",
    "mipnerf360": "volumetric/mip-nerf-360",
    "multi-nerf": "volumetric/mip-nerf-360",
    "tensorf": "volumetric/tensorf-vm",
    "plenoxel": "volumetric/plenoxels",
    "svox2": "volumetric/plenoxels",
    "direct-voxgo": "volumetric/dvgo",
    "eg3d": "volumetric/triplane",
    "k-planes": "volumetric/triplane",
    "3dgs": "splatting/gaussians",
    "3d-gaussians": "splatting/gaussians",
    "3d-gaussian-splatting": "splatting/gaussians",
    "gaussian-splatting": "splatting/gaussians",
    "gaussians": "splatting/gaussians",
    "gsplat": "splatting/gaussians",
    "gs": "splatting/gaussians",
    "splatfacto": "splatting/gaussians",
    "splatting": "splatting/gaussians",
    "splats": "splatting/gaussians",
    "3dgs-mcmc": "splatting/gaussians-mcmc",
    "mcmc": "splatting/gaussians-mcmc",
    "splatfacto-mcmc": "splatting/gaussians-mcmc",
    "absgs": "splatting/gaussians-absgrad",
    "mip-splatting": "splatting/gaussians-mip",
    "3dgrt": "gaussian-volume/sorted",
    "ever": "gaussian-volume/exact",
    "neus-facto": "hybrid/neus-hash",
    "neus2": "hybrid/neus-hash",
    "neuralangelo": "hybrid/neus-hash",
    "instant-nsr": "hybrid/neus-hash",
    "instant-nsr-pl": "hybrid/neus-hash",
    "idr": "sphere-tracing/mlp",
    "gnt": "learned/attention",
    "ibrnet": "learned/attention",
    "scene-representation-networks": "learned/srn",
    "multi-plane-image": "planes/mpi",
    "multiplane-image": "planes/mpi",
    "visual-hull": "surface/mesh",
    "nvdiffrast": "surface/mesh",
}
"""What papers and other programs call a method, or a recipe's bare name that several renderers have -> ours, or the nearest."""


def suggested_method(word: str, known: Collection[str]) -> str:
    """Suggest a method for an unknown name, as a question with a leading space; empty where none is close.

    A name of the field counts first, whatever stands before its last slash, however its words are joined; then a name that is
    close to one of our own, and last a misspelt name of the field.

    Args:
        word: as it was given.
        known: names of the methods.
    """
    bare = _joined(word.rpartition("/")[2])
    known_as = {_joined(name): method for name, method in ALIASES.items() if method in known}
    own = {_joined(name.rpartition("/")[2]) for name in known}
    if bare in known_as and ("/" not in word or bare not in own):
        return f" Did you mean '{known_as[bare]}'?"
    close = difflib.get_close_matches(bare, known_as, n=1, cutoff=0.7)
    return did_you_mean(word, known) or (f" Did you mean '{known_as[close[0]]}'?" if close else "")


def _joined(name: str) -> str:
    """A name in small letters without what joins its words: ``Instant_NGP`` and ``instant-ngp`` are one."""
    return name.lower().replace("-", "").replace("_", "").replace(" ", "")
