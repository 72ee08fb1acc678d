"""Real spherical harmonics of bands 0 to 3 and their gradients (see `invgraphics.core.harmonics`)."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from invgraphics.kernels.numba.runtime import inlined

_C0 = np.float32(sqrt(1 / (4 * pi)))
_C1 = np.float32(sqrt(3 / (4 * pi)))
_C2, _C20 = np.float32(sqrt(15 / (4 * pi))), np.float32(sqrt(5 / (16 * pi)))
_C30, _C31 = np.float32(sqrt(7 / (16 * pi))), np.float32(sqrt(21 / (32 * pi)))
_C32, _C33 = np.float32(sqrt(105 / (4 * pi))), np.float32(sqrt(35 / (32 * pi)))
_HALF, _TWO, _THREE, _FOUR, _SIX = (np.float32(value) for value in (0.5, 2, 3, 4, 6))


@inlined
def harmonics(d, out):
    """Write all 16 functions at the unit direction ``d`` to ``out``.

    All of them whatever the degree: branches would keep calls that count references of ``out`` in the loop over primitives.
    """
    x, y, z = d
    xx, yy, zz = x * x, y * y, z * z
    out[0], out[1], out[2], out[3] = _C0, -_C1 * y, _C1 * z, -_C1 * x
    out[4], out[5], out[7] = _C2 * x * y, -_C2 * y * z, -_C2 * x * z
    out[6] = _C20 * (_TWO * zz - xx - yy)
    out[8] = _HALF * _C2 * (xx - yy)
    out[9] = -_C33 * y * (_THREE * xx - yy)
    out[10] = _C32 * x * y * z
    out[11] = -_C31 * y * (_FOUR * zz - xx - yy)
    out[12] = _C30 * z * (_TWO * zz - _THREE * xx - _THREE * yy)
    out[13] = -_C31 * x * (_FOUR * zz - xx - yy)
    out[14] = _HALF * _C32 * z * (xx - yy)
    out[15] = -_C33 * x * (xx - _THREE * yy)


@inlined
def harmonics_gradient(d, g):
    """Gradient along ``d`` of the sum of ``g[k]`` times function k, k from 0 to 15."""
    x, y, z = d
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    gx = -_C1 * g[3] + _C2 * (y * g[4] - z * g[7] + x * g[8]) - _TWO * _C20 * x * g[6]
    gy = -_C1 * g[1] + _C2 * (x * g[4] - z * g[5] - y * g[8]) - _TWO * _C20 * y * g[6]
    gz = _C1 * g[2] - _C2 * (y * g[5] + x * g[7]) + _FOUR * _C20 * z * g[6]
    gx += _C33 * (-_SIX * xy * g[9] - _THREE * (xx - yy) * g[15]) + _C32 * (yz * g[10] + xz * g[14])
    gx += _C31 * (_TWO * xy * g[11] - (_FOUR * zz - _THREE * xx - yy) * g[13]) - _SIX * _C30 * xz * g[12]
    gy += _C33 * (-_THREE * (xx - yy) * g[9] + _SIX * xy * g[15]) + _C32 * (xz * g[10] - yz * g[14])
    gy += _C31 * (-(_FOUR * zz - xx - _THREE * yy) * g[11] + _TWO * xy * g[13]) - _SIX * _C30 * yz * g[12]
    gz += _C32 * (xy * g[10] + _HALF * (xx - yy) * g[14]) - _C31 * (_FOUR + _FOUR) * (yz * g[11] + xz * g[13])
    gz += _C30 * _THREE * (_TWO * zz - xx - yy) * g[12]
    return gx, gy, gz
