"""SPZ (Niantic): attributes as bytes, compressed. Read in versions 1 to 3 (gzip) and 4 (Zstandard), written in 3 and 4."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from invgraphics.core import harmonics
from invgraphics.errors import InputError
from invgraphics.formats.base import Splats, truncation_error
from invgraphics.formats.spz_attributes import Bytes, fraction_bits, pack, unpack, widths
from invgraphics.memory import check_fits, format_bytes

MAGIC, GZIP = b"NGSP", b"\x1f\x8b"
VERSION = 4
WRITTEN = (3, 4)
"""Versions that can be written: many viewers read up to 3 only."""
MAX_DEGREE = 4
HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, number of Gaussians, SH degree, fraction bits, flags, number of streams (version 4)."""
EXTENDED = struct.Struct("<I12x")
"""Version 4 goes on with the offset of the table of contents."""
STREAM = struct.Struct("<QQ")
"""Entry of the table of contents: compressed and uncompressed size."""
RECORD = struct.Struct("<II")
"""Head of an extension: type and length."""
ANTIALIASED, EXTENSIONS = 1, 2

AXES = "RUB"
"""Axes of files that do not say otherwise: +x right, +y up, +z back."""
AXES_EXTENSION = 0xADBE0003
AXES_CODES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU")
"""Values 1 to 16 of the extension SPZ_ADOBE_coordinate_system."""

UNSUSPICIOUS, MOST_PACKED = 64 << 20, 100
"""Bytes that any file may unpack to (a million Gaussians), and how many times its size a longer one; scenes reach about 4."""
MOST_EXTENSIONS = 1 << 20
"""Bytes of all extensions."""
COPIES = 3
"""Largest number of copies of all Gaussians in float32 while they are unpacked."""

LEVEL = 12
"""Zstandard's compression level, that of the format's authors."""


@dataclass(frozen=True)
class Header:
    """Header of an SPZ file."""

    version: int
    count: int
    degree: int
    fraction: int
    flags: int
    streams: int

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of each attribute of all Gaussians."""
        return {name: self.count * width for name, width in widths(self.version, self.degree).items()}

    def table(self, name: str, stream: bytes) -> Bytes:
        """One attribute, a row for each Gaussian."""
        return np.frombuffer(stream, np.uint8).reshape(self.count, widths(self.version, self.degree)[name])


@dataclass(frozen=True)
class Spz:
    """About a tenth of a PLY file's size, at some loss.

    Attributes:
        version: that is written, one of `WRITTEN`.
    """

    version: int = VERSION

    suffixes: ClassVar[tuple[str, ...]] = (".spz",)
    flags_antialiasing: ClassVar[bool] = True
    axes: ClassVar[str | None] = AXES

    def matches(self, path: Path, head: bytes) -> bool:
        """By its first bytes; gzip counts only under the right name."""
        return head.startswith(MAGIC) or (head.startswith(GZIP) and path.suffix.lower() in self.suffixes)

    def read(self, path: Path) -> Splats:
        """Read a file.

        Raises:
            InputError: it is cut off or damaged, or of an unknown version.
        """
        data = path.read_bytes()
        packed = len(data)
        if data.startswith(GZIP):
            data = _gunzip(path, data)
        header = _header(path, data)
        _bounded(path, header, packed)
        attributes, extensions = (_streams if header.version >= VERSION else _single_stream)(path, data, header)
        notes = [f"SPZ version {header.version}."]
        if header.degree > harmonics.MAX_DEGREE:
            notes.append(f"SH degree {header.degree}; the bands above {harmonics.MAX_DEGREE} were left out.")
        gaussians = unpack(attributes, header.version, header.fraction)
        axes = _axes(path, extensions) if header.flags & EXTENSIONS else AXES
        return Splats(gaussians, axes, bool(header.flags & ANTIALIASED), tuple(notes))

    def write(self, path: Path, splats: Splats) -> None:
        """Write version 4 or, compressed by gzip, 3; ``splats`` are in the axes RUB.

        Raises:
            InputError: a Gaussian is too far from the origin.
        """
        import pyarrow

        gaussians = splats.gaussians
        fraction = fraction_bits(gaussians.means)
        streams = [values.tobytes() for values in pack(gaussians, fraction).values() if values.size]
        flags = ANTIALIASED if splats.antialiased else 0
        degree = harmonics.degree_of(gaussians.sh.shape[1])
        if self.version < VERSION:
            head = HEADER.pack(MAGIC, self.version, len(gaussians), degree, fraction, flags, 0)
            path.write_bytes(gzip.compress(b"".join([head, *streams]), mtime=0))
            return
        codec = pyarrow.Codec("zstd", compression_level=LEVEL)
        packed = [codec.compress(stream, asbytes=True) for stream in streams]
        head = HEADER.pack(MAGIC, VERSION, len(gaussians), degree, fraction, flags, len(streams))
        contents = [STREAM.pack(len(small), len(large)) for small, large in zip(packed, streams, strict=True)]
        path.write_bytes(b"".join([head, EXTENDED.pack(HEADER.size + EXTENDED.size), *contents, *packed]))


def _gunzip(path: Path, data: bytes) -> bytes:
    """The content of versions 1 to 3, at most as long as its header honestly claims."""
    inflate = zlib.decompressobj(wbits=31)
    try:
        head = inflate.decompress(data, HEADER.size)
        most = _bounded(path, _header(path, head), len(data)) + MOST_EXTENSIONS
        result = head + inflate.decompress(inflate.unconsumed_tail, most)
    except zlib.error as error:
        raise InputError(f"'{path}' cannot be decompressed: {error}.", "Copy the file again.") from error
    if not inflate.eof:
        longer = len(result) == HEADER.size + most
        wrong = (
            f"it continues after its Gaussians and {format_bytes(MOST_EXTENSIONS)} of extensions" if longer else "it is cut off"
        )
        raise InputError(f"'{path}' cannot be decompressed: {wrong}.", "Copy the file again.")
    return result


def _bounded(path: Path, header: Header, packed: int) -> int:
    """Bytes of all attributes of a file of ``packed`` bytes.

    Raises:
        InputError: they are more than such a file honestly holds, or than there is memory for.
    """
    claimed = sum(header.sizes.values())
    if claimed > max(UNSUSPICIOUS, MOST_PACKED * packed):
        raise InputError(
            f"'{path}' claims {header.count:,} Gaussians in {packed:,} bytes, more than {MOST_PACKED} times as many unpacked.",
            "The file is damaged, or made to fill the memory.",
        )
    floats = header.count * 4 * (11 + 3 * harmonics.count(header.degree))
    check_fits(claimed + COPIES * floats, f"'{path}', with {header.count:,} Gaussians,", "Use a machine with more memory.")
    return claimed


def _header(path: Path, data: bytes) -> Header:
    if len(data) < HEADER.size:
        raise truncation_error(path, HEADER.size, len(data))
    magic, version, count, degree, fraction, flags, streams = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise InputError(f"'{path}' is no SPZ file: it begins with {magic!r}, not {MAGIC!r}.")
    if not 1 <= version <= VERSION:
        raise InputError(f"'{path}' is SPZ of version {version}; versions 1 to {VERSION} are known.")
    if degree > MAX_DEGREE or fraction > 31:
        raise InputError(f"'{path}' is a damaged SPZ file: SH degree {degree}, {fraction} fraction bits.")
    return Header(version, count, degree, fraction, flags, streams)


def _single_stream(path: Path, data: bytes, header: Header) -> tuple[dict[str, Bytes], bytes]:
    """Attributes one after the other, then extensions: versions 1 to 3."""
    attributes, start = {}, HEADER.size
    expected = start + sum(header.sizes.values())
    if expected > len(data):
        raise truncation_error(path, expected, len(data))
    for name, size in header.sizes.items():
        attributes[name] = header.table(name, data[start : start + size])
        start += size
    return attributes, data[start:]


def _streams(path: Path, data: bytes, header: Header) -> tuple[dict[str, Bytes], bytes]:
    """Extensions, a table of contents, then one compressed stream for each attribute that is not empty: version 4."""
    first = HEADER.size + EXTENDED.size
    contents = EXTENDED.unpack_from(data, HEADER.size)[0] if len(data) >= first else first
    start = contents + STREAM.size * header.streams
    if start > len(data):
        raise truncation_error(path, start, len(data))
    table = [STREAM.unpack_from(data, contents + STREAM.size * i) for i in range(header.streams)]
    present = [name for name, size in header.sizes.items() if size]
    if [large for _, large in table] != [header.sizes[name] for name in present] or contents < first:
        raise InputError(f"'{path}' is a damaged SPZ file: its streams do not hold {header.count} Gaussians.")
    expected = start + sum(small for small, _ in table)
    if expected > len(data):
        raise truncation_error(path, expected, len(data))
    streams = dict.fromkeys(header.sizes, b"")
    for name, (small, large) in zip(present, table, strict=True):
        streams[name] = _unzstd(path, data[start : start + small], large)
        start += small
    attributes = {name: header.table(name, stream) for name, stream in streams.items()}
    return attributes, data[first:contents]


def _unzstd(path: Path, data: bytes, size: int) -> bytes:
    import pyarrow

    try:
        result = pyarrow.Codec("zstd").decompress(data, size, asbytes=True)
    except (OSError, pyarrow.ArrowException) as error:
        raise InputError(f"'{path}' cannot be decompressed: {error}.", "Copy the file again.") from error
    if len(result) != size:
        raise InputError(f"'{path}' is a damaged SPZ file: a stream has {len(result)} bytes instead of {size}.")
    return result


def _axes(path: Path, extensions: bytes) -> str:
    """The axes that an extension names; extensions that are not known are skipped, as the format requires."""
    for kind, payload in _records(path, extensions):
        code = int.from_bytes(payload[:4], "little")
        if kind == AXES_EXTENSION and 1 <= code <= len(AXES_CODES):
            return AXES_CODES[code - 1]
    return AXES


def _records(path: Path, extensions: bytes) -> Iterator[tuple[int, bytes]]:
    start = 0
    while start + RECORD.size <= len(extensions):
        kind, length = RECORD.unpack_from(extensions, start)
        start += RECORD.size + length
        if start > len(extensions):
            raise InputError(f"'{path}' is a damaged SPZ file: an extension is longer than the file.")
        yield kind, extensions[start - length : start]
