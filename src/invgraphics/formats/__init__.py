"""Files that hold 3D Gaussians: one module per format, each a frozen dataclass that reads, and writes where that is offered."""

FORMATS = {
    "compressed-ply": "invgraphics.formats.compressed_ply:CompressedPly",
    "ply": "invgraphics.formats.ply:Ply",
    "spz": "invgraphics.formats.spz:Spz",
    "splat": "invgraphics.formats.splat:Splat",
}
"""Formats in the order in which a file is tried: the most particular first."""
