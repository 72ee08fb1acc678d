"""Encoding, networks and colour of `POINTS` points of a field over lattices, inlined into the fused kernels.

Arrays are flat and feature-major, as in `ngp.network`: `POINTS` values of the first feature, then of the second.
"""

from __future__ import annotations

from dataclasses import replace
from math import factorial, pi

import numpy as np

from invgraphics.core.fused import CombinedLattices, FusedLattice, Layers
from invgraphics.kernels.numba.lattice.backward import list_points
from invgraphics.kernels.numba.lattice.cells import BLOCK, CORNERS, RECORD, locate_block, padded, records
from invgraphics.kernels.numba.lattice.rows import interpolate_block
from invgraphics.kernels.numba.ngp.dense import POINTS, dense
from invgraphics.kernels.numba.ngp.network import pack_network, sigmoid, softplus
from invgraphics.kernels.numba.runtime import GROUP, index, inlined
from invgraphics.kernels.numba.simd.layouts import transpose
from invgraphics.kernels.numba.simd.partial import floats_at, unsigned_at

KINDS, DIRECTIONS, COLOURS = ("mlp", "sh", "none"), ("none", "sh", "frequency"), ("sigmoid", "softplus", "clamp")
"""Kinds of heads, encodings of directions and activations of colour, by the index that is passed to kernels."""
_MLP, _SH = 0, 1
FREQUENCY = 2
_SIGMOID, _SOFTPLUS = 0, 1

_WORD = 4
"""Bytes of all numbers in scratch."""
_ZERO, _QUARTER, _HALF, _ONE = (np.float32(value) for value in (0.0, 0.25, 0.5, 1.0))
_TURN = np.float32(1 / (2 * pi))
# sin(2 pi t) = t (S0 + S1 t² + ...), to 1e-7 for t in [-1/4, 1/4].
_S0, _S1, _S2, _S3, _S4, _S5, _S6 = (np.float32((-1) ** k * (2 * pi) ** (2 * k + 1) / factorial(2 * k + 1)) for k in range(7))


@inlined
def sine_of_turns(turns):
    """sin(2 pi ``turns``); polynomial, because LLVM vectorises no library call."""
    t = turns - np.floor(turns + _HALF)
    # Beyond a quarter of a turn it falls as it rose.
    t = _HALF - t if t > _QUARTER else (-_HALF - t if t < -_QUARTER else t)
    s = t * t
    return t * (_S0 + s * (_S1 + s * (_S2 + s * (_S3 + s * (_S4 + s * (_S5 + s * _S6))))))


def points_words(encoding: tuple[np.ndarray, int, np.float32]) -> int:
    """Words of scratch that `points_scratch` takes."""
    return (2 * CORNERS + 1) * BLOCK + encoding[1] * int(POINTS)


@inlined
def points_scratch(memory, encoding):
    """Scratch of `encode_points` at an address: corners, their weights, a list of points, and features point by point."""
    corners = CORNERS * BLOCK
    weights, chosen = memory + _WORD * corners, memory + 2 * _WORD * corners
    rows = floats_at(chosen + _WORD * BLOCK, encoding[1] * np.int64(POINTS))
    return unsigned_at(memory, corners), floats_at(weights, corners), unsigned_at(chosen, BLOCK), rows


@inlined
def encode_points(points, encoding, scratch, out):
    """Combined features of `POINTS` positions; ``encoding`` is what `pack_encoding` returns, ``points`` is (3, POINTS)."""
    lattices, row, scale = encoding
    entries, weights, chosen, rows = scratch
    stride, count = index(row), np.int64(POINTS)
    some = chosen, list_points(count, chosen)
    for number in range(len(lattices)):
        lattice = lattices[number]
        locate_block(points, (index(0), count), lattice, entries, weights)
        interpolate_block(lattice, entries, weights, some, lattice.mode, rows, index(lattice.column), stride)
    for first in range(0, count, GROUP):
        for k in range(0, row, GROUP):
            transpose(rows, index(first) * stride + index(k), stride, out, index(k) * POINTS + index(first), POINTS)
    if scale != _ONE:
        for number in range(row * count):
            out[index(number)] *= scale


@inlined
def apply_network(network, smooth, x, ping, pong):
    """`ngp.network.mlp`, for hidden layers with ReLU or, if ``smooth``, softplus; ``x`` itself if there are no layers."""
    layers, sizes = network
    at, last, source, target = index(0), len(sizes) - 1, x, ping
    for number in range(len(sizes)):
        size = index(sizes[number, 0]), index(sizes[number, 1])
        dense(layers, at, source, target, size, number < last and not smooth)
        if smooth and number < last:
            for value in range(sizes[number, 1] * np.int64(POINTS)):
                target[index(value)] = softplus(target[index(value)])
        at += (size[0] + index(1)) * size[1]
        source, target = target, pong if number % 2 == 0 else ping
    return source


@inlined
def append_octaves(x, first, count, octaves, cycles, by_feature, to):
    """Sines and then cosines of ``count`` features.

    Args:
        x: inputs of the colour network.
        first: row of the first feature.
        count: number of features.
        octaves: number of frequencies, each twice the one before.
        cycles: the lowest of them, in turns per unit.
        by_feature: whether a feature's octaves lie side by side, or all features of an octave.
        to: row of the first sine.
    """
    for k in range(octaves):
        frequency = cycles * np.float32(1 << k)
        for feature in range(count):
            at = index(to + (feature * octaves + k if by_feature else k * count + feature)) * POINTS
            source, cosine = index(first + feature) * POINTS, at + index(count * octaves) * POINTS
            for p in range(POINTS):
                n = index(p)
                turns = x[source + n] * frequency
                x[at + n] = sine_of_turns(turns)
                x[cosine + n] = sine_of_turns(turns + _QUARTER)


@inlined
def activate_colour(raw, activation, padding):
    """Radiance of raw colour; ``activation`` is an index of `COLOURS`."""
    if activation == _SIGMOID:
        return sigmoid(raw) * (_ONE + padding + padding) - padding
    return softplus(raw) if activation == _SOFTPLUS else max(raw + _HALF, _ZERO)


@inlined
def colours(inputs, network, head, ping, pong):
    """Radiance of `POINTS` samples, in the first three rows of the result."""
    kind, smooth, features, octaves, direction, degree, activation, padding = head
    seen = features * (1 + 2 * octaves)
    raw = inputs
    if kind == _MLP:
        if octaves > 0:
            append_octaves(inputs, 0, features, octaves, _TURN, True, features)
        if direction == FREQUENCY:
            append_octaves(inputs, seen, 3, degree, _HALF, False, seen + 3)
        raw = apply_network(network, smooth, inputs, ping, pong)
    elif kind == _SH:
        raw, functions = ping, features // 3
        for channel in range(3):
            for p in range(POINTS):
                raw[index(channel) * POINTS + index(p)] = _ZERO
            for k in range(functions):
                of, seen_from = index(channel * functions + k) * POINTS, index(features + k) * POINTS
                for p in range(POINTS):
                    n = index(p)
                    raw[index(channel) * POINTS + n] += inputs[of + n] * inputs[seen_from + n]
    for number in range(3 * np.int64(POINTS)):
        raw[index(number)] = activate_colour(raw[index(number)], activation, padding)
    return raw


def contiguous(encoding: CombinedLattices | None) -> CombinedLattices | None:
    """The same lattices, detached, in contiguous memory; the caller keeps them while kernels run."""
    if encoding is None:
        return None
    lattices = [
        replace(x, features=x.features.detach().contiguous(), links=None if x.links is None else x.links.contiguous())
        for x in encoding.lattices
    ]
    return replace(encoding, lattices=tuple(lattices))


def pack_encoding(encoding: CombinedLattices | None) -> tuple[np.ndarray, int, np.float32]:
    """Lattices as kernels read them, features padded to whole registers, and their factor."""
    if encoding is None:
        return np.zeros(0, RECORD), GROUP, np.float32(1.0)
    return records(encoding.lattices, encoding.combine), padded(encoding.width), np.float32(encoding.scale)


def pack_layers(layers: Layers) -> tuple[np.ndarray, np.ndarray]:
    """`pack_network`, of no layers too."""
    return pack_network(layers) if layers else (np.zeros(1, np.float32), np.zeros((0, 2), np.int64))


def pack_head(field: FusedLattice) -> tuple[int, bool, int, int, int, int, int, np.float32]:
    """What `colours` needs to know besides the network."""
    head, features = field.colour, field.geometry_features + field.appearance_features
    sh = head.kind == "sh"
    return (
        KINDS.index(head.kind),
        field.hidden == "softplus",
        features,
        head.octaves if head.kind == "mlp" else 0,
        DIRECTIONS.index("sh" if sh else head.direction if head.kind == "mlp" else "none"),
        round((features / 3) ** 0.5) if sh else head.degree,
        COLOURS.index(head.activation),
        np.float32(head.padding),
    )


def direction_rows(head: tuple[int, bool, int, int, int, int, int, np.float32]) -> int:
    """Rows that the encoded direction takes."""
    degree = head[5]
    return (0, degree * degree, 3 * (1 + 2 * degree))[head[4]]
