"""Benchmark cases of surfaces and points: sphere tracing, rasterised triangles, the search for neighbours."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics import kernels
from invgraphics.bench import limits
from invgraphics.bench.case import SLOW, Case, KernelPass
from invgraphics.bench.results import BOTH, FORWARD
from invgraphics.bench.sample_cases import ray_ordered, some_rays
from invgraphics.bench.splat_cases import forward_backward, without_gradient
from invgraphics.bench.workload import bounds, camera, gaussian_field
from invgraphics.core import Mesh
from invgraphics.core.ngp import FusedSDF
from invgraphics.fields.analytic import Sphere
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.isosurface import extract_mesh
from invgraphics.fields.neural import NeuralField, NeuralFieldConfig
from invgraphics.kernels import near
from invgraphics.kernels.types import TracingLimits

TRACE_RAYS, QUICK_TRACE_RAYS = (1 << 10, 1 << 12, 1 << 14), (1 << 10, 1 << 12)
GRID = HashConfig(levels=8, log2_size=15, base=16, finest=512)
DISTANCE = NeuralFieldConfig(
    GRID,
    "sdf",
    layers=1,
    width=32,
    skip=-1,
    geometry_features=13,
    colour_layers=2,
    colour_width=32,
    direction="sh",
    appearance=GRID,
)
"""The field of `sphere-tracing/hash`, laptop, as the sphere that a fit starts from."""
LIMITS = TracingLimits(steps=128, relaxation=1.2, refinements=8, least=1e-3, tolerance=1e-6, depth=0.03)
CELLS = 34
"""Along each edge of the grid of distances; a picture of 400 pixels has as many."""
DISTANCES, QUICK_DISTANCES = (1 << 14, 1 << 17), (1 << 14,)
"""Positions at which a distance is evaluated."""

RADIUS = 0.7
MESH_SIZES, QUICK_MESH_SIZES = ((32, 200), (96, 400), (192, 400), (192, 800)), ((32, 200), (96, 400))
"""Voxels along an edge of the grid from which a sphere is extracted, and pixels along the picture's edge."""
FEATURES = 6
"""Interpolated numbers of a vertex: colour and normal."""
MOST_TRIANGLES_FOR_REFERENCE = 10_000

NEAR_POINTS, QUICK_NEAR_POINTS = ((1 << 14, 1 << 14), (1 << 17, 1 << 16)), ((1 << 14, 1 << 14),)
"""Points, and positions whose neighbours are sought."""
NEIGHBOURS, NEAR_RADIUS = 8, 0.05
MOST_POINTS_FOR_REFERENCE = 1 << 14


def signed_distances(quick: bool) -> Iterator[Case]:
    """A hash grid's distance in one pass: at positions in the order of rays, where colour is too, and along whole rays."""
    levels = GRID.levels
    for positions in QUICK_DISTANCES if quick else DISTANCES:
        sizes = {"levels": levels, "positions": positions}
        yield Case("sdf_values", sizes, lambda positions=positions: _distances(positions))
        yield Case("sdf_radiance", sizes, lambda positions=positions: _colours(positions))
    for rays in QUICK_TRACE_RAYS if quick else TRACE_RAYS:
        yield Case("sdf_skip", {"resolution": CELLS, "rays": rays}, lambda rays=rays: _skip(rays))
        yield Case("sdf_trace", {"levels": levels, "rays": rays}, lambda rays=rays: _trace(rays))


def meshes(quick: bool) -> Iterator[Case]:
    """Rasterisation of a closed surface, and interpolation of its vertices' features, over triangles and pixels."""
    for voxels, width in QUICK_MESH_SIZES if quick else MESH_SIZES:
        ball = _ball(voxels)
        sizes = {"triangles": len(ball.faces), "width": width}
        why = SLOW if len(ball.faces) > MOST_TRIANGLES_FOR_REFERENCE else ""
        yield Case("mesh_rasterise", sizes, lambda ball=ball, width=width: _rasterise(ball, width), why)
        yield Case("mesh_interpolate", sizes, lambda ball=ball, width=width: _interpolate(ball, width))


def near_points(quick: bool) -> Iterator[Case]:
    """Nearest points within a radius, of positions along rays, over points on surfaces."""
    for points, positions in QUICK_NEAR_POINTS if quick else NEAR_POINTS:
        why = SLOW if points > MOST_POINTS_FOR_REFERENCE else ""
        sizes = {"points": points, "positions": positions}
        yield Case("near_points", sizes, lambda sizes=sizes: _near(**sizes), why)


def sphere_distance() -> FusedSDF:
    """The parameters of `DISTANCE` over the object's bounds."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        parts = NeuralField(DISTANCE, bounds()).fused_sdf(bounds())
    assert parts is not None
    return parts


def _distances(count: int) -> dict[str, KernelPass]:
    field, region, places = sphere_distance(), bounds(), bounds().from_unit(ray_ordered(count))
    evaluate = lambda: kernels.sdf_values(places, region, field)  # noqa: E731
    products = sum(weight.numel() for weight, _ in field.net)
    return {FORWARD: KernelPass(evaluate, 2.0 * products * count, limits.sgemm(), "flop")}


def _colours(count: int) -> dict[str, KernelPass]:
    field, region, places = sphere_distance(), bounds(), bounds().from_unit(ray_ordered(count))
    assert field.colour is not None
    directions = normalize(places, dim=1)
    evaluate = lambda: kernels.sdf_radiance(places, directions, region, field)  # noqa: E731
    products = sum(weight.numel() for weight, _ in (*field.colour.geometry_net, *field.colour.net))
    return {FORWARD: KernelPass(evaluate, 2.0 * products * count, limits.sgemm(), "flop")}


def _skip(count: int) -> dict[str, KernelPass]:
    region, rays = bounds(), some_rays(count)
    distances = (region.cell_centres([CELLS] * 3).norm(dim=1) - RADIUS).reshape([CELLS] * 3)
    least = float(region.half.mean()) / (2 * CELLS)
    skip = lambda: kernels.sdf_skip(rays, region, distances, LIMITS.depth, least)  # noqa: E731
    return {FORWARD: KernelPass(skip, float(count), unit="rays")}


def _trace(count: int) -> dict[str, KernelPass]:
    field, region, rays = sphere_distance(), bounds(), some_rays(count)
    trace = lambda: kernels.sdf_trace(rays, region, field, LIMITS)  # noqa: E731
    # Refinements are not counted among a ray's steps.
    products = sum(weight.numel() for weight, _ in field.net)
    return {FORWARD: KernelPass(trace, 2.0 * products * int(trace().steps.sum()), limits.sgemm(), "flop")}


def _ball(voxels: int) -> Mesh:
    return extract_mesh(Sphere(1.0, RADIUS), bounds(), voxels).mesh


def _rasterise(mesh: Mesh, width: int) -> dict[str, KernelPass]:
    viewpoint = camera(width)
    draw = lambda: kernels.mesh_rasterise(mesh.vertices, mesh.faces, viewpoint)  # noqa: E731
    return {FORWARD: KernelPass(draw, float(width**2), unit="pixels")}


def _interpolate(mesh: Mesh, width: int) -> dict[str, KernelPass]:
    features: Float[Tensor, "v c"] = torch.rand(
        len(mesh.vertices), FEATURES, generator=torch.Generator().manual_seed(0)
    ).requires_grad_()
    fragments = kernels.mesh_rasterise(mesh.vertices, mesh.faces, camera(width))
    draw = lambda: kernels.mesh_interpolate(fragments, mesh.faces, features)  # noqa: E731
    pixels = float(width**2)
    return {
        FORWARD: KernelPass(without_gradient(draw), pixels, unit="pixels"),
        BOTH: KernelPass(forward_backward(draw, [features]), 2 * pixels, unit="pixels"),
    }


def _near(points: int, positions: int) -> dict[str, KernelPass]:
    cloud = gaussian_field(points).means.detach()
    places = bounds().from_unit(ray_ordered(positions))
    search = lambda: near.near_points(places, cloud, NEIGHBOURS, NEAR_RADIUS)  # noqa: E731
    return {FORWARD: KernelPass(search, float(positions), unit="positions")}
