"""Z-buffer rasterisation of triangles, in bands of rows. Every pixel keeps its nearest triangle, whoever draws it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from invgraphics.core.camera import Camera
from invgraphics.kernels.numba.runtime import array, exact, exact_parallel, job_start, prange, scratch, threads
from invgraphics.kernels.reference.mesh import NEAREST_PLANE
from invgraphics.kernels.types import Fragments

BANDS = 4
"""Bands of rows per thread: triangles are not spread evenly."""


@exact
def _edge_function(b, c, lens, out):
    """Coefficients (of x, of y, constant) of d · (b × c) at pixel coordinates, with d = ((x - cx) / fx, (y - cy) / fy, 1)."""
    nx, ny, nz = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    out[0], out[1] = nx / lens[0], ny / lens[1]
    out[2] = nz - out[0] * lens[2] - out[1] * lens[3]


@exact
def _include(point, depth, lens, box):
    """Widen a box (x0, x1, y0, y1) in pixels by the image of a point in the camera's frame."""
    x, y = lens[2] + lens[0] * point[0] / depth, lens[3] + lens[1] * point[1] / depth
    box[0], box[1] = min(box[0], x), max(box[1], x)
    box[2], box[3] = min(box[2], y), max(box[3], y)


@exact_parallel
def to_camera(vertices, pose, jobs, out):
    """Vertices in the camera's frame, double precision."""
    for job in prange(jobs):
        for i in range(job_start(len(vertices), jobs, job), job_start(len(vertices), jobs, job + 1)):
            x, y, z = vertices[i, 0] - pose[0, 3], vertices[i, 1] - pose[1, 3], vertices[i, 2] - pose[2, 3]
            for k in range(3):
                out[i, k] = x * pose[0, k] + y * pose[1, k] + z * pose[2, k]


@exact_parallel
def bound(vertices, faces, lens, plane, size, jobs, boxes):
    """Pixels (x0, x1, y0, y1; ends exclusive) that each triangle may cover beyond the plane z = ``plane``; empty if none."""
    for job in prange(jobs):
        box, crossing = np.empty(4), np.empty(3)
        for f in range(job_start(len(faces), jobs, job), job_start(len(faces), jobs, job + 1)):
            box[0], box[1], box[2], box[3] = np.inf, -np.inf, np.inf, -np.inf
            for k in range(3):
                a, b = vertices[faces[f, k]], vertices[faces[f, (k + 1) % 3]]
                if a[2] >= plane:
                    _include(a, a[2], lens, box)
                if (a[2] >= plane) != (b[2] >= plane):
                    share = (plane - a[2]) / (b[2] - a[2])
                    for axis in range(2):
                        crossing[axis] = a[axis] + share * (b[axis] - a[axis])
                    _include(crossing, plane, lens, box)
            for axis in range(2):
                lo, hi, limit = box[2 * axis], box[2 * axis + 1], size[axis]
                if lo <= hi and lo < limit and hi > 0:
                    # One more pixel on each side than rounding could need.
                    boxes[f, 2 * axis] = np.int32(np.floor(max(lo - 0.5, 0.0)))
                    boxes[f, 2 * axis + 1] = np.int32(min(np.ceil(hi - 0.5) + 1, np.float64(limit)))
                else:
                    boxes[f, 2 * axis], boxes[f, 2 * axis + 1] = 0, 0


@exact_parallel
def rasterise(vertices, faces, boxes, lens, near, far, bands, face, barycentric, depth):
    """Nearest triangle, barycentric coordinates and distance of every pixel (``face`` holds -1, ``depth`` inf before)."""
    height = len(depth)
    for band in prange(bands):
        top, bottom = job_start(height, bands, band), job_start(height, bands, band + 1)
        edge = np.empty((3, 3))
        for f in range(len(faces)):
            first, last = max(boxes[f, 2], top), min(boxes[f, 3], bottom)
            if first >= last or boxes[f, 0] >= boxes[f, 1]:
                continue
            a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
            _edge_function(b, c, lens, edge[0])
            _edge_function(c, a, lens, edge[1])
            _edge_function(a, b, lens, edge[2])
            nx, ny, nz = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
            determinant = a[0] * nx + a[1] * ny + a[2] * nz
            for row in range(first, last):
                y = row + 0.5
                e0, e1, e2 = (
                    edge[0, 1] * y + edge[0, 2],
                    edge[1, 1] * y + edge[1, 2],
                    edge[2, 1] * y + edge[2, 2],
                )
                for column in range(boxes[f, 0], boxes[f, 1]):
                    x = column + 0.5
                    w0, w1, w2 = edge[0, 0] * x + e0, edge[1, 0] * x + e1, edge[2, 0] * x + e2
                    inside = (w0 >= 0.0 and w1 >= 0.0 and w2 >= 0.0) or (w0 <= 0.0 and w1 <= 0.0 and w2 <= 0.0)
                    if not inside:
                        continue
                    total = w0 + w1 + w2
                    z = determinant / total
                    dx, dy = (x - lens[2]) / lens[0], (y - lens[3]) / lens[1]
                    t = z * np.sqrt(dx * dx + dy * dy + 1.0)
                    if t > 0.0 and t < depth[row, column] and t >= near[row, column] and t <= far[row, column]:
                        depth[row, column], face[row, column] = t, f
                        barycentric[row, column, 0] = w0 / total
                        barycentric[row, column, 1] = w1 / total
                        barycentric[row, column, 2] = w2 / total


def check_faces(faces: Int[Tensor, "f 3"], vertices: int) -> None:
    """Check that all corners are vertices: kernels would read foreign memory.

    Raises:
        IndexError: a corner is not one of that number of vertices.
    """
    if faces.numel():
        first, last = (int(corner) for corner in faces.aminmax())
        if first < 0 or last >= vertices:
            raise IndexError(f"Corners of faces are vertices {first} to {last}, but there are {vertices} vertices.")


def mesh_rasterise(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    camera: Camera,
    interval: tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]] | None = None,
) -> Fragments:
    """See `invgraphics.kernels.mesh_rasterise`."""
    check_faces(faces, len(vertices))
    width, height, jobs = camera.width, camera.height, threads()
    lens = np.concatenate([array(camera.focal.double()), array(camera.principal_point.double())])
    near, far = np.zeros((height, width)), np.full((height, width), np.inf)
    plane = NEAREST_PLANE
    if interval is not None:
        near, far = (array(limit.double().view(height, width)) for limit in interval)
        x, y = (np.arange(width) + 0.5 - lens[2]) / lens[0], (np.arange(height) + 0.5 - lens[3]) / lens[1]
        plane = max(plane, float((near / np.sqrt(x * x + y[:, None] ** 2 + 1)).min()))
    points = scratch("mesh_points", 3 * len(vertices), np.float64).reshape(-1, 3)
    to_camera(array(vertices), array(camera.cam_to_world.double()), jobs, points)
    corners = array(faces.long())
    boxes = scratch("mesh_boxes", 4 * len(corners), np.int32).reshape(-1, 4)
    bound(points, corners, lens, plane, np.array([width, height]), jobs, boxes)
    face = torch.full((height, width), -1)
    barycentric = torch.zeros(height, width, 3)
    depth = np.full((height, width), np.inf)
    rasterise(points, corners, boxes, lens, near, far, BANDS * jobs, face.numpy(), barycentric.numpy(), depth)
    return Fragments(face, barycentric, torch.from_numpy(depth).float())
