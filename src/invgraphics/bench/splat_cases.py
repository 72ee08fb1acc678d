"""Benchmark cases of splatting (project, bin, rasterise) and SSIM."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from invgraphics import kernels
from invgraphics.bench import limits
from invgraphics.bench.case import SLOW, Case, KernelPass, Run
from invgraphics.bench.results import BOTH, FORWARD
from invgraphics.bench.workload import activated, camera, gaussian_field, leaves
from invgraphics.core import Camera, Gaussians
from invgraphics.kernels.dispatch import unavailable_reason
from invgraphics.kernels.types import Footprints

GATE = {"gaussians": 50_000, "width": 400}
"""Size of the gates on splatting."""

SIZES = ((10_000, 100), (10_000, 400), (50_000, 100), (50_000, 400), (50_000, 800), (200_000, 400), (200_000, 800))
QUICK_SIZES = ((10_000, 100), (50_000, 400))
MOST_FOR_REFERENCE = 50_000 * 400 * 400
"""Gaussians times pixels beyond which the reference is skipped."""

SSIM_WIDTHS, QUICK_SSIM_WIDTHS = (100, 200, 400, 800), (100, 400)
SSIM_FLOPS = {FORWARD: 4 * 2 * 11 * 2, BOTH: (4 + 3) * 2 * 11 * 2}
"""Per pixel and channel: blurs of four moments forward and of three gradients backward, 11 taps in x and in y."""

GAUSSIAN_FLOATS, FOOTPRINT_FLOATS = 3 + 4 + 3 + 1 + 48, 2 + 3 + 1 + 1 + 3 + 1 + 3
"""Floats read and written by the projection per Gaussian of SH degree 3."""


def splats(quick: bool) -> Iterator[Case]:
    """The pipeline (project, bin, rasterise) over sizes, and its two differentiable stages at one size."""
    for n, width in QUICK_SIZES if quick else SIZES:
        why = SLOW if n * width * width > MOST_FOR_REFERENCE else ""
        yield Case("splats", {"gaussians": n, "width": width}, lambda n=n, width=width: _pipeline(n, width), why)
    yield Case("splat_project", GATE, lambda: _project(**GATE))
    yield Case("splat_rasterise", GATE, lambda: _rasterise(**GATE), "it is nearly all of the pipeline's time")


def ssim(quick: bool) -> Iterator[Case]:
    """SSIM, forward and backward, over picture sizes."""
    for width in QUICK_SSIM_WIDTHS if quick else SSIM_WIDTHS:
        yield Case("ssim", {"width": width, "channels": 3}, lambda width=width: _ssim(width))


def splat_pipeline(gaussians: Gaussians, viewpoint: Camera) -> tuple[Tensor, Tensor]:
    """Project, bin and rasterise: colour and alpha."""
    footprints, rgb = kernels.splat_project(gaussians, viewpoint)
    return kernels.splat_rasterise(footprints, rgb, viewpoint.width, viewpoint.height)


def alpha_evaluations(footprints: Footprints, rgb: Tensor, width: int, height: int) -> float:
    """Number of evaluations of ``opacity exp(-q / 2)`` in the rasteriser's forward pass; 0 without Numba.

    The compiled kernel counts its visits of pixel blocks; the backward pass visits the same blocks again. The reference
    evaluates every pixel of every tile that a footprint's square overlaps; the extra work is not counted.
    """
    if unavailable_reason("numba"):
        return 0.0
    from invgraphics.kernels.numba.runtime import LANES

    with kernels.using("numba"), torch.enable_grad():
        image: Any = kernels.splat_rasterise(footprints, rgb.detach().requires_grad_(), width, height)[0]
    return float(image.grad_fn.tile_state.work.sum()) * float(LANES)


def forward_backward(outputs: Run, inputs: list[Tensor]) -> Run:
    """A call that computes ``outputs`` and backpropagates fixed gradients to ``inputs``."""
    gradients: list[Tensor] = []

    def run() -> object:
        made: Any = outputs()
        made = made if isinstance(made, tuple) else (made,)
        if not gradients:
            generator = torch.Generator().manual_seed(0)
            gradients.extend(torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in made)
        return torch.autograd.grad(made, inputs, gradients, allow_unused=True)

    return run


def without_gradient(outputs: Run) -> Run:
    """A call that computes ``outputs`` without recording gradients."""

    def run() -> object:
        with torch.no_grad():
            return outputs()

    return run


def _pipeline(gaussians: int, width: int) -> dict[str, KernelPass]:
    primitives, viewpoint = activated(gaussian_field(gaussians)), camera(width)
    with torch.no_grad():
        footprints, rgb = kernels.splat_project(primitives, viewpoint)
    amount = alpha_evaluations(footprints, rgb, width, width)
    draw = lambda: splat_pipeline(primitives, viewpoint)  # noqa: E731
    return _alpha_passes(draw, leaves(primitives), amount)


def _rasterise(gaussians: int, width: int) -> dict[str, KernelPass]:
    primitives = activated(gaussian_field(gaussians))
    with torch.no_grad():
        found, rgb = kernels.splat_project(primitives, camera(width))
    means, conics, opacities, colours = (
        x.detach().requires_grad_() for x in (found.means2d, found.conics, found.opacities, rgb)
    )
    footprints = Footprints(means, conics, opacities, found.depths, found.depth_planes, found.radii)
    amount = alpha_evaluations(footprints, colours, width, width)
    draw = lambda: kernels.splat_rasterise(footprints, colours, width, width)  # noqa: E731
    return _alpha_passes(draw, [means, conics, opacities, colours], amount)


def _alpha_passes(draw: Run, inputs: list[Tensor], amount: float) -> dict[str, KernelPass]:
    limit, unit = limits.exp2(), "alpha evaluations"
    return {
        FORWARD: KernelPass(without_gradient(draw), amount, limit, unit),
        BOTH: KernelPass(forward_backward(draw, inputs), 2 * amount, limit, unit),
    }


def _project(gaussians: int, width: int) -> dict[str, KernelPass]:
    primitives, viewpoint = activated(gaussian_field(gaussians)), camera(width)

    def project() -> tuple[Tensor, ...]:
        footprints, rgb = kernels.splat_project(primitives, viewpoint)
        return footprints.means2d, footprints.conics, footprints.opacities, rgb

    forward = 4.0 * gaussians * (GAUSSIAN_FLOATS + FOOTPRINT_FLOATS)
    backward = 4.0 * gaussians * (2 * GAUSSIAN_FLOATS + FOOTPRINT_FLOATS)
    limit = limits.triad()
    return {
        FORWARD: KernelPass(without_gradient(project), forward, limit, "bytes"),
        BOTH: KernelPass(forward_backward(project, leaves(primitives)), forward + backward, limit, "bytes"),
    }


def _ssim(width: int) -> dict[str, KernelPass]:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(width, width, 3, generator=generator).requires_grad_()
    target = torch.rand(width, width, 3, generator=generator)
    compare = lambda: kernels.ssim(image, target)  # noqa: E731
    limit = limits.sgemm()
    amount = {direction: float(flops) * 3 * width * width for direction, flops in SSIM_FLOPS.items()}
    return {
        FORWARD: KernelPass(without_gradient(compare), amount[FORWARD], limit, "flop"),
        BOTH: KernelPass(forward_backward(compare, [image]), amount[BOTH], limit, "flop"),
    }
