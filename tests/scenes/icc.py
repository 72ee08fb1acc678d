"""ICC profiles made of primaries and a curve."""

import struct

import numpy as np


def matrix_profile(primaries: np.ndarray, description: bytes = b"wide", gamma: float | None = None) -> bytes:
    """An ICC profile (version 2.4) of these primaries, as columns in the D50 connection space, and sRGB's curve or a power."""

    def fixed(*values: float) -> bytes:
        return b"".join(struct.pack(">i", round(value * 65536)) for value in values)

    curve = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045) if gamma is None else (gamma, 1, 0, 0, 0)
    tags = [(b"desc", b"desc\0\0\0\0" + struct.pack(">I", len(description) + 1) + description + b"\0" * 79)]
    tags += [(b"wtpt", b"XYZ \0\0\0\0" + fixed(0.9642, 1, 0.8249))]
    tags += [(b"%cXYZ" % name, b"XYZ \0\0\0\0" + fixed(*primaries[:, index])) for index, name in enumerate(b"rgb")]
    tags += [(b"%cTRC" % name, b"para\0\0\0\0" + struct.pack(">HH", 3, 0) + fixed(*curve)) for name in b"rgb"]
    table, body, offset = b"", b"", 132 + 12 * len(tags)
    for name, data in tags:
        table += name + struct.pack(">II", offset + len(body), len(data))
        body += data + b"\0" * (-len(data) % 4)
    size = struct.pack(">I", offset + len(body))
    header = size + b"\0" * 4 + struct.pack(">I", 0x02400000) + b"mntrRGB XYZ " + b"\0" * 12 + b"acsp" + b"\0" * 28
    return header + fixed(0.9642, 1, 0.8249) + b"\0" * 48 + struct.pack(">I", len(tags)) + table + body


SRGB_D50 = np.array([[0.4360, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]])
P3_D50 = np.array([[0.5151, 0.2920, 0.1571], [0.2412, 0.6922, 0.0666], [-0.0011, 0.0419, 0.7841]])
