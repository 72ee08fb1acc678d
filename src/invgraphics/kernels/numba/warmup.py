"""Ahead-of-time compilation: calls that compile every kernel."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import torch

from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.core.fused import ColourHead, CombinedLattices, DensityHead, FusedLattice
from invgraphics.core.lattice import Lattice
from invgraphics.core.ngp import FusedColour, FusedNGP, FusedSDF, HashGrid
from invgraphics.core.rays import Rays
from invgraphics.kernels.numba.adam import adam_rows
from invgraphics.kernels.numba.fused.march import lattice_march
from invgraphics.kernels.numba.fused.render import lattice_render
from invgraphics.kernels.numba.gaussians.density import gaussian_density
from invgraphics.kernels.numba.gaussians.integrate import gaussian_integrals
from invgraphics.kernels.numba.gaussians.ordered import gaussian_composites
from invgraphics.kernels.numba.hash.encode import hash_encode
from invgraphics.kernels.numba.lattice.encode import lattice_encode
from invgraphics.kernels.numba.lattice.touched import touched_rows
from invgraphics.kernels.numba.mesh.interpolate import mesh_interpolate
from invgraphics.kernels.numba.mesh.rasterise import mesh_rasterise
from invgraphics.kernels.numba.near import near_points
from invgraphics.kernels.numba.ngp.distance import sdf_values
from invgraphics.kernels.numba.ngp.march import ngp_march
from invgraphics.kernels.numba.ngp.radiance import sdf_radiance
from invgraphics.kernels.numba.ngp.render import ngp_render
from invgraphics.kernels.numba.ngp.skip import sdf_skip
from invgraphics.kernels.numba.ngp.trace import sdf_trace
from invgraphics.kernels.numba.rays.composite import composite
from invgraphics.kernels.numba.rays.march import ray_march
from invgraphics.kernels.numba.runtime import threads
from invgraphics.kernels.numba.segments import segment_sums
from invgraphics.kernels.numba.splat.binning import splat_bin
from invgraphics.kernels.numba.splat.project import splat_project
from invgraphics.kernels.numba.splat.rasterise import splat_median, splat_rasterise
from invgraphics.kernels.numba.ssim import ssim
from invgraphics.kernels.reference.gaussian_rays import precompute
from invgraphics.kernels.types import AdamStep, MarchSteps, TracingLimits


def warm_up() -> float:
    """Run every kernel forward and backward on tiny input, which compiles it; returns seconds, about 0 when all is cached."""
    began = perf_counter()
    samples()
    splats()
    return perf_counter() - began


def splats() -> None:
    """Compile the kernels of Gaussian splatting and of meshes."""
    pose = torch.eye(4).requires_grad_()
    camera = Camera(pose, torch.full((2,), 8.0), torch.full((2,), 4.0), 8, 8)
    shapes = ((4, 3), (4, 4), (4, 3), (4,), (4, 1, 3))
    gaussians = Gaussians(*(torch.full(shape, 0.5).requires_grad_() for shape in shapes))
    rays = camera.rays()
    gaussian_integrals(precompute(gaussians, "peak", 1e-3), rays, 2).sum().backward()
    for axes in (None, torch.ones(3)):
        gaussian_composites(precompute(gaussians, "peak", 1e-3), camera.rays(), axes).sum().backward()
    gaussian_density(gaussians, torch.full((1, 3), 0.5), torch.zeros(1, 3), 1e-3).sum().backward()
    footprints, rgb = splat_project(gaussians, camera)
    splat_bin(footprints, 8, 8, 4)
    splat_median(footprints, 8, 8)
    # The backward pass is specialised for each setting of its two switches.
    for absgrad in (None, torch.zeros(4, 2, requires_grad=True)):
        for max_grad_splats in (0, 1):
            image, alpha = splat_rasterise(replace(footprints, absgrad=absgrad), rgb, 8, 8, max_grad_splats=max_grad_splats)
            (image.sum() + alpha.sum()).backward(retain_graph=True)
    corners = torch.eye(3)
    fragments = mesh_rasterise(corners, torch.tensor([[0, 1, 2]]), camera)
    fragments = replace(fragments, barycentric=fragments.barycentric.requires_grad_())
    mesh_interpolate(fragments, torch.tensor([[0, 1, 2]]), corners.requires_grad_()).sum().backward()


def samples() -> None:
    """Compile the kernels of volume rendering, and SSIM."""
    image = torch.zeros(8, 8, 3).requires_grad_()
    ssim(image, torch.zeros_like(image)).backward()
    near_points(torch.zeros(1, 3), torch.zeros(1, 3), 1, 1.0)
    rows, weights = torch.ones(1, 2).requires_grad_(), torch.ones(1).requires_grad_()
    segment_sums(rows, weights, torch.zeros(1, dtype=torch.int64), 1).sum().backward()
    unit = torch.full((2 * threads(), 3), 0.4).requires_grad_()
    levels = HashGrid(levels=2, log2_size=4, base=1, finest=4)
    features, _ = hash_encode(unit, torch.zeros(levels.entries, 2).requires_grad_(), levels)
    scaled = features * torch.ones_like(features).requires_grad_()  # so that second derivatives meet both kernels
    (gradient,) = torch.autograd.grad(scaled.sum(), unit, create_graph=True)
    # Several threads add up copies of the first one's gradient, and share the rows of the second one.
    factors = [Lattice(torch.zeros(rows, 1).requires_grad_(), axis) for rows, axis in ((2, "x"), (len(unit), "y"))]
    values = lattice_encode(unit, factors, "cp")
    touched_rows(unit.detach().T.contiguous().numpy(), Lattice(torch.zeros(2, 2, 2, 1)), "lattice.slots")
    rows = [torch.ones(2, 1) for _ in range(4)]
    adam_rows(rows[0], rows[1], (rows[2], rows[3]), AdamStep(0.1, 0.9, 0.99, 1e-15, 1), torch.ones(2))
    ray = torch.zeros(len(unit), dtype=torch.int64)
    _, sums, alpha = composite(values[:, 0], features, ray, 1)
    (sums.sum() + alpha.sum() + gradient.sum()).backward()
    bounds = Bounds(torch.zeros(3), torch.ones(3))
    rays = bounds.clip(Rays.make(torch.full((2, 3), 0.1), torch.full((2, 3), 3**-0.5)))
    everywhere = torch.ones(2, 2, 2, dtype=torch.bool)
    ray_march(rays, everywhere, bounds, MarchSteps(0.1), rays.near)
    layer = torch.zeros(16, 4), torch.zeros(16)
    field = FusedNGP(
        torch.zeros(levels.entries, 2), levels, (layer,), ((torch.zeros(3, 16), torch.zeros(3)),), "exp", 0.0, 1, "srgb"
    )
    ngp_march(rays, everywhere, bounds, MarchSteps(0.1), field, rays.near, 0.5)
    ngp_render(rays, everywhere, bounds, MarchSteps(0.1), field)
    net = (torch.zeros(8, 7), torch.zeros(8)), (torch.zeros(1, 8), torch.zeros(1))
    distance = FusedSDF(torch.zeros(levels.entries, 2), levels, 0, net, 100.0, torch.ones(3), 1.0)
    sdf_values(unit.detach(), bounds, distance)
    seen = FusedColour(net, torch.zeros(levels.entries, 2), levels, ((torch.zeros(3, 4), torch.zeros(3)),), 0, "srgb")
    sdf_radiance(unit.detach(), unit.detach(), bounds, replace(distance, colour=seen))
    sdf_skip(rays, bounds, torch.ones(2, 2, 2), 1e-2, 1e-2, 1.0)
    sdf_trace(rays, bounds, distance, TracingLimits(2, 1.0, 1, 1e-3, 1e-3, 1e-2))
    planes = CombinedLattices(tuple(Lattice(torch.zeros(2, 2, 4), axes) for axes in ("xy", "xz", "yz")), "sum")
    dense = FusedLattice(planes, (), DensityHead("exp"), None, (), ColourHead("none"))
    lattice_march(rays, everywhere, bounds, MarchSteps(0.1), dense, rays.near, 0.5)
    lattice_render(rays, everywhere, bounds, MarchSteps(0.1), dense)
