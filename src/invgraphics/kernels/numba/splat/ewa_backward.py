"""EWA projection, backward: gradients of primitives and camera pose, one primitive per SIMD lane like the forward pass."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.harmonics import harmonics, harmonics_gradient
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined, job_start, parallel, prange
from invgraphics.kernels.numba.simd.layouts import read_1, read_2, read_3, write_3, write_4
from invgraphics.kernels.numba.splat.ewa import (
    FOCAL,
    MEAN,
    QUATERNION,
    SCALE,
    camera_point,
    column,
    compensation_of,
    dot,
    four,
    matrix_of,
    normalised,
    put,
    read_primitives,
    rotation_of,
    scaled_axes,
    scaled_columns,
    screen_axes,
    three,
)
from invgraphics.kernels.types import COMPENSATION_MIN

# Slots of a group of primitives behind what the forward pass reads: its results, their gradients, ...
_CONIC, _RADIUS, _GRAD_MEAN2D, _GRAD_CONIC, _GRAD_DEPTH, _GRAD_COMPENSATION = (
    index(slot) * LANES for slot in (10, 13, 14, 16, 19, 20)
)
# ... the gradients to compute, 16 harmonics (later their gradients), and the pose gradient.
_GRAD_MEAN, _GRAD_QUATERNION, _GRAD_SCALE, _HARMONICS, _POSE = (index(slot) * LANES for slot in (21, 24, 28, 31, 47))
_SLOTS = index(47 + 12) * LANES

_ZERO, _HALF, _ONE, _TWO = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))
_COMPENSATION_MIN = np.float32(COMPENSATION_MIN)


@inlined
def _inverse_backward(conic, g):
    """Gradient of the covariance (xx, xy, yy) from that of its inverse: -C G C, G symmetric."""
    a, b, c = conic[0], conic[1], conic[2]
    g0, g1, g2 = g[0], _HALF * g[1], g[2]
    p, q = a * g0 + b * g1, a * g1 + b * g2
    r, s = b * g0 + c * g1, b * g1 + c * g2
    return -(p * a + q * b), -_TWO * (p * b + q * c), -(r * b + s * c)


@inlined
def _compensation_backward(x, y, dilation, conic, grad_compensation):
    """Gradients of the screen axes: d ln compensation = (d area / area - d det / det) / 2, both quadratic in the axes."""
    compensation, xx, xy, yy, area = compensation_of(x, y, dilation)
    g, counts = grad_compensation * compensation, compensation > _COMPENSATION_MIN
    a, b, c = g * (yy / area - conic[0]), -g * (xy / area + conic[1]), g * (xx / area - conic[2])
    # Set to 0 behind the divisions: of an area that underflowed they are infinite, and 0 times that is NaN.
    a, b, c = a if counts else _ZERO, b if counts else _ZERO, c if counts else _ZERO
    return (
        (a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2]),
        (b * x[0] + c * y[0], b * x[1] + c * y[1], b * x[2] + c * y[2]),
    )


@inlined
def _projection_backward(view, dilation, antialiased, mean, root, conic, grad_conic, grad_mean2d, grad_compensation):
    """Gradients of the mean in camera axes and of the covariance's root."""
    x, y, sx, sy = screen_axes(view, mean, root)
    gxx, gxy, gyy = _inverse_backward(conic, grad_conic)
    gx = (_TWO * gxx * x[0] + gxy * y[0], _TWO * gxx * x[1] + gxy * y[1], _TWO * gxx * x[2] + gxy * y[2])
    gy = (_TWO * gyy * y[0] + gxy * x[0], _TWO * gyy * y[1] + gxy * x[1], _TWO * gyy * y[2] + gxy * x[2])
    if antialiased:
        hx, hy = _compensation_backward(x, y, dilation, conic, grad_compensation)
        gx = (gx[0] + hx[0], gx[1] + hx[1], gx[2] + hx[2])
        gy = (gy[0] + hy[0], gy[1] + hy[1], gy[2] + hy[2])
    inverse = _ONE / mean[2]
    fx, fy = view[FOCAL] * inverse, view[FOCAL + 1] * inverse
    grad_root = (
        (fx * gx[0], fx * gx[1], fx * gx[2]),
        (fy * gy[0], fy * gy[1], fy * gy[2]),
        (-fx * sx * gx[0] - fy * sy * gy[0], -fx * sx * gx[1] - fy * sy * gy[1], -fx * sx * gx[2] - fy * sy * gy[2]),
    )
    # Both rows are proportional to 1 / z, and the slopes move with the mean where they are not clamped.
    slope_x, slope_y = mean[0] * inverse, mean[1] * inverse
    grad_slope_x = -fx * dot(gx, root[2]) if sx == slope_x else _ZERO
    grad_slope_y = -fy * dot(gy, root[2]) if sy == slope_y else _ZERO
    grad_slope_x += view[FOCAL] * grad_mean2d[0]
    grad_slope_y += view[FOCAL + 1] * grad_mean2d[1]
    grad_z = -inverse * (dot(gx, x) + dot(gy, y) + grad_slope_x * slope_x + grad_slope_y * slope_y)
    return (grad_slope_x * inverse, grad_slope_y * inverse, grad_z), grad_root


@inlined
def _quaternion_backward(q, norm, m):
    """Gradient of a quaternion from that of its rotation matrix, through the normalisation."""
    w, x, y, z = q
    m0, m1, m2 = m
    dw = _TWO * (z * (m1[0] - m0[1]) + y * (m0[2] - m2[0]) + x * (m2[1] - m1[2]))
    dx = _TWO * (y * (m0[1] + m1[0]) + z * (m0[2] + m2[0]) + w * (m2[1] - m1[2]) - _TWO * x * (m1[1] + m2[2]))
    dy = _TWO * (x * (m0[1] + m1[0]) + z * (m1[2] + m2[1]) + w * (m0[2] - m2[0]) - _TWO * y * (m0[0] + m2[2]))
    dz = _TWO * (x * (m0[2] + m2[0]) + y * (m1[2] + m2[1]) + w * (m1[0] - m0[1]) - _TWO * z * (m0[0] + m1[1]))
    along = w * dw + x * dx + y * dy + z * dz
    return (dw - w * along) / norm, (dx - x * along) / norm, (dy - y * along) / norm, (dz - z * along) / norm


@inlined
def _eval_harmonics(view, lanes, lane):
    """Spherical harmonics of a primitive's direction."""
    offset, _ = camera_point(view, three(lanes, MEAN + lane))
    distance = np.sqrt(dot(offset, offset))
    harmonics((offset[0] / distance, offset[1] / distance, offset[2] / distance), lanes, _HARMONICS + lane)


@inlined
def _clamp_backward(colour, gradient):
    """Gradient through max(0, colour): where it is cut off, only what would raise it (see `core.harmonics.colour`)."""
    return gradient if colour > _ZERO or gradient < _ZERO else _ZERO


@inlined
def _sh_backward(lanes, at, i, sh, rgb, grad_rgb, grad_sh):
    """Gradients of a primitive's SH coefficients; the gradients of its harmonics overwrite the harmonics."""
    if lanes[_RADIUS + at] == _ZERO:
        grad_sh[i, :, :] = _ZERO
        return
    red, green, blue = (
        _clamp_backward(rgb[i, 0], grad_rgb[i, 0]),
        _clamp_backward(rgb[i, 1], grad_rgb[i, 1]),
        _clamp_backward(rgb[i, 2], grad_rgb[i, 2]),
    )
    for number in range(sh.shape[1]):
        k = index(number)
        weight = lanes[_HARMONICS + k * LANES + at]
        grad_sh[i, k, 0], grad_sh[i, k, 1], grad_sh[i, k, 2] = weight * red, weight * green, weight * blue
        lanes[_HARMONICS + k * LANES + at] = sh[i, k, 0] * red + sh[i, k, 1] * green + sh[i, k, 2] * blue
    for number in range(sh.shape[1], 16):
        lanes[_HARMONICS + index(number) * LANES + at] = _ZERO


@inlined
def _direction_backward(offset, lanes, at):
    """Gradient of the offset from the camera through the view direction."""
    distance = np.sqrt(dot(offset, offset))
    d = (offset[0] / distance, offset[1] / distance, offset[2] / distance)
    g = harmonics_gradient(d, lanes, at)
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
def _pose_backward(offset, rotation_world, grad_axes, grad_mean):
    """One primitive's contribution to the gradient of the camera's rotation, row by row."""
    (x, y, z), (a, b, c), (p, q, r) = offset, grad_mean, rotation_world
    u, v, w = grad_axes
    return (
        (x * a + dot(p, u), x * b + dot(p, v), x * c + dot(p, w)),
        (y * a + dot(q, u), y * b + dot(q, v), y * c + dot(q, w)),
        (z * a + dot(r, u), z * b + dot(r, v), z * c + dot(r, w)),
    )


@inlined
def _masked(visible, values):
    """Three values; zeros where a primitive is culled."""
    return values[0] if visible else _ZERO, values[1] if visible else _ZERO, values[2] if visible else _ZERO


@inlined
def _backward_lane(view, dilation, antialiased, lanes, lane):
    """Gradients of one primitive, and its contribution to the camera pose's."""
    rotation = rotation_of(view)
    visible = lanes[_RADIUS + lane] > _ZERO
    offset, mean = camera_point(view, three(lanes, MEAN + lane))
    q, norm = normalised(four(lanes, QUATERNION + lane))
    s = three(lanes, SCALE + lane)
    axes, root = scaled_axes(view, q, s)
    grad_mean2d = lanes[_GRAD_MEAN2D + lane], lanes[_GRAD_MEAN2D + LANES + lane]
    conic, grad_conic, grad_compensation = (
        three(lanes, _CONIC + lane),
        three(lanes, _GRAD_CONIC + lane),
        lanes[_GRAD_COMPENSATION + lane],
    )
    grad_mean, grad_root = _projection_backward(
        view, dilation, antialiased, mean, root, conic, grad_conic, grad_mean2d, grad_compensation
    )
    grad_mean = (grad_mean[0], grad_mean[1], grad_mean[2] + lanes[_GRAD_DEPTH + lane])
    grad_axes = scaled_columns(grad_root, s)
    w, x, y, z = _quaternion_backward(q, norm, _product(rotation, grad_axes))
    lanes[_GRAD_QUATERNION + lane] = w if visible else _ZERO
    put(lanes, _GRAD_QUATERNION + LANES + lane, _masked(visible, (x, y, z)))
    along = dot(column(grad_root, 0), column(axes, 0)), dot(column(grad_root, 1), column(axes, 1))
    put(lanes, _GRAD_SCALE + lane, _masked(visible, (along[0], along[1], dot(column(grad_root, 2), column(axes, 2)))))
    colour = _direction_backward(offset, lanes, _HARMONICS + lane)
    a, b, c = dot(rotation[0], grad_mean), dot(rotation[1], grad_mean), dot(rotation[2], grad_mean)
    world = (a + colour[0], b + colour[1], c + colour[2])
    put(lanes, _GRAD_MEAN + lane, _masked(visible, world))
    turns, moves = _pose_backward(offset, matrix_of(q), grad_axes, grad_mean), _masked(visible, world)
    put(lanes, _POSE + lane, _masked(visible, turns[0]))
    put(lanes, _POSE + index(3) * LANES + lane, _masked(visible, turns[1]))
    put(lanes, _POSE + index(6) * LANES + lane, _masked(visible, turns[2]))
    put(lanes, _POSE + index(9) * LANES + lane, (-moves[0], -moves[1], -moves[2]))


@parallel
def project_backward(
    view, dilation, antialiased, means, quaternions, scales, sh, radii, conics, rgb,
    grad_means2d, grad_conics, grad_depths, grad_rgb, grad_compensations,
    grad_means, grad_quaternions, grad_scales, grad_sh, pose,
):  # fmt: skip
    """Gradients of all primitives and, per job, of the camera pose."""
    n, jobs = sh.shape[0], pose.shape[0]
    for job in prange(jobs):
        lanes, pose_sums = np.zeros(_SLOTS, np.float32), np.zeros(12 * GROUP, np.float64)
        end = job_start(n, jobs, job + 1)
        for begin in range(job_start(n, jobs, job), end, GROUP):
            count = min(GROUP, end - begin)
            i = index(begin)
            read_primitives(means, quaternions, scales, i, count, lanes)
            read_3(conics, i, count, lanes, _CONIC)
            read_1(radii, i, count, lanes, _RADIUS)
            read_2(grad_means2d, i, count, lanes, _GRAD_MEAN2D)
            read_3(grad_conics, i, count, lanes, _GRAD_CONIC)
            read_1(grad_depths, i, count, lanes, _GRAD_DEPTH)
            read_1(grad_compensations, i, count, lanes, _GRAD_COMPENSATION)
            for lane in range(LANES):
                _eval_harmonics(view, lanes, lane)
            for lane in range(count):
                _sh_backward(lanes, index(lane), index(begin + lane), sh, rgb, grad_rgb, grad_sh)
            for lane in range(LANES):
                _backward_lane(view, dilation, antialiased, lanes, lane)
            for k in range(12 * GROUP):
                pose_sums[k] += lanes[_POSE + index(k)]
            write_3(grad_means, i, count, lanes, _GRAD_MEAN)
            write_4(grad_quaternions, i, count, lanes, _GRAD_QUATERNION)
            write_3(grad_scales, i, count, lanes, _GRAD_SCALE)
        for k in range(12):
            pose[job, k] = pose_sums[k * GROUP : (k + 1) * GROUP].sum()
