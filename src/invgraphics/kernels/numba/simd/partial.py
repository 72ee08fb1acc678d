"""Masked SIMD loads and stores of the first few lanes, and arrays at addresses.

Lattices of one call differ in number and shape. Their addresses in one table let a single compiled kernel serve them all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba as nb
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types

from invgraphics.kernels.numba.runtime import GROUP, inlined
from invgraphics.kernels.numba.simd.arrays import check_array
from invgraphics.kernels.numba.simd.lanes import lanes

_WORD = ir.IntType(32)
_WORDS = ir.VectorType(_WORD, GROUP)

# Drops the first parameter, in a way that no checker can follow.
_intrinsic: Any = extending.intrinsic


_WIDTHS = (1, 4, 8, GROUP)
"""Lanes that one masked access may cover: wider ones cross into cache lines and pages that hold nothing wanted."""


_EXACT = {1: (1,), 4: (4,), 8: (8,), 12: (8, 4)}
"""Numbers of lanes, and the registers that hold just as many: AVX2's masked stores take as long as twenty plain ones."""


def _by_width(
    builder: Any, count: Any, generate: Callable[[int], None], generate_exact: Callable[[tuple[int, ...]], None]
) -> None:
    """Generate code for ``count`` lanes: without masks for `_EXACT` numbers, else for the narrowest sufficient of `_WIDTHS`."""
    for number, widths in _EXACT.items():
        same = builder.icmp_unsigned("==", count, ir.Constant(count.type, number))
        then, otherwise = builder.append_basic_block(), builder.append_basic_block()
        builder.cbranch(same, then, otherwise)
        builder.position_at_end(then)
        generate_exact(widths)
        builder.position_at_end(otherwise)
    for width in _WIDTHS[:-1]:
        narrow = builder.icmp_unsigned("<=", count, ir.Constant(count.type, width))
        then, otherwise = builder.append_basic_block(), builder.append_basic_block()
        builder.cbranch(narrow, then, otherwise)
        builder.position_at_end(then)
        generate(width)
        builder.position_at_end(otherwise)
    generate(GROUP)


def _masked(context: Any, builder: Any, kind: Any, arguments: Any, width: int) -> tuple[Any, Any, Any]:
    """Type of a register of ``width`` lanes, pointer to the first value, and the mask of the first ``count`` lanes."""
    layout, words = ir.VectorType(ir.FloatType(), width), ir.VectorType(_WORD, width)
    data = context.make_array(kind)(context, builder, arguments[0]).data
    pointer = builder.bitcast(builder.gep(data, [arguments[1]]), layout.as_pointer())
    count = builder.insert_element(ir.Constant(words, ir.Undefined), builder.trunc(arguments[2], _WORD), ir.Constant(_WORD, 0))
    count = builder.shuffle_vector(count, count, ir.Constant(words, None))
    return layout, pointer, builder.icmp_unsigned("<", ir.Constant(words, list(range(width))), count)


def _part(context: Any, builder: Any, kind: Any, arguments: Any, first: int, width: int) -> Any:
    """Pointer to ``width`` values, the ``first`` ones left out."""
    data = context.make_array(kind)(context, builder, arguments[0]).data
    at = builder.add(arguments[1], ir.Constant(arguments[1].type, first))
    return builder.bitcast(builder.gep(data, [at]), ir.VectorType(ir.FloatType(), width).as_pointer())


@_intrinsic
def load_first(typing: Any, flat: Any, at: Any, count: Any) -> Any:
    """Load ``count`` (at least 1) values of a flat array from ``at`` (uint64) on into the first lanes, 0 into the others."""
    check_array(flat)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        end, incoming = builder.append_basic_block(), []

        def load(width: int) -> None:
            layout, pointer, mask = _masked(context, builder, signature.args[0], arguments, width)
            kind = ir.FunctionType(layout, [pointer.type, _WORD, mask.type, layout])
            function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.load.v{width}f32.p0")
            none = ir.Constant(layout, None)
            values = builder.call(function, [pointer, ir.Constant(_WORD, 4), mask, none])
            wider = [min(lane, width) for lane in range(GROUP)]  # lane ``width`` is the first of ``none``
            incoming.append((builder.shuffle_vector(values, none, ir.Constant(_WORDS, wider)), builder.block))
            builder.branch(end)

        def load_exact(widths: tuple[int, ...]) -> None:
            value, first = ir.Constant(lanes.layout, None), 0
            for width in widths:
                part = builder.load(_part(context, builder, signature.args[0], arguments, first, width), align=4)
                spread = [lane if lane < width else 0 for lane in range(GROUP)]
                part = builder.shuffle_vector(part, part, ir.Constant(_WORDS, spread))
                inside = range(first, first + width)
                chosen = [GROUP + lane - first if lane in inside else lane for lane in range(GROUP)]
                value, first = builder.shuffle_vector(value, part, ir.Constant(_WORDS, chosen)), first + width
            incoming.append((value, builder.block))
            builder.branch(end)

        _by_width(builder, arguments[2], load, load_exact)
        builder.position_at_end(end)
        found = builder.phi(lanes.layout)
        for value, block in incoming:
            found.add_incoming(value, block)
        return found

    return lanes(flat, types.uint64, types.uint64), generate


@_intrinsic
def store_first(typing: Any, flat: Any, at: Any, count: Any, value: Any) -> Any:
    """Store the first ``count`` (at least 1) lanes to a flat array from ``at`` (uint64) on."""
    check_array(flat)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        end = builder.append_basic_block()

        def store(width: int) -> None:
            layout, pointer, mask = _masked(context, builder, signature.args[0], arguments, width)
            chosen = ir.Constant(ir.VectorType(_WORD, width), list(range(width)))
            values = builder.shuffle_vector(arguments[3], arguments[3], chosen)
            kind = ir.FunctionType(ir.VoidType(), [layout, pointer.type, _WORD, mask.type])
            function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.masked.store.v{width}f32.p0")
            builder.call(function, [values, pointer, ir.Constant(_WORD, 4), mask])
            builder.branch(end)

        def store_exact(widths: tuple[int, ...]) -> None:
            first = 0
            for width in widths:
                chosen = ir.Constant(ir.VectorType(_WORD, width), list(range(first, first + width)))
                values = builder.shuffle_vector(arguments[3], arguments[3], chosen)
                builder.store(values, _part(context, builder, signature.args[0], arguments, first, width), align=4)
                first += width
            builder.branch(end)

        _by_width(builder, arguments[2], store, store_exact)
        builder.position_at_end(end)
        return context.get_dummy_value()

    return types.void(flat, types.uint64, types.uint64, lanes), generate


def _pointer_to(kind: Any, layout: Any) -> Any:
    @_intrinsic
    def pointer(typing: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], layout.as_pointer())

        return types.CPointer(kind)(types.int64), generate

    return pointer


_float_pointer, _word_pointer = _pointer_to(types.float32, ir.FloatType()), _pointer_to(types.int32, _WORD)
_unsigned_pointer = _pointer_to(types.uint32, _WORD)
_long_pointer, _double_pointer = _pointer_to(types.int64, ir.IntType(64)), _pointer_to(types.float64, ir.DoubleType())

# Arrays at addresses own nothing, and so cost nothing to pass on. Numba counts the references to all others, by atomic calls
# where an inlined function has a branch, which can take longer than what it does to a register.


@inlined
def floats_at(address, size):
    """The flat float32 array of ``size`` values at an address (int64)."""
    return nb.carray(_float_pointer(address), size)


@inlined
def words_at(address, size):
    """The flat int32 array of ``size`` values at an address (int64)."""
    return nb.carray(_word_pointer(address), size)


@inlined
def unsigned_at(address, size):
    """The flat uint32 array of ``size`` values at an address (int64)."""
    return nb.carray(_unsigned_pointer(address), size)


@inlined
def longs_at(address, shape):
    """The int64 array of this shape at an address (int64)."""
    return nb.carray(_long_pointer(address), shape)


@inlined
def doubles_at(address, size):
    """The flat float64 array of ``size`` values at an address (int64)."""
    return nb.carray(_double_pointer(address), size)


@_intrinsic
def _float32_address(typing: Any, values: Any) -> Any:
    """Address (int64) of a float32 array's first value."""
    check_array(values)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.ptrtoint(data, ir.IntType(64))

    return types.int64(values), generate


@inlined
def unowned(values):
    """A contiguous float32 array as a flat one that is not counted; the caller keeps the memory."""
    return floats_at(_float32_address(values), values.size)
