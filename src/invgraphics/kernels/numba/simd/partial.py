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
from invgraphics.kernels.numba.simd.lanes import lanes

_WORD = ir.IntType(32)
_WORDS = ir.VectorType(_WORD, GROUP)

# Drops the first parameter, in a way that no checker can follow.
_intrinsic: Any = extending.intrinsic


_WIDTHS = (1, 4, 8, GROUP)
"""Lanes that one masked access may cover: wider ones cross into cache lines and pages that hold nothing wanted."""


def _by_width(builder: Any, count: Any, generate: Callable[[int], None]) -> None:
    """Generate code for the narrowest of `_WIDTHS` that covers ``count`` lanes."""
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


@_intrinsic
def load_first(typing: Any, flat: Any, at: Any, count: Any) -> Any:
    """Load ``count`` (at least 1) values of a flat array from ``at`` (uint64) on into the first lanes, 0 into the others."""

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

        _by_width(builder, arguments[2], load)
        builder.position_at_end(end)
        found = builder.phi(lanes.layout)
        for value, block in incoming:
            found.add_incoming(value, block)
        return found

    return lanes(flat, types.uint64, types.uint64), generate


@_intrinsic
def store_first(typing: Any, flat: Any, at: Any, count: Any, value: Any) -> Any:
    """Store the first ``count`` (at least 1) lanes to a flat array from ``at`` (uint64) on."""

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

        _by_width(builder, arguments[2], store)
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


@inlined
def floats_at(address, size):
    """The flat float32 array of ``size`` values at an address (int64)."""
    return nb.carray(_float_pointer(address), size)


@inlined
def words_at(address, size):
    """The flat int32 array of ``size`` values at an address (int64)."""
    return nb.carray(_word_pointer(address), size)
