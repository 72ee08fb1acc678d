"""Real spherical harmonics of bands 0 to 3 in Triton, and their gradients (see `invgraphics.core.harmonics`)."""

# pyright: reportMissingImports=false

from __future__ import annotations

from math import pi, sqrt

import triton
import triton.language as tl

_C0, _C1 = tl.constexpr(sqrt(1 / (4 * pi))), tl.constexpr(sqrt(3 / (4 * pi)))
_C2, _C20 = tl.constexpr(sqrt(15 / (4 * pi))), tl.constexpr(sqrt(5 / (16 * pi)))
_C30, _C31 = tl.constexpr(sqrt(7 / (16 * pi))), tl.constexpr(sqrt(21 / (32 * pi)))
_C32, _C33 = tl.constexpr(sqrt(105 / (4 * pi))), tl.constexpr(sqrt(35 / (32 * pi)))


@triton.jit
def harmonic(k: tl.constexpr, x, y, z):
    """Function ``k`` at unit directions, and its derivatives along x, y and z."""
    zero = tl.zeros_like(x)
    # A tensor comes first in every product: the interpreter makes no tensor of a constant times one.
    if k == 0:
        value, along_x, along_y, along_z = zero + _C0, zero, zero, zero
    elif k == 1:
        value, along_x, along_y, along_z = y * (-_C1), zero, zero - _C1, zero
    elif k == 2:
        value, along_x, along_y, along_z = z * _C1, zero, zero, zero + _C1
    elif k == 3:
        value, along_x, along_y, along_z = x * (-_C1), zero - _C1, zero, zero
    elif k == 4:
        value, along_x, along_y, along_z = x * _C2 * y, y * _C2, x * _C2, zero
    elif k == 5:
        value, along_x, along_y, along_z = y * (-_C2) * z, zero, z * (-_C2), y * (-_C2)
    elif k == 6:
        value = (2 * z * z - x * x - y * y) * _C20
        along_x, along_y, along_z = x * (-2 * _C20), y * (-2 * _C20), z * (4 * _C20)
    elif k == 7:
        value, along_x, along_y, along_z = x * (-_C2) * z, z * (-_C2), zero, x * (-_C2)
    elif k == 8:
        value, along_x, along_y, along_z = (x * x - y * y) * (_C2 / 2), x * _C2, y * (-_C2), zero
    elif k == 9:
        value = y * (-_C33) * (3 * x * x - y * y)
        along_x, along_y, along_z = x * (-6 * _C33) * y, (x * x - y * y) * (-3 * _C33), zero
    elif k == 10:
        value, along_x, along_y, along_z = x * _C32 * y * z, y * _C32 * z, x * _C32 * z, x * _C32 * y
    elif k == 11:
        value = y * (-_C31) * (4 * z * z - x * x - y * y)
        along_x, along_y, along_z = x * (2 * _C31) * y, (4 * z * z - x * x - 3 * y * y) * (-_C31), y * (-8 * _C31) * z
    elif k == 12:
        value = z * _C30 * (2 * z * z - 3 * x * x - 3 * y * y)
        along_x, along_y, along_z = x * (-6 * _C30) * z, y * (-6 * _C30) * z, (2 * z * z - x * x - y * y) * (3 * _C30)
    elif k == 13:
        value = x * (-_C31) * (4 * z * z - x * x - y * y)
        along_x, along_y, along_z = (4 * z * z - 3 * x * x - y * y) * (-_C31), x * (2 * _C31) * y, x * (-8 * _C31) * z
    elif k == 14:
        value = z * (_C32 / 2) * (x * x - y * y)
        along_x, along_y, along_z = x * _C32 * z, y * (-_C32) * z, (x * x - y * y) * (_C32 / 2)
    else:
        value = x * (-_C33) * (x * x - 3 * y * y)
        along_x, along_y, along_z = (x * x - y * y) * (-3 * _C33), x * (6 * _C33) * y, zero
    return value, along_x, along_y, along_z


@triton.jit
def colour_of(x, y, z, sh, i, mask, DEGREE: tl.constexpr):
    """Sums over functions of coefficient times value, of red, green and blue; ``sh`` is (n, (DEGREE + 1)², 3)."""
    COUNT: tl.constexpr = (DEGREE + 1) * (DEGREE + 1)
    red, green, blue = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for k in tl.static_range(COUNT):
        value, _, _, _ = harmonic(k, x, y, z)
        row = sh + (i * COUNT + k) * 3
        red += value * tl.load(row, mask=mask, other=0.0)
        green += value * tl.load(row + 1, mask=mask, other=0.0)
        blue += value * tl.load(row + 2, mask=mask, other=0.0)
    return red, green, blue


@triton.jit
def harmonics_backward(x, y, z, red, green, blue, sh, grad_sh, i, mask, DEGREE: tl.constexpr):
    """Store the coefficients' gradients; returns that of the direction, which is not yet projected onto the sphere."""
    COUNT: tl.constexpr = (DEGREE + 1) * (DEGREE + 1)
    grad_x, grad_y, grad_z = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for k in tl.static_range(COUNT):
        value, along_x, along_y, along_z = harmonic(k, x, y, z)
        row, to = sh + (i * COUNT + k) * 3, grad_sh + (i * COUNT + k) * 3
        tl.store(to, value * red, mask=mask)
        tl.store(to + 1, value * green, mask=mask)
        tl.store(to + 2, value * blue, mask=mask)
        share = red * tl.load(row, mask=mask, other=0.0) + green * tl.load(row + 1, mask=mask, other=0.0)
        share += blue * tl.load(row + 2, mask=mask, other=0.0)
        grad_x, grad_y, grad_z = grad_x + share * along_x, grad_y + share * along_y, grad_z + share * along_z
    return grad_x, grad_y, grad_z
