"""SIMD registers moved by one lane: neighbouring values of a sequence that spans several registers."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import types

from invgraphics.kernels.numba.runtime import GROUP
from invgraphics.kernels.numba.simd.lanes import lanes

_WORD = ir.IntType(32)

# Drops the first parameter, in a way that no checker can follow.
_intrinsic: Any = extending.intrinsic


@_intrinsic
def first_lane(typing: Any, value: Any) -> Any:
    """Value of the first lane."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.extract_element(arguments[0], ir.Constant(_WORD, 0))

    return types.float32(lanes), generate


@_intrinsic
def shift_in(typing: Any, value: Any, last: Any) -> Any:
    """Each lane's successor: lane k gets lane k + 1, and the last one gets ``last``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        behind = builder.insert_element(ir.Constant(lanes.layout, ir.Undefined), arguments[1], ir.Constant(_WORD, 0))
        moved = ir.Constant(ir.VectorType(_WORD, GROUP), list(range(1, GROUP + 1)))
        return builder.shuffle_vector(arguments[0], behind, moved)

    return lanes(lanes, types.float32), generate
