"""Loaders and makers of `invgraphics.core.Scene`."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

LOADERS = {
    "truth": "invgraphics.scenes.truth:Truth",
    "blender": "invgraphics.scenes.blender:Blender",
    "nerfstudio": "invgraphics.scenes.nerfstudio:Nerfstudio",
    "llff": "invgraphics.scenes.llff:Llff",
    "colmap": "invgraphics.scenes.colmap:Colmap",
    "idr": "invgraphics.scenes.idr:Idr",
    "npz": "invgraphics.scenes.npz:Npz",
}
"""Formats of data sets on disk, in the order in which a folder is tried."""

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
