"""Gradients of the EWA projection in Triton; names of matrices are those of `invgraphics.kernels.cuda.ewa`."""

# pyright: reportMissingImports=false

from __future__ import annotations

import triton
import triton.language as tl

from invgraphics.kernels.cuda.ewa import (
    COMPENSATION_MIN,
    TINY,
    area_of,
    axes_of,
    camera_point,
    clamped_slope,
    rotation_matrix,
    rotation_of,
    store_vector,
    vector_at,
)
from invgraphics.kernels.cuda.harmonics import harmonics_backward


@triton.jit
def _unclamped(colour, gradient):
    """Gradient through max(0, colour): where it is cut off, only what would raise it (see `core.harmonics.colour`)."""
    return tl.where((colour > 0) | (gradient < 0), gradient, 0.0)


@triton.jit
def _total(visible, values):
    """Sum over the visible primitives of a block."""
    return tl.sum(tl.where(visible, values, 0.0), axis=0)


@triton.jit
def _rows_backward(
    i, valid, visible, conics, grad_conics, grad_compensations, dilation, x0, x1, x2, y0, y1, y2, ANTIALIASED: tl.constexpr
):  # fmt: skip
    """Gradients of the rows x and y, whose products are the covariance on the screen."""
    # The conic C is the covariance's inverse, whose gradient is -C G C with G symmetric.
    c0, c1, c2 = vector_at(conics, i, valid, 1.0)
    g0, g1, g2 = vector_at(grad_conics, i, visible, 0.0)
    g1 = g1 / 2
    p, q, r, s = c0 * g0 + c1 * g1, c0 * g1 + c1 * g2, c1 * g0 + c2 * g1, c1 * g1 + c2 * g2
    gxx, gxy, gyy = -(p * c0 + q * c1), -2 * (p * c1 + q * c2), -(r * c1 + s * c2)
    gx0, gx1, gx2 = 2 * gxx * x0 + gxy * y0, 2 * gxx * x1 + gxy * y1, 2 * gxx * x2 + gxy * y2
    gy0, gy1, gy2 = 2 * gyy * y0 + gxy * x0, 2 * gyy * y1 + gxy * x1, 2 * gyy * y2 + gxy * x2
    if ANTIALIASED:
        # d ln compensation = (d area / area - d det / det) / 2, both quadratic in the rows x and y.
        xx, xy, yy = x0 * x0 + x1 * x1 + x2 * x2, x0 * y0 + x1 * y1 + x2 * y2, y0 * y0 + y1 * y1 + y2 * y2
        area = tl.maximum(area_of(x0, x1, x2, y0, y1, y2), TINY)
        det = tl.maximum(area + dilation * (xx + yy) + dilation * dilation, TINY)
        compensation = tl.sqrt(area / det)
        g = tl.load(grad_compensations + i, mask=visible, other=0.0) * compensation
        counts = compensation > COMPENSATION_MIN
        # Set to 0 behind the divisions: of an area that underflowed they are infinite, and 0 times that is NaN.
        e = tl.where(counts, g * (yy / area - c0), 0.0)
        f = tl.where(counts, -g * (xy / area + c1), 0.0)
        h = tl.where(counts, g * (xx / area - c2), 0.0)
        gx0, gx1, gx2 = gx0 + e * x0 + f * y0, gx1 + e * x1 + f * y1, gx2 + e * x2 + f * y2
        gy0, gy1, gy2 = gy0 + f * x0 + h * y0, gy1 + f * x1 + h * y1, gy2 + f * x2 + h * y2
    return gx0, gx1, gx2, gy0, gy1, gy2


@triton.jit
def _rotation_backward(
    i, valid, visible, view, w, x, y, z, norm, a00, a01, a02, a10, a11, a12, a20, a21, a22, grad_quaternions
):  # fmt: skip
    """Gradient of the quaternions from that of the axes a, through the primitive's rotation m = r a."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_of(view)
    g00, g01, g02 = r00 * a00 + r01 * a10 + r02 * a20, r00 * a01 + r01 * a11 + r02 * a21, r00 * a02 + r01 * a12 + r02 * a22
    g10, g11, g12 = r10 * a00 + r11 * a10 + r12 * a20, r10 * a01 + r11 * a11 + r12 * a21, r10 * a02 + r11 * a12 + r12 * a22
    g20, g21, g22 = r20 * a00 + r21 * a10 + r22 * a20, r20 * a01 + r21 * a11 + r22 * a21, r20 * a02 + r21 * a12 + r22 * a22
    dw = 2 * (z * (g10 - g01) + y * (g02 - g20) + x * (g21 - g12))
    dx = 2 * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - 2 * x * (g11 + g22))
    dy = 2 * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - 2 * y * (g00 + g22))
    dz = 2 * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - 2 * z * (g00 + g11))
    along = w * dw + x * dx + y * dy + z * dz
    tl.store(grad_quaternions + 4 * i, tl.where(visible, (dw - w * along) / norm, 0.0), mask=valid)
    tl.store(grad_quaternions + 4 * i + 1, tl.where(visible, (dx - x * along) / norm, 0.0), mask=valid)
    tl.store(grad_quaternions + 4 * i + 2, tl.where(visible, (dy - y * along) / norm, 0.0), mask=valid)
    tl.store(grad_quaternions + 4 * i + 3, tl.where(visible, (dz - z * along) / norm, 0.0), mask=valid)


@triton.jit
def _colour_backward(i, valid, visible, ox, oy, oz, rgb, grad_rgb, sh, grad_sh, DEGREE: tl.constexpr):
    """Gradients of the harmonics' coefficients, and of the offset from the camera through the direction of view."""
    away = tl.where(visible, tl.maximum(tl.sqrt(ox * ox + oy * oy + oz * oz), 1e-12), 1.0)
    red, green, blue = vector_at(rgb, i, visible, 0.0)
    grad_red, grad_green, grad_blue = vector_at(grad_rgb, i, visible, 0.0)
    red, green, blue = _unclamped(red, grad_red), _unclamped(green, grad_green), _unclamped(blue, grad_blue)
    ex, ey, ez = ox / away, oy / away, oz / away
    tx, ty, tz = harmonics_backward(ex, ey, ez, red, green, blue, sh, grad_sh, i, valid, DEGREE)
    radial = tx * ex + ty * ey + tz * ez
    return (tx - ex * radial) / away, (ty - ey * radial) / away, (tz - ez * radial) / away


@triton.jit
def _pose_backward(
    pose, visible, ox, oy, oz, grad_x, grad_y, grad_z, world_x, world_y, world_z,
    m00, m01, m02, m10, m11, m12, m20, m21, m22, a00, a01, a02, a10, a11, a12, a20, a21, a22,
):  # fmt: skip
    """A block's part of the gradient of the camera's rotation, row by row, and of its position."""
    tl.store(pose, _total(visible, ox * grad_x + m00 * a00 + m01 * a01 + m02 * a02))
    tl.store(pose + 1, _total(visible, ox * grad_y + m00 * a10 + m01 * a11 + m02 * a12))
    tl.store(pose + 2, _total(visible, ox * grad_z + m00 * a20 + m01 * a21 + m02 * a22))
    tl.store(pose + 3, _total(visible, oy * grad_x + m10 * a00 + m11 * a01 + m12 * a02))
    tl.store(pose + 4, _total(visible, oy * grad_y + m10 * a10 + m11 * a11 + m12 * a12))
    tl.store(pose + 5, _total(visible, oy * grad_z + m10 * a20 + m11 * a21 + m12 * a22))
    tl.store(pose + 6, _total(visible, oz * grad_x + m20 * a00 + m21 * a01 + m22 * a02))
    tl.store(pose + 7, _total(visible, oz * grad_y + m20 * a10 + m21 * a11 + m22 * a12))
    tl.store(pose + 8, _total(visible, oz * grad_z + m20 * a20 + m21 * a21 + m22 * a22))
    tl.store(pose + 9, -_total(visible, world_x))
    tl.store(pose + 10, -_total(visible, world_y))
    tl.store(pose + 11, -_total(visible, world_z))


@triton.jit(do_not_specialize=["n"])
def project_backward(
    means, quaternions, scales, sh, view, conics, radii, rgb, n, width, height, dilation,
    grad_means2d, grad_conics, grad_depths, grad_rgb, grad_compensations,
    grad_means, grad_quaternions, grad_scales, grad_sh, grad_pose,
    DEGREE: tl.constexpr, ANTIALIASED: tl.constexpr, SIZE: tl.constexpr,
):  # fmt: skip
    """Gradients of a block of primitives, and the block's part of the gradient of the camera's pose."""
    i = tl.program_id(0).to(tl.int64) * SIZE + tl.arange(0, SIZE)
    valid = i < n
    visible = valid & (tl.load(radii + i, mask=valid, other=0.0) > 0)
    ox, oy, oz, mx, my, mz = camera_point(i, visible, means, view)
    mz = tl.where(visible, mz, 1.0)
    w, x, y, z, norm, m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotation_matrix(i, valid, quaternions)
    a00, a01, a02, a10, a11, a12, a20, a21, a22 = axes_of(view, m00, m01, m02, m10, m11, m12, m20, m21, m22)
    s0, s1, s2 = vector_at(scales, i, valid, 1.0)
    b00, b01, b02, b10, b11, b12 = a00 * s0, a01 * s1, a02 * s2, a10 * s0, a11 * s1, a12 * s2
    b20, b21, b22 = a20 * s0, a21 * s1, a22 * s2
    slope_x, slope_y = mx / mz, my / mz
    sx, sy = clamped_slope(view, 0, width, slope_x), clamped_slope(view, 1, height, slope_y)
    focal_x, focal_y = tl.load(view + 12), tl.load(view + 13)
    fx, fy = focal_x / mz, focal_y / mz
    x0, x1, x2 = fx * (b00 - sx * b20), fx * (b01 - sx * b21), fx * (b02 - sx * b22)
    y0, y1, y2 = fy * (b10 - sy * b20), fy * (b11 - sy * b21), fy * (b12 - sy * b22)

    gx0, gx1, gx2, gy0, gy1, gy2 = _rows_backward(
        i, valid, visible, conics, grad_conics, grad_compensations, dilation, x0, x1, x2, y0, y1, y2, ANTIALIASED
    )

    # Both rows are proportional to 1 / z, and the slopes move with the mean where they are not clamped.
    grad_sx = tl.where(sx == slope_x, -fx * (gx0 * b20 + gx1 * b21 + gx2 * b22), 0.0)
    grad_sy = tl.where(sy == slope_y, -fy * (gy0 * b20 + gy1 * b21 + gy2 * b22), 0.0)
    grad_sx += focal_x * tl.load(grad_means2d + 2 * i, mask=visible, other=0.0)
    grad_sy += focal_y * tl.load(grad_means2d + 2 * i + 1, mask=visible, other=0.0)
    rows = gx0 * x0 + gx1 * x1 + gx2 * x2 + gy0 * y0 + gy1 * y1 + gy2 * y2
    grad_x, grad_y = grad_sx / mz, grad_sy / mz
    grad_z = tl.load(grad_depths + i, mask=visible, other=0.0) - (rows + grad_sx * slope_x + grad_sy * slope_y) / mz

    # The root's gradient, and from it those of the scales, of the axes a and of the quaternions.
    b00, b01, b02, b10, b11, b12 = fx * gx0, fx * gx1, fx * gx2, fy * gy0, fy * gy1, fy * gy2
    b20, b21, b22 = -sx * b00 - sy * b10, -sx * b01 - sy * b11, -sx * b02 - sy * b12
    along_0, along_1 = b00 * a00 + b10 * a10 + b20 * a20, b01 * a01 + b11 * a11 + b21 * a21
    store_vector(grad_scales, i, valid, visible, along_0, along_1, b02 * a02 + b12 * a12 + b22 * a22)
    a00, a01, a02, a10, a11, a12 = b00 * s0, b01 * s1, b02 * s2, b10 * s0, b11 * s1, b12 * s2
    a20, a21, a22 = b20 * s0, b21 * s1, b22 * s2
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_of(view)
    _rotation_backward(i, valid, visible, view, w, x, y, z, norm, a00, a01, a02, a10, a11, a12, a20, a21, a22, grad_quaternions)

    tx, ty, tz = _colour_backward(i, valid, visible, ox, oy, oz, rgb, grad_rgb, sh, grad_sh, DEGREE)
    world_x = r00 * grad_x + r01 * grad_y + r02 * grad_z + tx
    world_y = r10 * grad_x + r11 * grad_y + r12 * grad_z + ty
    world_z = r20 * grad_x + r21 * grad_y + r22 * grad_z + tz
    store_vector(grad_means, i, valid, visible, world_x, world_y, world_z)
    pose = grad_pose + tl.program_id(0) * 12
    _pose_backward(
        pose, visible, ox, oy, oz, grad_x, grad_y, grad_z, world_x, world_y, world_z,
    m00, m01, m02, m10, m11, m12, m20, m21, m22, a00, a01, a02, a10, a11, a12, a20, a21, a22,
    )  # fmt: skip
