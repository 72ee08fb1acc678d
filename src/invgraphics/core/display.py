"""Pictures and facts as notebooks show them, without a library for pictures."""

from __future__ import annotations

import base64
import html
import struct
import zlib
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.colour import quantise

THUMBNAIL = 96
"""Height of a picture of a contact sheet, at most, px."""
ROW = 8
"""Pictures in a row of a contact sheet."""


def encode_png(colour: Float[Tensor, "h w 3"]) -> bytes:
    """Encode colours in [0, 1] as an 8-bit RGB file in the PNG format (ISO/IEC 15948); values outside are clipped."""
    pixels = quantise(colour.detach().cpu())
    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.numpy().tobytes() for row in pixels)  # each row begins with its filter: none
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits, RGB, no interlacing
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(map(_chunk, *zip(*chunks, strict=True)))


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def contact_sheet(pictures: Sequence[Float[Tensor, "h w 3"]]) -> Float[Tensor, "h w 3"]:
    """Thumbnails side by side on white, `ROW` in a row, by nearest pixels; pictures may differ in size."""
    small = [_thumbnail(picture) for picture in pictures]
    height, width = (max(picture.shape[side] for picture in small) + 2 for side in (0, 1))
    sheet = torch.ones(height * -(-len(small) // ROW), width * min(len(small), ROW), 3)
    for index, picture in enumerate(small):
        top, left = height * (index // ROW), width * (index % ROW)
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


def _thumbnail(picture: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    step = max(1, -(-picture.shape[0] // THUMBNAIL))
    return picture[step // 2 :: step, step // 2 :: step]


def figure_html(picture: Float[Tensor, "h w 3"], facts: Mapping[str, str]) -> str:
    """A picture above a table of facts."""
    source = base64.b64encode(encode_png(picture)).decode()
    rows = "".join(f"<tr><th>{html.escape(key)}</th><td>{html.escape(value)}</td></tr>" for key, value in facts.items())
    return f'<img src="data:image/png;base64,{source}"/><table>{rows}</table>'
