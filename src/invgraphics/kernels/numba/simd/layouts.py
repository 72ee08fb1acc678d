"""Strided SIMD loads and stores: rows of a few columns, and 4 x 4 blocks of an image.

A group is read or written contiguously and (de)interleaved by shuffles: lane by lane, each value would be a memory access.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import cgutils, types

from invgraphics.kernels.numba.runtime import GROUP
from invgraphics.kernels.numba.simd.lanes import lanes

_EDGE = 4
"""Edge of a block: its pixels are the lanes."""
_WORD, _LONG = ir.IntType(32), ir.IntType(64)

# Drops the first parameter, in a way that no checker can follow.
_intrinsic: Any = extending.intrinsic


def _vector(numbers: int) -> Any:
    return ir.VectorType(ir.FloatType(), numbers)


def _shuffle(builder: Any, first: Any, second: Any, sources: Iterable[int]) -> Any:
    """Shuffle of two concatenated vectors; ``None`` for an unused second one."""
    mask = [ir.Constant(_WORD, source) for source in sources]
    second = ir.Constant(first.type, ir.Undefined) if second is None else second
    return builder.shuffle_vector(first, second, ir.Constant(ir.VectorType(_WORD, len(mask)), mask))


def _deinterleave(builder: Any, whole: Any, columns: int) -> list[Any]:
    """Deinterleave a vector of rows into one register per column."""
    return [_shuffle(builder, whole, None, range(k, columns * GROUP, columns)) for k in range(columns)]


def _interleave(builder: Any, registers: list[Any]) -> Any:
    """Inverse of `_deinterleave`."""
    columns, group = len(registers), range(2 * GROUP)
    if columns == 1:
        return registers[0]
    parts = [_shuffle(builder, registers[k], (registers[k + 1 :] or [None])[0], group) for k in range(0, columns, 2)]
    turns = (lane % columns * GROUP + lane // columns for lane in range(columns * GROUP))
    return _shuffle(builder, parts[0], (parts[1:] or [None])[0], turns)


def _pointer(context: Any, builder: Any, kind: Any, value: Any, indices: list[Any]) -> tuple[Any, list[Any]]:
    """Pointer to an element of a contiguous array, and the array's shape."""
    found = context.make_array(kind)(context, builder, value)
    shape = cgutils.unpack_tuple(builder, found.shape)
    indices = indices + [context.get_constant(types.intp, 0)] * (kind.ndim - len(indices))
    return cgutils.get_item_pointer(context, builder, kind, found, indices), shape


def _vector_at(builder: Any, pointer: Any, numbers: int) -> Any:
    return builder.bitcast(pointer, _vector(numbers).as_pointer())


def _copy(builder: Any, target: Any, source: Any, numbers: Any) -> None:
    with cgutils.for_range(builder, numbers) as loop:
        builder.store(builder.load(builder.gep(source, [loop.index])), builder.gep(target, [loop.index]))


def _row_access(columns: int) -> tuple[Any, Any]:
    """Intrinsics that load and store rows of so many columns."""
    numbers = columns * GROUP

    def parts(context: Any, builder: Any, kinds: Any, arguments: Any) -> tuple[Any, Any, Any, Any, list[Any]]:
        """Pointer to the rows, number of values, whether the group is full, a buffer for one that is not, and slot pointers."""
        pointer, _ = _pointer(context, builder, kinds[0], arguments[0], [arguments[1]])
        buffer = cgutils.alloca_once(builder, ir.FloatType(), size=ir.Constant(_LONG, numbers))
        count = builder.mul(arguments[2], ir.Constant(_LONG, columns))
        first, _ = _pointer(context, builder, kinds[3], arguments[3], [arguments[4]])
        slots = [_vector_at(builder, builder.gep(first, [ir.Constant(_LONG, k * GROUP)]), GROUP) for k in range(columns)]
        return pointer, count, builder.icmp_signed("==", count, ir.Constant(_LONG, numbers)), buffer, slots

    @_intrinsic
    def read(typing: Any, values: Any, row: Any, rows: Any, flat: Any, slot: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointer, count, whole, buffer, slots = parts(context, builder, signature.args, arguments)
            found, padded = cgutils.alloca_once(builder, _vector(numbers)), _vector_at(builder, buffer, numbers)
            with builder.if_else(whole) as (then, otherwise):
                with then:
                    builder.store(builder.load(_vector_at(builder, pointer, numbers), align=4), found)
                with otherwise:
                    builder.store(ir.Constant(_vector(numbers), None), padded, align=4)
                    _copy(builder, buffer, pointer, count)
                    builder.store(builder.load(padded, align=4), found)
            for register, pointer in zip(_deinterleave(builder, builder.load(found), columns), slots, strict=True):
                builder.store(register, pointer, align=4)
            return context.get_dummy_value()

        return types.void(values, types.uint64, types.int64, flat, types.uint64), generate

    @_intrinsic
    def write(typing: Any, values: Any, row: Any, rows: Any, flat: Any, slot: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointer, count, whole, buffer, slots = parts(context, builder, signature.args, arguments)
            interleaved = _interleave(builder, [builder.load(pointer, align=4) for pointer in slots])
            with builder.if_else(whole) as (then, otherwise):
                with then:
                    builder.store(interleaved, _vector_at(builder, pointer, numbers), align=4)
                with otherwise:
                    builder.store(interleaved, _vector_at(builder, buffer, numbers), align=4)
                    _copy(builder, pointer, buffer, count)
            return context.get_dummy_value()

        return types.void(values, types.uint64, types.int64, flat, types.uint64), generate

    return read, write


# ``read(values, row, rows, flat, slot)`` copies ``rows`` (at most `LANES`) rows of a contiguous array, from ``row`` on, to a
# flat array, one column after the other from ``slot`` on, `LANES` values each, padded with 0. ``write`` is its inverse.
read_1, write_1 = _row_access(1)
read_2, write_2 = _row_access(2)
read_3, write_3 = _row_access(3)
read_4, write_4 = _row_access(4)


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Transpose of as many registers as lanes: each stage swaps the off-diagonal blocks of twice the size (Eklundh 1972)."""
    block = 1
    while block < GROUP:
        for k in (k for k in range(GROUP) if not k & block):
            low, high = rows[k], rows[k + block]
            # Lane l of ``high`` is source `GROUP` + l.
            upper = [lane & block for lane in range(GROUP)]
            rows[k] = _shuffle(builder, low, high, [GROUP + n - block if up else n for n, up in enumerate(upper)])
            rows[k + block] = _shuffle(builder, low, high, [GROUP + n if up else n + block for n, up in enumerate(upper)])
        block *= 2
    return rows


@_intrinsic
def transpose(typing: Any, source: Any, at: Any, stride: Any, target: Any, to: Any, target_stride: Any) -> Any:
    """Transpose a block of `LANES` x `LANES` values of a flat array, from ``at`` on, into another one (all uint64)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def places(number: int) -> list[Any]:
            first, _ = _pointer(context, builder, signature.args[number], arguments[number], [arguments[number + 1]])
            steps = [builder.mul(arguments[number + 2], ir.Constant(_LONG, k)) for k in range(GROUP)]
            return [_vector_at(builder, builder.gep(first, [step]), GROUP) for step in steps]

        rows = [builder.load(place, align=4) for place in places(0)]
        for row, place in zip(_transposed(builder, rows), places(3), strict=True):
            builder.store(row, place, align=4)
        return context.get_dummy_value()

    return types.void(source, types.uint64, types.uint64, target, types.uint64, types.uint64), generate


def _block_access(channels: int) -> tuple[Any, Any]:
    """Intrinsics that load and store blocks of images of so many channels."""
    row = _EDGE * channels

    def rows(context: Any, builder: Any, kind: Any, arguments: Any) -> list[Any]:
        """Pointers to the block's rows."""
        pointer, shape = _pointer(context, builder, kind, arguments[0], [arguments[1], arguments[2]])
        stride = builder.mul(shape[1], ir.Constant(shape[1].type, channels))
        offsets = [builder.mul(stride, ir.Constant(stride.type, k)) for k in range(_EDGE)]
        return [_vector_at(builder, builder.gep(pointer, [offset]), row) for offset in offsets]

    @_intrinsic
    def read(typing: Any, image: Any, y: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            parts = [builder.load(at, align=4) for at in rows(context, builder, signature.args[0], arguments)]
            while len(parts) > 1:
                width = range(2 * parts[0].type.count)
                parts = [_shuffle(builder, *parts[k : k + 2], width) for k in range(0, len(parts), 2)]
            return context.make_tuple(builder, signature.return_type, _deinterleave(builder, parts[0], channels))

        return types.UniTuple(lanes, channels)(image, types.uint64, types.uint64), generate

    @_intrinsic
    def write(typing: Any, image: Any, y: Any, x: Any, registers: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            interleaved = _interleave(builder, cgutils.unpack_tuple(builder, arguments[3]))
            for k, at in enumerate(rows(context, builder, signature.args[0], arguments)):
                builder.store(_shuffle(builder, interleaved, None, range(k * row, (k + 1) * row)), at, align=4)
            return context.get_dummy_value()

        return types.void(image, types.uint64, types.uint64, types.UniTuple(lanes, channels)), generate

    return read, write


# ``read_block(image, y, x)`` loads the block whose first pixel is (y, x) into one register per channel; it must lie inside the
# contiguous image. ``write_block(image, y, x, registers)`` is its inverse.
read_grey_block, write_grey_block = _block_access(1)
read_colour_block, write_colour_block = _block_access(3)
