"""SIMD registers as a Numba type: `LANES` float32 values with arithmetic, comparison, load, store, gather and reduction.

Numba's loops over the lanes of a scratch array are found by LLVM and become the same instructions, but every sum then lives in
memory. A value of this type stays in a register for as long as it is used, and a kernel reads as if it handled one pixel.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.typeconv import Conversion
from numba.core.typing import templates

from invgraphics.kernels.numba.runtime import GROUP, exp2_fraction, inlined
from invgraphics.kernels.numba.simd.arrays import check_array

_WORD = ir.IntType(32)
_WORDS = ir.VectorType(_WORD, GROUP)

# All decorate in ways that no checker can follow.
_intrinsic: Any = extending.intrinsic
_lower_cast: Any = extending.lower_cast
_infer_global: Any = templates.infer_global


class _Register(types.Type):
    """A SIMD register of `LANES` values."""

    def __init__(self, name: str, element: Any) -> None:
        super().__init__(name)
        self.layout = ir.VectorType(element, GROUP)

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Implicit broadcast of a float32."""
        return Conversion.safe if self is lanes and other == types.float32 else None


lanes = _Register("lanes", ir.FloatType())
"""Register of `LANES` float32 values."""
mask = _Register("mask", ir.IntType(1))
"""Register of `LANES` booleans, the result of a comparison."""


@extending.register_model(_Register)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, kind: _Register) -> None:
        super().__init__(dmm, kind, kind.layout)


def _splat(builder: Any, value: Any) -> Any:
    """Broadcast one value to all lanes."""
    one = builder.insert_element(ir.Constant(ir.VectorType(value.type, GROUP), ir.Undefined), value, ir.Constant(_WORD, 0))
    return builder.shuffle_vector(one, one, ir.Constant(_WORDS, None))


@_lower_cast(types.float32, _Register)
def _from_number(context: Any, builder: Any, source: Any, target: Any, value: Any) -> Any:
    return _splat(builder, value)


def _define(function: Any, result: _Register, operands: tuple[_Register, ...], generate: Callable[..., Any]) -> None:
    """Define a Python operator for registers; ``generate`` gets the builder and the operands."""
    signature = templates.signature(result, *operands)
    _infer_global(function)(type("Rule", (templates.ConcreteTemplate,), {"cases": [signature]}))

    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return generate(builder, *arguments)

    extending.lower_builtin(function, *signature.args)(lower)


def _apply(name: str) -> Callable[..., Any]:
    """A unary LLVM intrinsic, applied lane by lane."""
    kind, name = ir.FunctionType(lanes.layout, [lanes.layout]), f"llvm.{name}.v{GROUP}f32"
    return lambda builder, value: builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [value])


def _select(comparison: str) -> Callable[..., Any]:
    return lambda builder, a, b: builder.select(builder.fcmp_ordered(comparison, a, b), a, b)


for _function in (operator.add, operator.iadd):
    _define(_function, lanes, (lanes, lanes), lambda builder, a, b: builder.fadd(a, b))
_define(operator.sub, lanes, (lanes, lanes), lambda builder, a, b: builder.fsub(a, b))
_define(operator.mul, lanes, (lanes, lanes), lambda builder, a, b: builder.fmul(a, b))
_define(operator.truediv, lanes, (lanes, lanes), lambda builder, a, b: builder.fdiv(a, b))
_define(operator.neg, lanes, (lanes,), lambda builder, a: builder.fneg(a))
_define(abs, lanes, (lanes,), _apply("fabs"))
_define(np.floor, lanes, (lanes,), _apply("floor"))
_define(np.rint, lanes, (lanes,), _apply("rint"))
_define(np.sqrt, lanes, (lanes,), _apply("sqrt"))
# Of a number and NaN, the second operand.
_define(min, lanes, (lanes, lanes), _select("<"))
_define(max, lanes, (lanes, lanes), _select(">"))
for _function, _sign in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _define(_function, mask, (lanes, lanes), lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b))
_define(operator.and_, mask, (mask, mask), lambda builder, a, b: builder.and_(a, b))
_define(operator.or_, mask, (mask, mask), lambda builder, a, b: builder.or_(a, b))
_define(operator.invert, mask, (mask,), lambda builder, a: builder.not_(a))


def _place(context: Any, builder: Any, kind: Any, flat: Any, at: Any) -> Any:
    data = context.make_array(kind)(context, builder, flat).data
    return builder.bitcast(builder.gep(data, [at]), lanes.layout.as_pointer())


@_intrinsic
def load(typing: Any, flat: Any, at: Any) -> Any:
    """Load `LANES` values of a flat array from ``at`` (uint64) on."""
    check_array(flat)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_place(context, builder, signature.args[0], *arguments), align=4)

    return lanes(flat, types.uint64), generate


@_intrinsic
def store(typing: Any, flat: Any, at: Any, value: Any) -> Any:
    """Store `LANES` values to a flat array from ``at`` (uint64) on."""
    check_array(flat)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _place(context, builder, signature.args[0], *arguments[:2]), align=4)
        return context.get_dummy_value()

    return types.void(flat, types.uint64, lanes), generate


def _each(builder: Any, values: Any) -> list[Any]:
    """Extract all lanes."""
    return [builder.extract_element(values, ir.Constant(_WORD, lane)) for lane in range(GROUP)]


def _to_int(builder: Any, values: Any) -> Any:
    """Convert whole float32 values to int32."""
    return builder.fptosi(values, _WORDS)


@_intrinsic
def scatter(typing: Any, flat: Any, at: Any, value: Any) -> Any:
    """Scatter: store each lane's value at its index in ``at`` (whole numbers), in lane order."""
    check_array(flat)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        for place, number in zip(_each(builder, _to_int(builder, arguments[1])), _each(builder, arguments[2]), strict=True):
            builder.store(number, builder.gep(data, [place]), align=4)
        return context.get_dummy_value()

    return types.void(flat, lanes, lanes), generate


@_intrinsic
def gather_int8(typing: Any, cube: Any, x: Any, y: Any, z: Any) -> Any:
    """Gather from a contiguous int8 cube at each lane's indices (whole numbers), converted to float32."""
    check_array(cube, types.int8)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        found = context.make_array(signature.args[0])(context, builder, arguments[0])
        edge = _splat(builder, builder.trunc(builder.extract_value(found.shape, 2), _WORD))
        i, j, k = (_to_int(builder, values) for values in arguments[1:])
        flat = builder.add(builder.mul(builder.add(builder.mul(i, edge), j), edge), k)
        bytes_ = ir.Constant(ir.VectorType(ir.IntType(8), GROUP), ir.Undefined)
        for lane, place in enumerate(_each(builder, flat)):
            bytes_ = builder.insert_element(bytes_, builder.load(builder.gep(found.data, [place])), ir.Constant(_WORD, lane))
        return builder.sitofp(bytes_, lanes.layout)

    return lanes(cube, lanes, lanes, lanes), generate


@_intrinsic
def where(typing: Any, condition: Any, yes: Any, no: Any) -> Any:
    """Select ``yes`` in lanes where the condition holds, ``no`` in the others."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return lanes(mask, lanes, lanes), generate


@_intrinsic
def any_of(typing: Any, condition: Any) -> Any:
    """Horizontal or: whether a condition holds in any lane."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(GROUP))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask), generate


@_intrinsic
def lane_index(typing: Any) -> Any:
    """Lane indices 0, 1, 2, ..."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(lanes.layout, [float(lane) for lane in range(GROUP)])

    return lanes(), generate


@_intrinsic
def broadcast(typing: Any, value: Any) -> Any:
    """Broadcast a float32 to all lanes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return arguments[0]

    return lanes(lanes), generate


@_intrinsic
def bits_below(typing: Any, counts: Any) -> Any:
    """Per lane a byte whose lowest ``counts`` bits are set (whole numbers, 0 to 8); 8 lanes are a word (uint64)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        ones = ir.Constant(_WORDS, [1] * GROUP)
        bits = builder.sub(builder.shl(ones, _to_int(builder, arguments[0])), ones)
        pair = builder.bitcast(builder.trunc(bits, ir.VectorType(ir.IntType(8), GROUP)), ir.VectorType(ir.IntType(64), 2))
        found = [builder.extract_element(pair, ir.Constant(_WORD, k)) for k in range(2)]
        return context.make_tuple(builder, signature.return_type, found)

    return types.UniTuple(types.uint64, 2)(lanes), generate


@_intrinsic
def _power_of_two(typing: Any, whole: Any) -> Any:
    """``2**whole`` for whole numbers in [-126, 127]: the exponent of a float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.add(_to_int(builder, arguments[0]), ir.Constant(_WORDS, [127] * GROUP))
        return builder.bitcast(builder.shl(bits, ir.Constant(_WORDS, [23] * GROUP)), lanes.layout)

    return lanes(lanes), generate


@inlined
def exp2_of(x):
    """`runtime.exp2` of every lane."""
    x = max(x, np.float32(-126.0))
    whole = np.rint(x)
    return (exp2_fraction(x - whole) + np.float32(1.0)) * _power_of_two(whole)


def _paired(builder: Any, first: Any, second: Any, held: int) -> Any:
    """One step of `_summed`: merge two rows of ``held`` partial sums each, adding the halves of every part."""
    part = GROUP // held
    starts = range(0, 2 * GROUP, part)

    def halves(begin: int) -> Any:
        chosen = [start + begin + lane for start in starts for lane in range(part // 2)]
        return builder.shuffle_vector(first, second, ir.Constant(_WORDS, chosen))

    return builder.fadd(halves(0), halves(part // 2))


def _summed(builder: Any, rows: list[Any]) -> Any:
    """Horizontal sums of the rows, in the first lanes of one."""
    rows = rows + [ir.Constant(lanes.layout, None)] * (GROUP - len(rows))
    held = 1
    while held < GROUP:
        rows = [_paired(builder, *rows[k : k + 2], held) for k in range(0, len(rows), 2)]
        held *= 2
    return rows[0]


@_intrinsic
def reduce_sum(typing: Any, value: Any) -> Any:
    """Horizontal sum over the lanes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.extract_element(_summed(builder, [arguments[0]]), ir.Constant(_WORD, 0))

    return types.float32(lanes), generate


@_intrinsic
def reduce_sums(typing: Any, values: Any) -> Any:
    """Horizontal sums of up to `LANES` registers, in the first lanes of one; the others hold 0.

    A pairwise transpose-and-add: a quarter of the instructions of one horizontal sum after the other.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = [builder.extract_value(arguments[0], k) for k in range(values.count)]
        return _summed(builder, rows)

    return lanes(values), generate
