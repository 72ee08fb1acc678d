"""Registers from and to arrays in which a lane's numbers do not lie side by side: rows of a few columns, blocks of a picture.

All of a group is read or written at once and sorted inside the registers: number by number, each would be a memory access.
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


def _wide(numbers: int) -> Any:
    return ir.VectorType(ir.FloatType(), numbers)


def _picked(builder: Any, first: Any, second: Any, places: Iterable[int]) -> Any:
    """Lanes of two vectors behind one another; ``None`` stands for one that is not looked at."""
    mask = [ir.Constant(_WORD, place) for place in places]
    second = ir.Constant(first.type, ir.Undefined) if second is None else second
    return builder.shuffle_vector(first, second, ir.Constant(ir.VectorType(_WORD, len(mask)), mask))


def _apart(builder: Any, whole: Any, columns: int) -> list[Any]:
    """The registers whose lanes take turns in a vector."""
    return [_picked(builder, whole, None, range(k, columns * GROUP, columns)) for k in range(columns)]


def _together(builder: Any, registers: list[Any]) -> Any:
    """Inverse of `_apart`."""
    columns, group = len(registers), range(2 * GROUP)
    if columns == 1:
        return registers[0]
    parts = [_picked(builder, registers[k], (registers[k + 1 :] or [None])[0], group) for k in range(0, columns, 2)]
    turns = (lane % columns * GROUP + lane // columns for lane in range(columns * GROUP))
    return _picked(builder, parts[0], (parts[1:] or [None])[0], turns)


def _place(context: Any, builder: Any, kind: Any, value: Any, indices: list[Any]) -> tuple[Any, list[Any]]:
    """Pointer into a contiguous array, and the array's shape."""
    found = context.make_array(kind)(context, builder, value)
    shape = cgutils.unpack_tuple(builder, found.shape)
    indices = indices + [context.get_constant(types.intp, 0)] * (kind.ndim - len(indices))
    return cgutils.get_item_pointer(context, builder, kind, found, indices), shape


def _vector_at(builder: Any, pointer: Any, numbers: int) -> Any:
    return builder.bitcast(pointer, _wide(numbers).as_pointer())


def _copy(builder: Any, target: Any, source: Any, numbers: Any) -> None:
    with cgutils.for_range(builder, numbers) as loop:
        builder.store(builder.load(builder.gep(source, [loop.index])), builder.gep(target, [loop.index]))


def _row_access(columns: int) -> tuple[Any, Any]:
    """Reading and writing rows of so many columns."""
    numbers = columns * GROUP

    def parts(context: Any, builder: Any, kinds: Any, arguments: Any) -> tuple[Any, Any, Any, Any, list[Any]]:
        """Where the rows begin, how many numbers there are and whether they are all, room for them, and the slots."""
        pointer, _ = _place(context, builder, kinds[0], arguments[0], [arguments[1]])
        room = cgutils.alloca_once(builder, ir.FloatType(), size=ir.Constant(_LONG, numbers))
        count = builder.mul(arguments[2], ir.Constant(_LONG, columns))
        first, _ = _place(context, builder, kinds[3], arguments[3], [arguments[4]])
        slots = [_vector_at(builder, builder.gep(first, [ir.Constant(_LONG, k * GROUP)]), GROUP) for k in range(columns)]
        return pointer, count, builder.icmp_signed("==", count, ir.Constant(_LONG, numbers)), room, slots

    @_intrinsic
    def read(typing: Any, values: Any, row: Any, rows: Any, flat: Any, slot: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointer, count, whole, room, slots = parts(context, builder, signature.args, arguments)
            found, short = cgutils.alloca_once(builder, _wide(numbers)), _vector_at(builder, room, numbers)
            with builder.if_else(whole) as (then, otherwise):
                with then:
                    builder.store(builder.load(_vector_at(builder, pointer, numbers), align=4), found)
                with otherwise:
                    builder.store(ir.Constant(_wide(numbers), None), short, align=4)
                    _copy(builder, room, pointer, count)
                    builder.store(builder.load(short, align=4), found)
            for register, place in zip(_apart(builder, builder.load(found), columns), slots, strict=True):
                builder.store(register, place, align=4)
            return context.get_dummy_value()

        return types.void(values, types.uint64, types.int64, flat, types.uint64), generate

    @_intrinsic
    def write(typing: Any, values: Any, row: Any, rows: Any, flat: Any, slot: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            pointer, count, whole, room, slots = parts(context, builder, signature.args, arguments)
            together = _together(builder, [builder.load(place, align=4) for place in slots])
            with builder.if_else(whole) as (then, otherwise):
                with then:
                    builder.store(together, _vector_at(builder, pointer, numbers), align=4)
                with otherwise:
                    builder.store(together, _vector_at(builder, room, numbers), align=4)
                    _copy(builder, pointer, room, count)
            return context.get_dummy_value()

        return types.void(values, types.uint64, types.int64, flat, types.uint64), generate

    return read, write


# ``read(values, row, rows, flat, slot)`` writes each column of `LANES` rows of a contiguous array, from ``row`` on, to a flat
# array, `LANES` numbers each from ``slot`` on; where there are but ``rows``, the other lanes get 0. ``write`` is its inverse.
read_1, write_1 = _row_access(1)
read_2, write_2 = _row_access(2)
read_3, write_3 = _row_access(3)
read_4, write_4 = _row_access(4)


def _block_access(channels: int) -> tuple[Any, Any]:
    """Reading and writing blocks of pictures of so many channels."""
    row = _EDGE * channels

    def rows(context: Any, builder: Any, kind: Any, arguments: Any) -> list[Any]:
        """Where the block's rows begin."""
        pointer, shape = _place(context, builder, kind, arguments[0], [arguments[1], arguments[2]])
        stride = builder.mul(shape[1], ir.Constant(shape[1].type, channels))
        offsets = [builder.mul(stride, ir.Constant(stride.type, k)) for k in range(_EDGE)]
        return [_vector_at(builder, builder.gep(pointer, [offset]), row) for offset in offsets]

    @_intrinsic
    def read(typing: Any, picture: Any, y: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            parts = [builder.load(at, align=4) for at in rows(context, builder, signature.args[0], arguments)]
            while len(parts) > 1:
                width = range(2 * parts[0].type.count)
                parts = [_picked(builder, *parts[k : k + 2], width) for k in range(0, len(parts), 2)]
            return context.make_tuple(builder, signature.return_type, _apart(builder, parts[0], channels))

        return types.UniTuple(lanes, channels)(picture, types.uint64, types.uint64), generate

    @_intrinsic
    def write(typing: Any, picture: Any, y: Any, x: Any, registers: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            together = _together(builder, cgutils.unpack_tuple(builder, arguments[3]))
            for k, at in enumerate(rows(context, builder, signature.args[0], arguments)):
                builder.store(_picked(builder, together, None, range(k * row, (k + 1) * row)), at, align=4)
            return context.get_dummy_value()

        return types.void(picture, types.uint64, types.uint64, types.UniTuple(lanes, channels)), generate

    return read, write


# ``read_block(picture, y, x)`` gives a register for each channel, of the block of a contiguous picture whose first pixel is
# there; all of the block must lie inside. ``write_block(picture, y, x, registers)`` is its inverse.
read_grey_block, write_grey_block = _block_access(1)
read_colour_block, write_colour_block = _block_access(3)
