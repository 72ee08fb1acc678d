"""EWA projection, backward."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.ewa import (
    FOCAL,
    camera_point,
    column,
    dot,
    fade_of,
    four,
    matrix_of,
    normalised,
    rotation_of,
    scaled_axes,
    scaled_columns,
    screen_axes,
    three,
)
from invgraphics.kernels.numba.harmonics import harmonics, harmonics_gradient
from invgraphics.kernels.numba.runtime import index, inlined, parallel, prange, share
from invgraphics.kernels.types import FADE_MIN

_ZERO, _HALF, _ONE, _TWO = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))
_FADE_MIN = np.float32(FADE_MIN)


@inlined
def _through_inverse(conic, g):
    """Gradient along the covariance (xx, xy, yy) from that along its inverse: -C G C, G symmetric."""
    a, b, c = conic[0], conic[1], conic[2]
    g0, g1, g2 = g[0], _HALF * g[1], g[2]
    p, q = a * g0 + b * g1, a * g1 + b * g2
    r, s = b * g0 + c * g1, b * g1 + c * g2
    return -(p * a + q * b), -_TWO * (p * b + q * c), -(r * b + s * c)


@inlined
def _through_fade(x, y, dilation, conic, to_fade):
    """Gradients along the screen axes: d ln fade = (d area / area - d det / det) / 2, both quadratic in the axes."""
    fade, xx, xy, yy, area = fade_of(x, y, dilation)
    g = to_fade * fade if fade > _FADE_MIN else _ZERO
    a, b, c = g * (yy / area - conic[0]), -g * (xy / area + conic[1]), g * (xx / area - conic[2])
    return (
        (a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2]),
        (b * x[0] + c * y[0], b * x[1] + c * y[1], b * x[2] + c * y[2]),
    )


@inlined
def _through_screen(view, dilation, mean, root, conic, to_conic, to_mean2d, to_fade):
    """Gradients along the mean in camera axes and along the covariance's root."""
    x, y, sx, sy = screen_axes(view, mean, root)
    gxx, gxy, gyy = _through_inverse(conic, to_conic)
    gx = (_TWO * gxx * x[0] + gxy * y[0], _TWO * gxx * x[1] + gxy * y[1], _TWO * gxx * x[2] + gxy * y[2])
    gy = (_TWO * gyy * y[0] + gxy * x[0], _TWO * gyy * y[1] + gxy * x[1], _TWO * gyy * y[2] + gxy * x[2])
    if to_fade != _ZERO:
        hx, hy = _through_fade(x, y, dilation, conic, to_fade)
        gx = (gx[0] + hx[0], gx[1] + hx[1], gx[2] + hx[2])
        gy = (gy[0] + hy[0], gy[1] + hy[1], gy[2] + hy[2])
    inverse = _ONE / mean[2]
    fx, fy = view[FOCAL] * inverse, view[FOCAL + 1] * inverse
    to_root = (
        (fx * gx[0], fx * gx[1], fx * gx[2]),
        (fy * gy[0], fy * gy[1], fy * gy[2]),
        (-fx * sx * gx[0] - fy * sy * gy[0], -fx * sx * gx[1] - fy * sy * gy[1], -fx * sx * gx[2] - fy * sy * gy[2]),
    )
    # Both rows are proportional to 1 / z, and the slopes move with the mean where they are not clamped.
    slope_x, slope_y = mean[0] * inverse, mean[1] * inverse
    to_slope_x = -fx * dot(gx, root[2]) if sx == slope_x else _ZERO
    to_slope_y = -fy * dot(gy, root[2]) if sy == slope_y else _ZERO
    to_slope_x += view[FOCAL] * to_mean2d[0]
    to_slope_y += view[FOCAL + 1] * to_mean2d[1]
    to_z = -inverse * (dot(gx, x) + dot(gy, y) + to_slope_x * slope_x + to_slope_y * slope_y)
    return (to_slope_x * inverse, to_slope_y * inverse, to_z), to_root


@inlined
def _to_quaternion(q, norm, m):
    """Gradient along a quaternion from that along its rotation matrix, through the normalisation."""
    w, x, y, z = q
    m0, m1, m2 = m
    dw = _TWO * (z * (m1[0] - m0[1]) + y * (m0[2] - m2[0]) + x * (m2[1] - m1[2]))
    dx = _TWO * (y * (m0[1] + m1[0]) + z * (m0[2] + m2[0]) + w * (m2[1] - m1[2]) - _TWO * x * (m1[1] + m2[2]))
    dy = _TWO * (x * (m0[1] + m1[0]) + z * (m1[2] + m2[1]) + w * (m0[2] - m2[0]) - _TWO * y * (m0[0] + m2[2]))
    dz = _TWO * (x * (m0[2] + m2[0]) + y * (m1[2] + m2[1]) + w * (m1[0] - m0[1]) - _TWO * z * (m0[0] + m1[1]))
    along = w * dw + x * dx + y * dy + z * dz
    return (dw - w * along) / norm, (dx - x * along) / norm, (dy - y * along) / norm, (dz - z * along) / norm


@inlined
def _through_colour(offset, sh, i, colour, to_colour, to_sh, weights, along):
    """Write the gradients along the coefficients; returns the gradient along the offset from the camera."""
    distance = np.sqrt(dot(offset, offset))
    d = (offset[0] / distance, offset[1] / distance, offset[2] / distance)
    # Colours are cut off at zero.
    red = to_colour[0] if colour[0] > _ZERO else _ZERO
    green = to_colour[1] if colour[1] > _ZERO else _ZERO
    blue = to_colour[2] if colour[2] > _ZERO else _ZERO
    harmonics(d, weights)
    for number in range(sh.shape[1]):
        k = index(number)
        to_sh[i, k, 0], to_sh[i, k, 1], to_sh[i, k, 2] = weights[k] * red, weights[k] * green, weights[k] * blue
        along[k] = sh[i, k, 0] * red + sh[i, k, 1] * green + sh[i, k, 2] * blue
    g = harmonics_gradient(d, along)
    radial = dot(g, d)
    return (g[0] - d[0] * radial) / distance, (g[1] - d[1] * radial) / distance, (g[2] - d[2] * radial) / distance


@inlined
def _product(a, b):
    """``a b``."""
    b0, b1, b2 = column(b, 0), column(b, 1), column(b, 2)
    return (
        (dot(a[0], b0), dot(a[0], b1), dot(a[0], b2)),
        (dot(a[1], b0), dot(a[1], b1), dot(a[1], b2)),
        (dot(a[2], b0), dot(a[2], b1), dot(a[2], b2)),
    )


@inlined
def _through_pose(offset, turned, to_turn, to_mean, to_world_mean):
    """A primitive's share of the gradient along the camera's rotation (row by row) and position."""
    (x, y, z), (a, b, c), (p, q, r) = offset, to_mean, turned
    u, v, w = to_turn
    return (
        x * a + dot(p, u), x * b + dot(p, v), x * c + dot(p, w),
        y * a + dot(q, u), y * b + dot(q, v), y * c + dot(q, w),
        z * a + dot(r, u), z * b + dot(r, v), z * c + dot(r, w),
        -to_world_mean[0], -to_world_mean[1], -to_world_mean[2],
    )  # fmt: skip


@parallel
def project_back(
    view, dilation, means, quaternions, scales, sh, radii, conics, rgb,
    to_means2d, to_conics, to_depths, to_rgb, to_fades,
    to_means, to_quaternions, to_scales, to_sh, pose,
):  # fmt: skip
    """Write the gradients along the primitives and, per job, along the camera's pose."""
    n, jobs = sh.shape[0], pose.shape[0]
    for job in prange(jobs):
        weights, along = np.empty(16, np.float32), np.zeros(16, np.float32)
        rotation = rotation_of(view)
        pose[job, :] = 0.0
        for number in range(share(n, jobs, job), share(n, jobs, job + 1)):
            i = index(number)
            if radii[i] > _ZERO:
                offset, mean = camera_point(view, three(means, i))
                q, norm = normalised(four(quaternions, i))
                s = three(scales, i)
                turn, root = scaled_axes(view, q, s)
                to_mean2d = to_means2d[i, 0], to_means2d[i, 1]
                to_mean, to_root = _through_screen(
                    view, dilation, mean, root, three(conics, i), three(to_conics, i), to_mean2d, to_fades[i]
                )
                to_mean = (to_mean[0], to_mean[1], to_mean[2] + to_depths[i])
                to_turn = scaled_columns(to_root, s)
                w, x, y, z = _to_quaternion(q, norm, _product(rotation, to_turn))
                to_quaternions[i, 0], to_quaternions[i, 1], to_quaternions[i, 2], to_quaternions[i, 3] = w, x, y, z
                for k in range(3):
                    to_scales[i, k] = dot(column(to_root, k), column(turn, k))
                colour = _through_colour(offset, sh, i, three(rgb, i), three(to_rgb, i), to_sh, weights, along)
                a, b, c = dot(rotation[0], to_mean), dot(rotation[1], to_mean), dot(rotation[2], to_mean)
                world = (a + colour[0], b + colour[1], c + colour[2])
                to_means[i, 0], to_means[i, 1], to_means[i, 2] = world
                shares = _through_pose(offset, matrix_of(q), to_turn, to_mean, world)
                for k in range(12):
                    pose[job, k] += shares[k]
            else:
                to_means[i, 0], to_means[i, 1], to_means[i, 2] = _ZERO, _ZERO, _ZERO
                to_scales[i, 0], to_scales[i, 1], to_scales[i, 2] = _ZERO, _ZERO, _ZERO
                to_quaternions[i, 0], to_quaternions[i, 1] = _ZERO, _ZERO
                to_quaternions[i, 2], to_quaternions[i, 3] = _ZERO, _ZERO
                for k in range(sh.shape[1]):
                    to_sh[i, index(k), 0], to_sh[i, index(k), 1], to_sh[i, index(k), 2] = _ZERO, _ZERO, _ZERO
