"""LLVM intrinsics that Numba does not expose: fused multiply-add, paired loads and stores, bit scans, and prefetch.

A table of two features per entry holds both in eight consecutive bytes, which one instruction reads or writes. Numba leaves
LLVM's search for such pairs off, so they are written out here.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import cgutils, types

# Drops the first parameter, in a way that no checker can follow.
_intrinsic: Any = extending.intrinsic

_PAIR = ir.VectorType(ir.FloatType(), 2)
_FLAGS = ("contract", "nsz")

PREFETCH_DISTANCE = 8
"""Rows ahead at which `prefetch` is issued: from 3 to 12 it makes no difference."""


def _pair_pointers(context: Any, builder: Any, table_type: Any, table: Any, entries: Any) -> list[Any]:
    """Pointers to the pairs of these entries of a flat float32 array."""
    data = context.make_array(table_type)(context, builder, table).data
    pairs = builder.bitcast(data, _PAIR.as_pointer())
    return [builder.gep(pairs, [builder.zext(e, ir.IntType(64))]) for e in cgutils.unpack_tuple(builder, entries)]


def _pair(builder: Any, low: Any, high: Any) -> Any:
    """The pair (low, high)."""
    pair = builder.insert_element(ir.Constant(_PAIR, ir.Undefined), low, ir.Constant(ir.IntType(32), 0))
    return builder.insert_element(pair, high, ir.Constant(ir.IntType(32), 1))


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    return builder.fadd(builder.fmul(a, b, flags=_FLAGS), c, flags=_FLAGS)


@_intrinsic
def fma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """``a b + c``, rounded once (float32)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float32(types.float32, types.float32, types.float32), generate


@_intrinsic
def interpolate_pair(typing: Any, table: Any, entries: Any, weights: Any) -> Any:
    """Interpolate both features of 8 entries (uint32) of a flat table."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointers = _pair_pointers(context, builder, signature.args[0], arguments[0], arguments[1])
        scales = [_pair(builder, w, w) for w in cgutils.unpack_tuple(builder, arguments[2])]
        pairs = [builder.load(pointer, align=4) for pointer in pointers]
        # Two chains: one would wait for itself, more take registers.
        sums = [builder.fmul(pair, scale, flags=_FLAGS) for pair, scale in zip(pairs[:2], scales[:2], strict=True)]
        for n, (pair, scale) in enumerate(zip(pairs[2:], scales[2:], strict=True)):
            sums[n % 2] = _multiply_add(builder, pair, scale, sums[n % 2])
        total = builder.fadd(*sums, flags=_FLAGS)
        found = [builder.extract_element(total, ir.Constant(ir.IntType(32), k)) for k in range(2)]
        return context.make_tuple(builder, signature.return_type, found)

    return types.UniTuple(types.float32, 2)(table, entries, weights), generate


@_intrinsic
def scatter_add_pair(typing: Any, table: Any, entries: Any, weights: Any, low: Any, high: Any) -> Any:
    """Transpose of `interpolate_pair`: add a gradient to both features of 8 entries."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        gradient = _pair(builder, arguments[3], arguments[4])
        pointers = _pair_pointers(context, builder, signature.args[0], arguments[0], arguments[1])
        for pointer, w in zip(pointers, cgutils.unpack_tuple(builder, arguments[2]), strict=True):
            # One after the other: vertices that share an entry add to it in turn.
            old = builder.load(pointer, align=4)
            builder.store(_multiply_add(builder, _pair(builder, w, w), gradient, old), pointer, align=4)
        return context.get_dummy_value()

    return types.void(table, entries, weights, low, high), generate


@_intrinsic
def dot_pair(typing: Any, table: Any, entries: Any, low: Any, high: Any) -> Any:
    """Products ``low a + high b`` with the pairs (a, b) of 8 entries (uint32) of a flat table."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointers = _pair_pointers(context, builder, signature.args[0], arguments[0], arguments[1])
        products = []
        for pointer in pointers:
            pair = builder.load(pointer, align=4)
            a, b = (builder.extract_element(pair, ir.Constant(ir.IntType(32), k)) for k in range(2))
            first = builder.fmul(a, arguments[2], flags=_FLAGS)
            products.append(_multiply_add(builder, b, arguments[3], first))
        return context.make_tuple(builder, signature.return_type, products)

    return types.UniTuple(types.float32, 8)(table, entries, low, high), generate


@_intrinsic
def lowest_bit(typing: Any, word: Any) -> Any:
    """Index of the lowest set bit of a non-zero uint64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate


@_intrinsic
def count_bits(typing: Any, word: Any) -> Any:
    """Population count of a uint64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.uint64), generate


def _emit_prefetch(builder: Any, pointer: Any) -> None:
    """Emit a prefetch of a pointer's cache line."""
    byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
    function = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
    function = cgutils.get_or_insert_function(builder.module, function, "llvm.prefetch.p0")
    # Read access, high temporal locality, data cache.
    builder.call(function, [builder.bitcast(pointer, byte), *(ir.Constant(number, n) for n in (0, 3, 1))])


@_intrinsic
def prefetch(typing: Any, array: Any, row: Any) -> Any:
    """Prefetch the first and the last byte of a row (uint64) of a contiguous array.

    For rows that are visited in random order, which hardware prefetchers do not predict.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        found = context.make_array(kind)(context, builder, arguments[0])
        width = context.get_constant(types.intp, 1)
        for axis in range(1, kind.ndim):
            width = builder.mul(width, builder.extract_value(found.shape, axis))
        first = builder.gep(found.data, [builder.mul(arguments[1], width)])
        last = builder.gep(first, [builder.sub(width, context.get_constant(types.intp, 1))])
        _emit_prefetch(builder, first)
        _emit_prefetch(builder, last)
        return context.get_dummy_value()

    return types.void(array, row), generate


@_intrinsic
def prefetch_at(typing: Any, flat: Any, at: Any) -> Any:
    """Prefetch the cache line of a flat array's element ``at`` (uint64), which may lie beyond its end."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        _emit_prefetch(builder, builder.gep(data, [arguments[1]]))
        return context.get_dummy_value()

    return types.void(flat, types.uint64), generate


@_intrinsic
def prefetch_pair(typing: Any, table: Any, entry: Any) -> Any:
    """`prefetch` of both features of an entry (uint32) of a flat table."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        pairs = builder.bitcast(data, _PAIR.as_pointer())
        _emit_prefetch(builder, builder.gep(pairs, [builder.zext(arguments[1], ir.IntType(64))]))
        return context.get_dummy_value()

    return types.void(table, types.uint32), generate
