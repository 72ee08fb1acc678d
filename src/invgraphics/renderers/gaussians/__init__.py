"""Gaussians along rays: integrals, volume rendering in order or as overlapping densities, and opaque ellipsoids."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
