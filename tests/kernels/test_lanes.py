"""Registers as values, and their ways from and to memory, against NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

nb = pytest.importorskip("numba")

from invgraphics.kernels.numba.runtime import LANES, index  # noqa: E402
from invgraphics.kernels.numba.simd import lanes, layouts  # noqa: E402

GROUP = int(LANES)


def compiled(function: Any) -> Any:
    return nb.njit(error_model="numpy")(function)


def numbers(*shape: int) -> np.ndarray:
    return np.random.default_rng(len(shape)).normal(size=shape).astype(np.float32)


@compiled
def _arithmetic(x, y, out):
    a, b = lanes.load(x, index(1)), lanes.load(y, index(0))
    total = a * np.float32(2.0) + b / a - (-b)
    total += np.floor(a) + np.rint(b) + np.sqrt(abs(b))
    lanes.store(out, index(2), max(min(total, a), np.float32(-1.0)))
    chosen = lanes.where((a > b) & (b <= np.float32(0.5)), a, np.float32(7.0))
    lanes.store(out, index(2) + LANES, chosen)
    lanes.store(out, index(2) + LANES + LANES, lanes.lane_index() + lanes.broadcast(np.float32(3.0)))
    either = lanes.where(~((a > b) | (b > np.float32(1.0))), a, np.float32(9.0))
    lanes.store(out, index(2) + LANES + LANES + LANES, either)
    return lanes.any_of(a < b), lanes.any_of(a >= np.float32(100.0))


def test_arithmetic() -> None:
    x, y, out = numbers(GROUP + 1), numbers(GROUP), np.zeros(2 + 4 * GROUP, np.float32)
    some, none = _arithmetic(x, y, out)
    a = x[1:]
    total = a * 2 + y / a + y + np.floor(a) + np.rint(y) + np.sqrt(np.abs(y))
    assert (some, none) == (bool((a < y).any()), False)
    assert (out[:2] == 0).all()
    np.testing.assert_allclose(out[2 : 2 + GROUP], np.maximum(np.minimum(total, a), -1), rtol=1e-6)
    np.testing.assert_array_equal(out[2 + GROUP : 2 + 2 * GROUP], np.where((a > y) & (y <= 0.5), a, np.float32(7)))
    np.testing.assert_array_equal(out[2 + 2 * GROUP : 2 + 3 * GROUP], np.arange(GROUP) + 3)
    np.testing.assert_array_equal(out[2 + 3 * GROUP :], np.where((a > y) | (y > 1), np.float32(9), a))


@compiled
def _places(cube, at, out):
    x, y, z = lanes.load(at, index(0)), lanes.load(at, LANES), lanes.load(at, LANES + LANES)
    found = lanes.gather_int8(cube, x, y, z)
    lanes.scatter(out, x * np.float32(5.0) + y, found)


def test_places_in_arrays() -> None:
    rng = np.random.default_rng(0)
    cube = rng.integers(-128, 128, (5, 5, 5)).astype(np.int8)
    # No two lanes write to the same place, or the last would win.
    x, y = np.divmod(rng.permutation(25)[:GROUP], 5)
    z, out = rng.integers(0, 5, GROUP), np.full(25, 1000, np.float32)
    _places(cube, np.concatenate([x, y, z]).astype(np.float32), out)
    expected = np.full((5, 5), 1000, np.float32)
    expected[x, y] = cube[x, y, z]
    np.testing.assert_array_equal(out, expected.reshape(-1))


@compiled
def _functions(x, out):
    value = lanes.load(x, index(0))
    lanes.store(out, index(0), lanes.exp2_of(value))
    low, high = lanes.bits_below(min(abs(np.floor(value)), np.float32(8.0)))
    return low, high


def test_powers_and_bits() -> None:
    x, out = np.linspace(-8.5, 9, GROUP, dtype=np.float32), np.zeros(GROUP, np.float32)
    words = _functions(x, out)
    np.testing.assert_allclose(out, 2.0 ** x.astype(np.float64), rtol=2e-7)
    counts = np.minimum(np.abs(np.floor(x)), 8).astype(int)
    assert [(int(words[lane // 8]) >> (8 * (lane % 8))) & 255 for lane in range(GROUP)] == [2**n - 1 for n in counts]


@compiled
def _totals(x, out):
    a, b, c = (lanes.load(x, index(0)), lanes.load(x, LANES), lanes.load(x, LANES + LANES))
    lanes.store(out, index(0), lanes.reduce_sums((a, b, c)))
    return lanes.reduce_sum(b)


def test_totals() -> None:
    x, out = numbers(3 * GROUP), np.full(GROUP, np.nan, np.float32)
    assert _totals(x, out) == pytest.approx(x[GROUP : 2 * GROUP].sum(), rel=1e-5)
    np.testing.assert_allclose(out, np.pad(x.reshape(3, -1).sum(1), (0, GROUP - 3)), rtol=1e-5)


def _rows(columns: int) -> Any:
    read, write = getattr(layouts, f"read_{columns}"), getattr(layouts, f"write_{columns}")

    @compiled
    def through(values, row, rows, flat, out):
        read(values, index(row), rows, flat, LANES)
        write(out, index(row), rows, flat, LANES)

    return through


@pytest.mark.parametrize("columns", [1, 2, 3, 4])
@pytest.mark.parametrize("rows", [GROUP, 5, 1])
def test_rows(columns: int, rows: int) -> None:
    shape = (GROUP + 3, columns) if columns > 1 else (GROUP + 3,)
    values, out = numbers(*shape), np.zeros(shape, np.float32)
    flat = np.full((2 + columns) * GROUP, np.nan, np.float32)
    _rows(columns)(values, 2, rows, flat, out)
    expected = np.zeros((columns, GROUP), np.float32)
    expected[:, :rows] = values.reshape(-1, columns)[2 : 2 + rows].T
    np.testing.assert_array_equal(flat[GROUP:-GROUP].reshape(columns, GROUP), expected)
    assert np.isnan(flat[:GROUP]).all() and np.isnan(flat[-GROUP:]).all()
    np.testing.assert_array_equal(out[2 : 2 + rows], values[2 : 2 + rows])
    assert (out[:2] == 0).all() and (out[2 + rows :] == 0).all()


@compiled
def _colour_block(picture, out, flat):
    red, green, blue = layouts.read_colour_block(picture, index(2), index(1))
    lanes.store(flat, index(0), green)
    layouts.write_colour_block(out, index(2), index(1), (red, green, blue))


@compiled
def _grey_block(picture, out):
    layouts.write_grey_block(out, index(2), index(1), layouts.read_grey_block(picture, index(2), index(1)))


def test_blocks() -> None:
    picture, flat = numbers(7, 6, 3), np.zeros(GROUP, np.float32)
    out, inside = np.zeros_like(picture), (slice(2, 6), slice(1, 5))
    expected = np.zeros_like(picture)
    expected[inside] = picture[inside]
    _colour_block(picture, out, flat)
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_array_equal(flat, picture[(*inside, 1)].reshape(-1))
    grey = np.zeros((7, 6), np.float32)
    _grey_block(np.ascontiguousarray(picture[..., 0]), grey)
    np.testing.assert_array_equal(grey, expected[..., 0])
