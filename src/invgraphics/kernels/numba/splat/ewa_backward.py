"""EWA projection, backward; side by side like the forward pass."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.harmonics import harmonics, harmonics_gradient
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined, parallel, prange, share
from invgraphics.kernels.numba.simd.layouts import read_1, read_2, read_3, write_3, write_4
from invgraphics.kernels.numba.splat.ewa import (
    FOCAL,
    MEAN,
    QUATERNION,
    SCALE,
    camera_point,
    column,
    dot,
    fade_of,
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
_CONIC, _SEEN, _TO_SCREEN, _TO_CONIC, _TO_DEPTH, _TO_FADE = (index(slot) * LANES for slot in (10, 13, 14, 16, 19, 20))
# ... what is wanted, 16 harmonics (and then the gradients along them), and the sums along the pose.
_TO_MEAN, _TO_QUATERNION, _TO_SCALE, _HARMONICS, _POSE = (index(slot) * LANES for slot in (21, 24, 28, 31, 47))
_ROOM = index(47 + 12) * LANES

_ZERO, _HALF, _ONE, _TWO = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))
_COMPENSATION_MIN = np.float32(COMPENSATION_MIN)


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
    g = to_fade * fade if fade > _COMPENSATION_MIN else _ZERO
    a, b, c = g * (yy / area - conic[0]), -g * (xy / area + conic[1]), g * (xx / area - conic[2])
    return (
        (a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2]),
        (b * x[0] + c * y[0], b * x[1] + c * y[1], b * x[2] + c * y[2]),
    )


@inlined
def _through_screen(view, dilation, antialiased, mean, root, conic, to_conic, to_mean2d, to_fade):
    """Gradients along the mean in camera axes and along the covariance's root."""
    x, y, sx, sy = screen_axes(view, mean, root)
    gxx, gxy, gyy = _through_inverse(conic, to_conic)
    gx = (_TWO * gxx * x[0] + gxy * y[0], _TWO * gxx * x[1] + gxy * y[1], _TWO * gxx * x[2] + gxy * y[2])
    gy = (_TWO * gyy * y[0] + gxy * x[0], _TWO * gyy * y[1] + gxy * x[1], _TWO * gyy * y[2] + gxy * x[2])
    if antialiased:
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
def _look(view, lanes, lane):
    """The harmonics in a primitive's direction."""
    offset, _ = camera_point(view, three(lanes, MEAN + lane))
    distance = np.sqrt(dot(offset, offset))
    harmonics((offset[0] / distance, offset[1] / distance, offset[2] / distance), lanes, _HARMONICS + lane)


@inlined
def _through_cut(colour, gradient):
    """Gradient through max(0, colour): where it is cut off, only what would raise it (see `core.harmonics.colour`)."""
    return gradient if colour > _ZERO or gradient < _ZERO else _ZERO


@inlined
def _through_colour(lanes, at, i, sh, rgb, to_rgb, to_sh):
    """Write the gradients along a primitive's coefficients; those along its harmonics take the harmonics' place."""
    if lanes[_SEEN + at] == _ZERO:
        to_sh[i, :, :] = _ZERO
        return
    red, green, blue = (
        _through_cut(rgb[i, 0], to_rgb[i, 0]),
        _through_cut(rgb[i, 1], to_rgb[i, 1]),
        _through_cut(rgb[i, 2], to_rgb[i, 2]),
    )
    for number in range(sh.shape[1]):
        k = index(number)
        weight = lanes[_HARMONICS + k * LANES + at]
        to_sh[i, k, 0], to_sh[i, k, 1], to_sh[i, k, 2] = weight * red, weight * green, weight * blue
        lanes[_HARMONICS + k * LANES + at] = sh[i, k, 0] * red + sh[i, k, 1] * green + sh[i, k, 2] * blue
    for number in range(sh.shape[1], 16):
        lanes[_HARMONICS + index(number) * LANES + at] = _ZERO


@inlined
def _through_direction(offset, lanes, at):
    """Gradient along the offset from the camera, which turns the harmonics."""
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
def _through_pose(offset, turned, to_turn, to_mean):
    """A primitive's share of the gradient along the camera's rotation, row by row."""
    (x, y, z), (a, b, c), (p, q, r) = offset, to_mean, turned
    u, v, w = to_turn
    return (
        (x * a + dot(p, u), x * b + dot(p, v), x * c + dot(p, w)),
        (y * a + dot(q, u), y * b + dot(q, v), y * c + dot(q, w)),
        (z * a + dot(r, u), z * b + dot(r, v), z * c + dot(r, w)),
    )


@inlined
def _kept(seen, values):
    """Three values; zeros where a primitive is culled, whatever was computed."""
    return values[0] if seen else _ZERO, values[1] if seen else _ZERO, values[2] if seen else _ZERO


@inlined
def _back_lane(view, dilation, antialiased, lanes, lane):
    """Gradients along one primitive, and its share of those along the camera's pose."""
    rotation = rotation_of(view)
    seen = lanes[_SEEN + lane] > _ZERO
    offset, mean = camera_point(view, three(lanes, MEAN + lane))
    q, norm = normalised(four(lanes, QUATERNION + lane))
    s = three(lanes, SCALE + lane)
    turn, root = scaled_axes(view, q, s)
    to_mean2d = lanes[_TO_SCREEN + lane], lanes[_TO_SCREEN + LANES + lane]
    conic, to_conic, to_fade = three(lanes, _CONIC + lane), three(lanes, _TO_CONIC + lane), lanes[_TO_FADE + lane]
    to_mean, to_root = _through_screen(view, dilation, antialiased, mean, root, conic, to_conic, to_mean2d, to_fade)
    to_mean = (to_mean[0], to_mean[1], to_mean[2] + lanes[_TO_DEPTH + lane])
    to_turn = scaled_columns(to_root, s)
    w, x, y, z = _to_quaternion(q, norm, _product(rotation, to_turn))
    lanes[_TO_QUATERNION + lane] = w if seen else _ZERO
    put(lanes, _TO_QUATERNION + LANES + lane, _kept(seen, (x, y, z)))
    along = dot(column(to_root, 0), column(turn, 0)), dot(column(to_root, 1), column(turn, 1))
    put(lanes, _TO_SCALE + lane, _kept(seen, (along[0], along[1], dot(column(to_root, 2), column(turn, 2)))))
    colour = _through_direction(offset, lanes, _HARMONICS + lane)
    a, b, c = dot(rotation[0], to_mean), dot(rotation[1], to_mean), dot(rotation[2], to_mean)
    world = (a + colour[0], b + colour[1], c + colour[2])
    put(lanes, _TO_MEAN + lane, _kept(seen, world))
    turns, moves = _through_pose(offset, matrix_of(q), to_turn, to_mean), _kept(seen, world)
    put(lanes, _POSE + lane, _kept(seen, turns[0]))
    put(lanes, _POSE + index(3) * LANES + lane, _kept(seen, turns[1]))
    put(lanes, _POSE + index(6) * LANES + lane, _kept(seen, turns[2]))
    put(lanes, _POSE + index(9) * LANES + lane, (-moves[0], -moves[1], -moves[2]))


@parallel
def project_back(
    view, dilation, antialiased, means, quaternions, scales, sh, radii, conics, rgb,
    to_means2d, to_conics, to_depths, to_rgb, to_fades,
    to_means, to_quaternions, to_scales, to_sh, pose,
):  # fmt: skip
    """Write the gradients along the primitives and, per job, along the camera's pose."""
    n, jobs = sh.shape[0], pose.shape[0]
    for job in prange(jobs):
        lanes, shares = np.zeros(_ROOM, np.float32), np.zeros(12 * GROUP, np.float64)
        end = share(n, jobs, job + 1)
        for begin in range(share(n, jobs, job), end, GROUP):
            count = min(GROUP, end - begin)
            i = index(begin)
            read_primitives(means, quaternions, scales, i, count, lanes)
            read_3(conics, i, count, lanes, _CONIC)
            read_1(radii, i, count, lanes, _SEEN)
            read_2(to_means2d, i, count, lanes, _TO_SCREEN)
            read_3(to_conics, i, count, lanes, _TO_CONIC)
            read_1(to_depths, i, count, lanes, _TO_DEPTH)
            read_1(to_fades, i, count, lanes, _TO_FADE)
            for lane in range(LANES):
                _look(view, lanes, lane)
            for lane in range(count):
                _through_colour(lanes, index(lane), index(begin + lane), sh, rgb, to_rgb, to_sh)
            for lane in range(LANES):
                _back_lane(view, dilation, antialiased, lanes, lane)
            for k in range(12 * GROUP):
                shares[k] += lanes[_POSE + index(k)]
            write_3(to_means, i, count, lanes, _TO_MEAN)
            write_4(to_quaternions, i, count, lanes, _TO_QUATERNION)
            write_3(to_scales, i, count, lanes, _TO_SCALE)
        for k in range(12):
            pose[job, k] = shares[k * GROUP : (k + 1) * GROUP].sum()
