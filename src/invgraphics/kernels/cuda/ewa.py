"""EWA projection in Triton, one primitive per lane (definition: `invgraphics.kernels.reference.splat_project`).

Matrices are written out: in ``r01`` the digits are row and column. r is the camera's rotation to the world, m a primitive's, a
that of the primitive to the camera's axes (rᵀ m), and b is a with its columns scaled, a root of the covariance.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import torch
import triton
import triton.language as tl

from invgraphics.kernels import types
from invgraphics.kernels.cuda.harmonics import colour_of
from invgraphics.kernels.reference.splat_project import ILL_CONDITIONED, MARGIN, NEAR

_NEAR, _MARGIN = tl.constexpr(NEAR), tl.constexpr(MARGIN)
_THIN, _ALPHA_MIN = tl.constexpr(ILL_CONDITIONED), tl.constexpr(types.ALPHA_MIN)
COMPENSATION_MIN = tl.constexpr(types.COMPENSATION_MIN)
TINY, _EPSILON = tl.constexpr(torch.finfo(torch.float32).tiny), tl.constexpr(torch.finfo(torch.float32).eps)


@triton.jit
def vector_at(base, i, mask, other):
    """Three numbers of each primitive."""
    a, b = tl.load(base + 3 * i, mask=mask, other=other), tl.load(base + 3 * i + 1, mask=mask, other=other)
    return a, b, tl.load(base + 3 * i + 2, mask=mask, other=other)


@triton.jit
def store_vector(base, i, valid, visible, a, b, c):
    """Store three numbers of each primitive, zeros where it is culled."""
    tl.store(base + 3 * i, tl.where(visible, a, 0.0), mask=valid)
    tl.store(base + 3 * i + 1, tl.where(visible, b, 0.0), mask=valid)
    tl.store(base + 3 * i + 2, tl.where(visible, c, 0.0), mask=valid)


@triton.jit
def rotation_of(view):
    """The camera's rotation to the world, row by row."""
    return (
        tl.load(view), tl.load(view + 1), tl.load(view + 2), tl.load(view + 3), tl.load(view + 4), tl.load(view + 5),
        tl.load(view + 6), tl.load(view + 7), tl.load(view + 8),
    )  # fmt: skip


@triton.jit
def clamped_slope(view, axis: tl.constexpr, size, slope):
    """Slope of the mean on one image axis, clamped to the image plus a margin."""
    focal, centre = tl.load(view + 12 + axis), tl.load(view + 14 + axis)
    margin = _MARGIN * 0.5 * size / focal
    return tl.minimum(tl.maximum(slope, -centre / focal - margin), (size - centre) / focal + margin)


@triton.jit
def camera_point(i, valid, means, view):
    """Offset from the camera in world axes, and the mean in camera axes."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_of(view)
    ox, oy, oz = vector_at(means, i, valid, 0.0)
    ox, oy, oz = ox - tl.load(view + 9), oy - tl.load(view + 10), oz - tl.load(view + 11)
    x, y, z = ox * r00 + oy * r10 + oz * r20, ox * r01 + oy * r11 + oz * r21, ox * r02 + oy * r12 + oz * r22
    return ox, oy, oz, x, y, z


@triton.jit
def rotation_matrix(i, valid, quaternions):
    """Unit quaternion, the norm it was divided by, and its rotation matrix."""
    w, x = tl.load(quaternions + 4 * i, mask=valid, other=1.0), tl.load(quaternions + 4 * i + 1, mask=valid, other=0.0)
    y, z = tl.load(quaternions + 4 * i + 2, mask=valid, other=0.0), tl.load(quaternions + 4 * i + 3, mask=valid, other=0.0)
    norm = tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    return (
        w, x, y, z, norm,
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def axes_of(view, m00, m01, m02, m10, m11, m12, m20, m21, m22):
    """Rotation of a primitive to the camera's axes, rᵀ m."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_of(view)
    return (
        r00 * m00 + r10 * m10 + r20 * m20, r00 * m01 + r10 * m11 + r20 * m21, r00 * m02 + r10 * m12 + r20 * m22,
        r01 * m00 + r11 * m10 + r21 * m20, r01 * m01 + r11 * m11 + r21 * m21, r01 * m02 + r11 * m12 + r21 * m22,
        r02 * m00 + r12 * m10 + r22 * m20, r02 * m01 + r12 * m11 + r22 * m21, r02 * m02 + r12 * m12 + r22 * m22,
    )  # fmt: skip


@triton.jit
def area_of(x0, x1, x2, y0, y1, y2):
    """Squared area that the two rows span: the covariance's determinant, without cancellation for thin footprints."""
    c0, c1, c2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    return c0 * c0 + c1 * c1 + c2 * c2


@triton.jit(do_not_specialize=["n"])
def project(
    means, quaternions, scales, opacities, sh, view, n, width, height, dilation,
    means2d, conics, depths, planes, radii, rgb, compensations,
    DEGREE: tl.constexpr, ANTIALIASED: tl.constexpr, SIZE: tl.constexpr,
):  # fmt: skip
    """Footprints and colours of a block of primitives; culled ones get radius 0 and finite values."""
    i = tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)
    valid = i < n
    ox, oy, oz, mx, my, depth = camera_point(i, valid, means, view)
    in_front = depth > _NEAR
    mz = tl.where(in_front, depth, 1.0)
    _, _, _, _, _, m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotation_matrix(i, valid, quaternions)
    a00, a01, a02, a10, a11, a12, a20, a21, a22 = axes_of(view, m00, m01, m02, m10, m11, m12, m20, m21, m22)
    s0, s1, s2 = vector_at(scales, i, valid, 1.0)
    b00, b01, b02, b10, b11, b12 = a00 * s0, a01 * s1, a02 * s2, a10 * s0, a11 * s1, a12 * s2
    b20, b21, b22 = a20 * s0, a21 * s1, a22 * s2
    sx, sy = clamped_slope(view, 0, width, mx / mz), clamped_slope(view, 1, height, my / mz)
    fx, fy = tl.load(view + 12) / mz, tl.load(view + 13) / mz
    x0, x1, x2 = fx * (b00 - sx * b20), fx * (b01 - sx * b21), fx * (b02 - sx * b22)
    y0, y1, y2 = fy * (b10 - sy * b20), fy * (b11 - sy * b21), fy * (b12 - sy * b22)
    xx, xy, yy = x0 * x0 + x1 * x1 + x2 * x2, x0 * y0 + x1 * y1 + x2 * y2, y0 * y0 + y1 * y1 + y2 * y2
    area = area_of(x0, x1, x2, y0, y1, y2)
    det = tl.maximum(area + dilation * (xx + yy) + dilation * dilation, TINY)
    compensation = tl.full((SIZE,), 1.0, tl.float32)
    if ANTIALIASED:
        compensation = tl.maximum(tl.sqrt(tl.maximum(area, TINY) / det), COMPENSATION_MIN)
    wide, high = xx + dilation, yy + dilation
    u, v = tl.load(view + 14) + fx * mx, tl.load(view + 15) + fy * my
    opacity = tl.load(opacities + i, mask=valid, other=0.0) * compensation
    reach = tl.sqrt(2 * tl.log(tl.maximum(opacity / _ALPHA_MIN, 1.0)))
    reach_x, reach_y = reach * tl.sqrt(wide), reach * tl.sqrt(high)
    half = (wide - high) / 2
    largest = (wide + high) / 2 + tl.sqrt(half * half + xy * xy)
    meets = (u + reach_x > 0) & (u - reach_x < width) & (v + reach_y > 0) & (v - reach_y < height) & (reach > 0)
    visible = in_front & meets & valid
    tl.store(depths + i, depth, mask=valid)
    tl.store(radii + i, tl.where(visible, reach * tl.sqrt(largest), 0.0), mask=valid)
    tl.store(compensations + i, tl.where(in_front, compensation, 1.0), mask=valid)
    tl.store(means2d + 2 * i, tl.where(visible, u, 0.0), mask=valid)
    tl.store(means2d + 2 * i + 1, tl.where(visible, v, 0.0), mask=valid)
    tl.store(conics + 3 * i, tl.where(visible, high / det, 1.0), mask=valid)
    tl.store(conics + 3 * i + 1, tl.where(visible, -xy / det, 0.0), mask=valid)
    tl.store(conics + 3 * i + 2, tl.where(visible, wide / det, 1.0), mask=valid)
    # Depth plane: dilation is no part of the shape, but thin footprints need some.
    distance = tl.sqrt(mx * mx + my * my + mz * mz)
    d0, d1 = (mx * b00 + my * b10 + mz * b20) / distance, (mx * b01 + my * b11 + mz * b21) / distance
    d2 = (mx * b02 + my * b12 + mz * b22) / distance
    bare = tl.maximum(area, TINY)
    blur = tl.where(bare < _THIN * (xx + yy) * (xx + yy), tl.maximum(dilation, _EPSILON), 0.0)
    bare = tl.maximum(area + blur * (xx + yy) + blur * blur, TINY)
    along_x, along_y = d0 * x0 + d1 * x1 + d2 * x2, d0 * y0 + d1 * y1 + d2 * y2
    slope_x, slope_y = (along_x * (yy + blur) - along_y * xy) / bare, (along_y * (xx + blur) - along_x * xy) / bare
    store_vector(planes, i, valid, visible, distance, slope_x, slope_y)
    away = tl.maximum(tl.sqrt(ox * ox + oy * oy + oz * oz), 1e-12)
    red, green, blue = colour_of(ox / away, oy / away, oz / away, sh, i, visible, DEGREE)
    red, green, blue = tl.maximum(red + 0.5, 0.0), tl.maximum(green + 0.5, 0.0), tl.maximum(blue + 0.5, 0.0)
    store_vector(rgb, i, valid, visible, red, green, blue)
