"""EWA projection, forward: the formulas are those of `invgraphics.kernels.reference.splat_project`.

`LANES` primitives at a time, one per SIMD lane, without branches: culled primitives are computed too, and their results masked.
"""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.harmonics import harmonics
from invgraphics.kernels.numba.runtime import GROUP, LANES, index, inlined, job_start, log2, parallel, prange
from invgraphics.kernels.numba.simd.layouts import read_1, read_3, read_4, write_1, write_2, write_3
from invgraphics.kernels.reference.splat_project import ILL_CONDITIONED, MARGIN, NEAR
from invgraphics.kernels.types import ALPHA_MIN, COMPENSATION_MIN

# A camera as a flat tuple: rotation to the world row by row, position, focal lengths, principal point, width, height.
ROTATION, POSITION, FOCAL, CENTRE, SIZE, VIEW = 0, 9, 12, 14, 16, 18

# Slots of a group of primitives in the flat scratch array, LANES values each.
MEAN, QUATERNION, SCALE, _OPACITY = (index(slot) * LANES for slot in (0, 3, 7, 10))
_DEPTH, _RADIUS, _COMPENSATION, _MEAN2D, _CONIC, _PLANE = (index(slot) * LANES for slot in (11, 12, 13, 14, 16, 19))
_HARMONICS, _SLOTS = index(22) * LANES, index(22 + 16) * LANES

_ZERO, _HALF, _ONE, _TWO = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0))
_NEAR, _MARGIN, _THIN = np.float32(NEAR), np.float32(MARGIN), np.float32(ILL_CONDITIONED)
_TINY, _EPSILON = np.float32(np.finfo(np.float32).tiny), np.float32(np.finfo(np.float32).eps)
_TWO_LN_2, _PER_ALPHA_MIN = np.float32(2 * np.log(2)), np.float32(1 / ALPHA_MIN)
_NORM_MIN, _COMPENSATION_MIN = np.float32(1e-12), np.float32(COMPENSATION_MIN)


@inlined
def read_primitives(means, quaternions, scales, i, count, lanes):
    """Load ``count`` primitives, from the ``i``-th on, into the scratch slots."""
    read_3(means, i, count, lanes, MEAN)
    read_4(quaternions, i, count, lanes, QUATERNION)
    read_3(scales, i, count, lanes, SCALE)


@inlined
def three(lanes, at):
    """Load three consecutive slots of a lane."""
    return lanes[at], lanes[at + LANES], lanes[at + LANES + LANES]


@inlined
def four(lanes, at):
    """Load four consecutive slots of a lane."""
    return lanes[at], lanes[at + LANES], lanes[at + LANES + LANES], lanes[at + LANES + LANES + LANES]


@inlined
def put(lanes, at, values):
    """Store three values to consecutive slots of a lane."""
    lanes[at], lanes[at + LANES], lanes[at + LANES + LANES] = values


@inlined
def dot(a, b):
    """Scalar product of two 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def column(m, k):
    """Column ``k`` of a 3 x 3 matrix, a tuple of rows."""
    return m[0][k], m[1][k], m[2][k]


@inlined
def rotation_of(view):
    """The camera's rotation to the world."""
    return (view[0], view[1], view[2]), (view[3], view[4], view[5]), (view[6], view[7], view[8])


@inlined
def normalised(q):
    """A unit quaternion and the norm it was divided by."""
    norm = max(np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), _NORM_MIN)
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm), norm


@inlined
def matrix_of(q):
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        (_ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y)),
        (_TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x)),
        (_TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y)),
    )


@inlined
def transposed_product(a, b):
    """``a^T b``."""
    a0, a1, a2 = column(a, 0), column(a, 1), column(a, 2)
    b0, b1, b2 = column(b, 0), column(b, 1), column(b, 2)
    return (
        (dot(a0, b0), dot(a0, b1), dot(a0, b2)),
        (dot(a1, b0), dot(a1, b1), dot(a1, b2)),
        (dot(a2, b0), dot(a2, b1), dot(a2, b2)),
    )


@inlined
def camera_point(view, point):
    """A point relative to the camera, in world axes and in camera axes."""
    r = rotation_of(view)
    offset = (point[0] - view[POSITION], point[1] - view[POSITION + 1], point[2] - view[POSITION + 2])
    return offset, (dot(offset, column(r, 0)), dot(offset, column(r, 1)), dot(offset, column(r, 2)))


@inlined
def clamped_slope(view, axis, slope):
    """Slope x / z of the mean on one image axis, clamped to the image plus a margin."""
    focal, centre, size = view[FOCAL + axis], view[CENTRE + axis], view[SIZE + axis]
    margin = _MARGIN * _HALF * size / focal
    return min(max(slope, -centre / focal - margin), (size - centre) / focal + margin)


@inlined
def scaled_columns(m, s):
    """A matrix with its columns scaled."""
    m0, m1, m2 = m
    return (
        (m0[0] * s[0], m0[1] * s[1], m0[2] * s[2]),
        (m1[0] * s[0], m1[1] * s[1], m1[2] * s[2]),
        (m2[0] * s[0], m2[1] * s[1], m2[2] * s[2]),
    )


@inlined
def scaled_axes(view, q, scales):
    """Rotation of the primitive to the camera's axes, and the same with its columns scaled (a root of the covariance)."""
    axes = transposed_product(rotation_of(view), matrix_of(q))
    return axes, scaled_columns(axes, scales)


@inlined
def screen_axes(view, mean, root):
    """Rows x and y of J times the covariance's root, and the clamped slopes at which J was taken."""
    sx, sy = clamped_slope(view, 0, mean[0] / mean[2]), clamped_slope(view, 1, mean[1] / mean[2])
    fx, fy = view[FOCAL] / mean[2], view[FOCAL + 1] / mean[2]
    m0, m1, m2 = root
    x = (fx * (m0[0] - sx * m2[0]), fx * (m0[1] - sx * m2[1]), fx * (m0[2] - sx * m2[2]))
    y = (fy * (m1[0] - sy * m2[0]), fy * (m1[1] - sy * m2[1]), fy * (m1[2] - sy * m2[2]))
    return x, y, sx, sy


@inlined
def covariance(x, y, dilation):
    """Entries and determinant of the screen covariance, without cancellation for thin footprints."""
    xx, xy, yy = dot(x, x), dot(x, y), dot(y, y)
    c0, c1, c2 = x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]
    det = c0 * c0 + c1 * c1 + c2 * c2 + dilation * (xx + yy) + dilation * dilation
    return xx + dilation, xy, yy + dilation, max(det, _TINY)


@inlined
def compensation_of(x, y, dilation):
    """Opacity compensation of the low-pass filter (Mip-Splatting, §5.2), and the unfiltered covariance."""
    xx, xy, yy, area = covariance(x, y, _ZERO)
    _, _, _, det = covariance(x, y, dilation)
    return max(np.sqrt(area / det), _COMPENSATION_MIN), xx, xy, yy, area


@inlined
def _plane(mean, x, y, root, dilation):
    """Depth plane: distance of the centre, and its slopes per pixel along the ridge of maximal response."""
    distance = np.sqrt(dot(mean, mean))
    away = (
        dot(mean, column(root, 0)) / distance,
        dot(mean, column(root, 1)) / distance,
        dot(mean, column(root, 2)) / distance,
    )
    xx, _, yy, det = covariance(x, y, _ZERO)
    thin = det < _THIN * (xx + yy) * (xx + yy)
    xx, xy, yy, det = covariance(x, y, max(dilation, _EPSILON) if thin else _ZERO)
    along_x, along_y = dot(away, x), dot(away, y)
    return distance, (along_x * yy - along_y * xy) / det, (along_y * xx - along_x * xy) / det


@inlined
def visible_extent(opacity):
    """Quadratic form q at which ``opacity exp(-q / 2)`` falls to 1/255; 0 if it is never above."""
    return _TWO_LN_2 * log2(max(opacity * _PER_ALPHA_MIN, _ONE))


@inlined
def _radius(view, u, v, xx, xy, yy, opacity):
    """Half-width of the visible ellipse's square; 0 where its bounding box misses the image."""
    extent = np.sqrt(visible_extent(opacity))
    width, height = extent * np.sqrt(xx), extent * np.sqrt(yy)
    half = _HALF * (xx - yy)
    largest = _HALF * (xx + yy) + np.sqrt(half * half + xy * xy)
    meets_x = u + width > _ZERO and u - width < view[SIZE] and width > _ZERO
    meets_y = v + height > _ZERO and v - height < view[SIZE + 1] and height > _ZERO
    return extent * np.sqrt(largest) if meets_x and meets_y else _ZERO


@inlined
def _project_lane(view, dilation, antialiased, lanes, lane):
    """Project one primitive: its footprint, and the spherical harmonics of its direction."""
    offset, mean = camera_point(view, three(lanes, MEAN + lane))
    in_front = mean[2] > _NEAR
    lanes[_DEPTH + lane] = mean[2]
    mean = mean[0], mean[1], mean[2] if in_front else _ONE
    q, _ = normalised(four(lanes, QUATERNION + lane))
    _, root = scaled_axes(view, q, three(lanes, SCALE + lane))
    x, y, _, _ = screen_axes(view, mean, root)
    xx, xy, yy, det = covariance(x, y, dilation)
    u = view[CENTRE] + view[FOCAL] * mean[0] / mean[2]
    v = view[CENTRE + 1] + view[FOCAL + 1] * mean[1] / mean[2]
    compensation = _ONE
    if antialiased:
        compensation, _, _, _, _ = compensation_of(x, y, dilation)
    radius = _radius(view, u, v, xx, xy, yy, lanes[_OPACITY + lane] * compensation)
    visible = in_front and radius > _ZERO
    lanes[_RADIUS + lane], lanes[_COMPENSATION + lane] = radius if visible else _ZERO, compensation if in_front else _ONE
    lanes[_MEAN2D + lane], lanes[_MEAN2D + LANES + lane] = u if visible else _ZERO, v if visible else _ZERO
    put(lanes, _CONIC + lane, (yy / det if visible else _ONE, -xy / det if visible else _ZERO, xx / det if visible else _ONE))
    distance, along_x, along_y = _plane(mean, x, y, root, dilation)
    put(lanes, _PLANE + lane, (distance if visible else _ZERO, along_x if visible else _ZERO, along_y if visible else _ZERO))
    scale = _ONE / max(distance, _NORM_MIN)
    harmonics((offset[0] * scale, offset[1] * scale, offset[2] * scale), lanes, _HARMONICS + lane)


@inlined
def _colour(lanes, lane, sh, i):
    """Colour max(0, SH + 0.5) of a primitive; black where it is culled."""
    red = green = blue = _HALF
    if lanes[_RADIUS + lane] == _ZERO:
        return _ZERO, _ZERO, _ZERO
    for band in range(sh.shape[1]):
        k = index(band)
        weight = lanes[_HARMONICS + k * LANES + lane]
        red += weight * sh[i, k, 0]
        green += weight * sh[i, k, 1]
        blue += weight * sh[i, k, 2]
    return max(red, _ZERO), max(green, _ZERO), max(blue, _ZERO)


@parallel
def project(
    view, dilation, antialiased, means, quaternions, scales, opacities, sh, jobs,
    means2d, conics, depths, depth_planes, radii, rgb, compensations,
):  # fmt: skip
    """EWA projection of all primitives: footprints and colours; culled ones get radius 0 and finite values."""
    n = len(means)
    for job in prange(jobs):
        lanes = np.zeros(_SLOTS, np.float32)
        end = job_start(n, jobs, job + 1)
        for begin in range(job_start(n, jobs, job), end, GROUP):
            count = min(GROUP, end - begin)
            i = index(begin)
            read_primitives(means, quaternions, scales, i, count, lanes)
            read_1(opacities, i, count, lanes, _OPACITY)
            for lane in range(LANES):
                _project_lane(view, dilation, antialiased, lanes, lane)
            write_1(depths, i, count, lanes, _DEPTH)
            write_1(radii, i, count, lanes, _RADIUS)
            write_1(compensations, i, count, lanes, _COMPENSATION)
            write_2(means2d, i, count, lanes, _MEAN2D)
            write_3(conics, i, count, lanes, _CONIC)
            write_3(depth_planes, i, count, lanes, _PLANE)
            for lane in range(count):
                i, at = index(begin + lane), index(lane)
                rgb[i, 0], rgb[i, 1], rgb[i, 2] = _colour(lanes, at, sh, i)
