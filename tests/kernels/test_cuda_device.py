"""On a GPU: the CUDA kernels against the reference in float64 on the CPU. Skipped where there is none."""

import pytest
import torch

from invgraphics import kernels
from invgraphics.bench.workload import activated, camera, gaussian_field
from invgraphics.core.ngp import HashGrid
from invgraphics.kernels import reference

if not torch.cuda.is_available():
    pytest.skip("torch finds no CUDA device", allow_module_level=True)
from triton_parity import CHECKS, check  # which needs Triton


def compare(function, plain, inputs, tolerance: float) -> None:
    results = []
    for run, device, dtype in ((function, "cuda", torch.float32), (plain, "cpu", torch.float64)):
        leaves = [x.detach().to(device, dtype, copy=True).requires_grad_() for x in inputs]
        outputs = run(*leaves)
        sum(output.square().sum() for output in outputs).backward()
        results.append([*(output.detach().cpu() for output in outputs), *(leaf.grad.cpu() for leaf in leaves)])
    for ours, theirs in zip(*results, strict=True):
        assert (ours - theirs).abs().max() <= tolerance * theirs.abs().max()


@pytest.mark.parametrize("name", CHECKS)
def test_parity(name: str) -> None:
    """What `test_cuda_interpreted` checks without a GPU."""
    with torch.device("cuda"):
        check(name)


def test_hash_encoding() -> None:
    grid = HashGrid(levels=16, log2_size=15)
    unit = torch.rand(9000, 3, dtype=torch.float64)
    # The gradient along a position jumps from cell to cell, and float32 does not see which one a point near a wall is in.
    from_wall = torch.stack([(unit * edge - (unit * edge).round()).abs() for edge in grid.resolutions]).amin((0, 2))
    inputs = [unit[from_wall > 1e-3].float(), torch.randn(grid.entries, 2)]
    assert len(inputs[0]) > 5000
    compare(
        lambda u, t: kernels.hash_encode(u, t, grid)[:1], lambda u, t: reference.hash_encode(u, t, grid)[:1], inputs, 2e-3
    )  # fp32 coordinates at resolution 2048 leave 1e-4 of a cell


def test_compositing() -> None:
    ray = torch.repeat_interleave(torch.arange(500), torch.randint(0, 90, (500,)))
    inputs = [torch.rand(len(ray)) ** 6 * 2, torch.randn(len(ray), 4)]
    compare(
        lambda d, c: kernels.composite(d, c, ray.cuda(), 500), lambda d, c: reference.composite(d, c, ray, 500), inputs, 1e-5
    )


@pytest.mark.parametrize("channels", [3, 7])
def test_splats(channels: int) -> None:
    primitives, view = activated(gaussian_field(2000)), camera(128)
    footprints, _ = reference.splat_project(primitives, view)
    inputs = [footprints.means2d, footprints.conics, footprints.opacities, torch.rand(len(footprints), channels)]

    def draw(rasterise, means2d, conics, opacities, features):
        rest = [x.detach().to(means2d) for x in (footprints.depths, footprints.depth_planes, footprints.radii)]
        return rasterise(type(footprints)(means2d, conics, opacities, *rest), features, 128, 128)

    compare(lambda *x: draw(kernels.splat_rasterise, *x), lambda *x: draw(reference.splat_rasterise, *x), inputs, 2e-3)
