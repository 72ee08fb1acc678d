"""Rows of a lattice that points read, for gradients of these alone: a dense one of a large grid is mostly zeros to clear."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from invgraphics.core.lattice import Lattice
from invgraphics.kernels.numba.lattice.cells import BLOCK, CORNERS, locate_block, records
from invgraphics.kernels.numba.runtime import index, scratch, serial

_WORD = 64
"""Vertices whose marks are one word."""
_BYTE = 8


@serial
def mark_vertices(positions, lattices, marks):
    """Set the bits of all vertices around the points of one dense lattice; ``marks`` are bytes, zero before."""
    entries, weights = np.empty(CORNERS * BLOCK, np.uint32), np.empty(CORNERS * BLOCK, np.float32)
    lattice, points = lattices[0], positions.shape[1]
    for first in range(0, points, BLOCK):
        count = min(BLOCK, points - first)
        locate_block(positions, (index(first), count), lattice, entries, weights)
        for corner in range(lattice.corners):
            for number in range(count):
                vertex = entries[index(corner * BLOCK) + index(number)]
                marks[index(vertex >> np.uint32(3))] |= np.uint8(1 << (vertex & np.uint32(7)))


@serial
def number_rows(words, marks, links, most, slots, rows):
    """Number the rows of marked vertices in the order of memory.

    Args:
        words: ``marks``, eight bytes each.
        marks: of `mark_vertices`.
        links: row of each vertex; empty where it is the vertex itself.
        most: number of rows; links beyond are none.
        slots: receives the number of each marked vertex, -1 where it has no row; others are not written.
        rows: receives the rows that are numbered.

    Returns:
        How many there are, and whether they increase strictly.
    """
    count, last, increasing = 0, np.int64(-1), True
    for word in range(len(words)):
        if words[index(word)] != 0:
            for byte in range(word * _BYTE, (word + 1) * _BYTE):
                mark = marks[index(byte)]
                for bit in range(_BYTE if mark != 0 else 0):
                    if (mark >> np.uint8(bit)) & np.uint8(1):
                        vertex = index(byte * _BYTE + bit)
                        row = np.int64(links[vertex]) if len(links) > 0 else np.int64(vertex)
                        slots[vertex] = -1
                        if 0 <= row < most:
                            slots[vertex], rows[index(count)] = count, row
                            increasing &= row > last
                            count, last = count + 1, row
    return count, increasing


def touched_rows(positions: np.ndarray, lattice: Lattice, name: str) -> tuple[Lattice, Int[Tensor, " k"], bool]:
    """Find the rows of a lattice that points read.

    Args:
        positions: of the points in the unit cube, (3, m).
        lattice: contiguous.
        name: of the scratch memory: lattices whose results are used together need different ones.

    Returns:
        A lattice of these rows alone, linked, whose features are not initialised; the rows in the order of its own; and whether
        they increase strictly, which rows of several vertices do not.
    """
    vertices = math.prod(lattice.resolution)
    words = np.zeros(-(-vertices // _WORD), np.uint64)
    table = records([lattice], "concat")
    table["links"] = 0
    mark_vertices(positions, table, words.view(np.uint8))
    links = np.empty(0, np.int32) if lattice.links is None else lattice.links.numpy().reshape(-1)
    slots = scratch(name, vertices, np.int32)
    rows = np.empty(min(2 ** len(lattice.axes) * positions.shape[1], vertices), np.int64)
    count, increasing = number_rows(words, words.view(np.uint8), links, len(lattice.rows), slots, rows)
    compact = replace(
        lattice,
        features=lattice.features.new_empty(count, lattice.channels),
        links=torch.from_numpy(slots).reshape(lattice.resolution),
    )
    return compact, torch.from_numpy(rows[:count]), bool(increasing)


def sparse_rows(lattice: Lattice, rows: Int[Tensor, " k"], values: Tensor, unique: bool) -> Tensor:
    """Sparse tensor of the shape of a lattice's features that holds these rows, and is 0 elsewhere."""
    shape = lattice.features.shape
    # NumPy's, as torch's takes ten times as long.
    indices = torch.from_numpy(np.stack(np.unravel_index(rows.numpy(), shape[:-1])))
    return torch.sparse_coo_tensor(indices, values, shape, is_coalesced=unique, check_invariants=False)
