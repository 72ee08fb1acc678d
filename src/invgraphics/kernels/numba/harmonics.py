"""Real spherical harmonics of bands 0 to 3 and their gradients (see `invgraphics.core.harmonics`)."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from invgraphics.kernels.numba.runtime import LANES, index, inlined

_C0 = np.float32(sqrt(1 / (4 * pi)))
_C1 = np.float32(sqrt(3 / (4 * pi)))
_C2, _C20 = np.float32(sqrt(15 / (4 * pi))), np.float32(sqrt(5 / (16 * pi)))
_C30, _C31 = np.float32(sqrt(7 / (16 * pi))), np.float32(sqrt(21 / (32 * pi)))
_C32, _C33 = np.float32(sqrt(105 / (4 * pi))), np.float32(sqrt(35 / (32 * pi)))
_1, _2, _3, _4, _5, _6, _7, _8, _9, _10, _11, _12, _13, _14, _15 = (index(k) * LANES for k in range(1, 16))
_HALF, _TWO, _THREE, _FOUR, _SIX = (np.float32(value) for value in (0.5, 2, 3, 4, 6))


@inlined
def harmonics(d, out, at):
    """Evaluate all 16 functions at the unit direction ``d``; function k goes to ``out[at + k LANES]``.

    All of them whatever the degree: a branch would prevent vectorisation over primitives.
    """
    x, y, z = d
    xx, yy, zz = x * x, y * y, z * z
    out[at], out[at + _1], out[at + _2], out[at + _3] = _C0, -_C1 * y, _C1 * z, -_C1 * x
    out[at + _4], out[at + _5], out[at + _7] = _C2 * x * y, -_C2 * y * z, -_C2 * x * z
    out[at + _6] = _C20 * (_TWO * zz - xx - yy)
    out[at + _8] = _HALF * _C2 * (xx - yy)
    out[at + _9] = -_C33 * y * (_THREE * xx - yy)
    out[at + _10] = _C32 * x * y * z
    out[at + _11] = -_C31 * y * (_FOUR * zz - xx - yy)
    out[at + _12] = _C30 * z * (_TWO * zz - _THREE * xx - _THREE * yy)
    out[at + _13] = -_C31 * x * (_FOUR * zz - xx - yy)
    out[at + _14] = _HALF * _C32 * z * (xx - yy)
    out[at + _15] = -_C33 * x * (xx - _THREE * yy)


@inlined
def harmonics_gradient(d, g, at):
    """Gradient in ``d`` of the sum of ``g[at + k LANES]`` times function k, k from 0 to 15."""
    x, y, z = d
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    g1, g2, g3, g4, g5 = g[at + _1], g[at + _2], g[at + _3], g[at + _4], g[at + _5]
    g6, g7, g8, g9, g10 = g[at + _6], g[at + _7], g[at + _8], g[at + _9], g[at + _10]
    g11, g12, g13, g14, g15 = g[at + _11], g[at + _12], g[at + _13], g[at + _14], g[at + _15]
    gx = -_C1 * g3 + _C2 * (y * g4 - z * g7 + x * g8) - _TWO * _C20 * x * g6
    gy = -_C1 * g1 + _C2 * (x * g4 - z * g5 - y * g8) - _TWO * _C20 * y * g6
    gz = _C1 * g2 - _C2 * (y * g5 + x * g7) + _FOUR * _C20 * z * g6
    gx += _C33 * (-_SIX * xy * g9 - _THREE * (xx - yy) * g15) + _C32 * (yz * g10 + xz * g14)
    gx += _C31 * (_TWO * xy * g11 - (_FOUR * zz - _THREE * xx - yy) * g13) - _SIX * _C30 * xz * g12
    gy += _C33 * (-_THREE * (xx - yy) * g9 + _SIX * xy * g15) + _C32 * (xz * g10 - yz * g14)
    gy += _C31 * (-(_FOUR * zz - xx - _THREE * yy) * g11 + _TWO * xy * g13) - _SIX * _C30 * yz * g12
    gz += _C32 * (xy * g10 + _HALF * (xx - yy) * g14) - _C31 * (_FOUR + _FOUR) * (yz * g11 + xz * g13)
    gz += _C30 * _THREE * (_TWO * zz - xx - yy) * g12
    return gx, gy, gz
