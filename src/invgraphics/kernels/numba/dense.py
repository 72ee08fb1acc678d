"""A layer of a small network for 32 points at once, in vector registers.

Numba's loops would keep sums in memory; here four outputs of all points stay in registers until they are complete.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from torch import Tensor

from invgraphics.kernels.numba.lanes import everywhere, lanes
from invgraphics.kernels.numba.runtime import LANES, array

POINTS = LANES + LANES
"""Points of a call: feature after feature, ``POINTS`` values each."""
TOGETHER = 4
"""Outputs that are summed side by side; their number is filled up to a multiple of it."""

# Drops the first parameter, in a way that no checker can follow.
_intrinsic: Any = extending.intrinsic
_REGISTER = lanes.layout
_FLAGS = ("contract", "nsz")
_NUMBER = ir.IntType(64)


def padded(outputs: int) -> int:
    """Outputs of a layer as `dense` computes them."""
    return -(-outputs // TOGETHER) * TOGETHER


def packed_layer(weight: Float[Tensor, "outs ins"], bias: Float[Tensor, " outs"]) -> np.ndarray:
    """A layer as `dense` reads it: of each `TOGETHER` outputs the biases, then the weights input by input."""
    outputs, inputs = weight.shape
    rows = np.zeros((padded(outputs), 1 + inputs), np.float32)
    rows[:outputs, 0], rows[:outputs, 1:] = array(bias), array(weight)
    return rows.reshape(-1, TOGETHER, 1 + inputs).transpose(0, 2, 1).reshape(-1)


def _data(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    return context.make_array(kind)(context, builder, value).data


@_intrinsic
def dense(typing: Any, layer: Any, at: Any, x: Any, y: Any, sizes: Any, rectified: Any) -> Any:
    """Apply a layer to `POINTS` points: ``y = W x + b``, or 0 where that is negative and ``rectified``.

    ``layer`` is a flat array in which the layer begins at ``at`` (see `packed_layer`), ``x`` and ``y`` are flat arrays,
    ``sizes`` the numbers of inputs and of padded outputs (uint64). All numbers are float32.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds, registers = signature.args, range(int(POINTS // LANES))
        begin, into, out = (_data(context, builder, kinds[k], arguments[k]) for k in (0, 2, 3))
        begin = builder.gep(begin, [arguments[1]])
        inputs, outputs = cgutils.unpack_tuple(builder, arguments[4])
        zero = ir.Constant(_REGISTER, None)
        sums = [[cgutils.alloca_once(builder, _REGISTER) for _ in registers] for _ in range(TOGETHER)]

        def number(value: int) -> Any:
            return ir.Constant(_NUMBER, value)

        def place(base: Any, row: Any, register: int) -> Any:
            offset = builder.add(builder.mul(row, number(int(POINTS))), number(register * int(LANES)))
            return builder.bitcast(builder.gep(base, [offset]), _REGISTER.as_pointer())

        def scalars(offset: Any) -> list[Any]:
            found = [builder.load(builder.gep(begin, [builder.add(offset, number(n))])) for n in range(TOGETHER)]
            return [everywhere(builder, value) for value in found]

        with cgutils.for_range_slice(builder, number(0), outputs, number(TOGETHER), intp=_NUMBER) as (first, _):
            block = builder.mul(first, builder.add(inputs, number(1)))
            for row, bias in zip(sums, scalars(block), strict=True):
                for variable in row:
                    builder.store(bias, variable)
            with cgutils.for_range(builder, inputs, intp=_NUMBER) as loop:
                values = [builder.load(place(into, loop.index, register), align=4) for register in registers]
                offset = builder.add(block, builder.mul(builder.add(loop.index, number(1)), number(TOGETHER)))
                for row, weight in zip(sums, scalars(offset), strict=True):
                    for variable, value in zip(row, values, strict=True):
                        product = builder.fmul(weight, value, flags=_FLAGS)
                        builder.store(builder.fadd(product, builder.load(variable), flags=_FLAGS), variable)
            for n, row in enumerate(sums):
                for register, variable in enumerate(row):
                    total = builder.load(variable)
                    positive = builder.fcmp_ordered(">", total, zero)
                    total = builder.select(arguments[5], builder.select(positive, total, zero), total)
                    builder.store(total, place(out, builder.add(first, number(n)), register), align=4)
        return context.get_dummy_value()

    return types.void(layer, at, x, y, sizes, rectified), generate
