"""Position to features (see `invgraphics.core.Encoding`); each entry is a frozen config with ``build()``."""

from typing import TYPE_CHECKING

from invgraphics.lazy import submodules

ENCODINGS = {
    "frequency": "invgraphics.fields.encodings.frequency:FrequencyConfig",
    "integrated": "invgraphics.fields.encodings.integrated:IntegratedConfig",
    "hash": "invgraphics.fields.encodings.hash:HashConfig",
    "voxels": "invgraphics.fields.encodings.voxels:VoxelsConfig",
    "sparse_voxels": "invgraphics.fields.encodings.sparse:SparseVoxelsConfig",
    "vm": "invgraphics.fields.encodings.factors:VmConfig",
    "cp": "invgraphics.fields.encodings.factors:CpConfig",
    "triplane": "invgraphics.fields.encodings.triplane:TriplaneConfig",
}

if not TYPE_CHECKING:
    __getattr__ = submodules(__name__)
