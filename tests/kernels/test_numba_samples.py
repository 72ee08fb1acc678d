"""Numba's kernels on packed samples and images against the plain reference in float64, gradients included."""

import time

import numpy as np
import pytest
import torch

from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import HashGrid
from invgraphics.core.rays import Rays
from invgraphics.kernels import numba, reference
from invgraphics.kernels.numba.runtime import _compiler
from invgraphics.kernels.numba.runtime import threads as numba_threads
from invgraphics.kernels.reference.hash import entry_index
from invgraphics.kernels.reference.lattice import locate
from invgraphics.kernels.types import MarchSteps


def differentiate(function, inputs, dtype):
    """Outputs of ``function`` and the gradients of their randomly weighted sum."""
    leaves = [x.detach().to(dtype).clone().requires_grad_() for x in inputs]
    outputs = function(*leaves)
    outputs = [x for x in (outputs if isinstance(outputs, tuple) else (outputs,)) if x is not None]
    generator = torch.Generator().manual_seed(2)
    sum((x * torch.randn(x.shape, generator=generator).to(dtype)).sum() for x in outputs).backward()
    return [x.detach() for x in outputs] + [leaf.grad for leaf in leaves if leaf.grad is not None]


def assert_equal(fast, plain, inputs, tolerance=1e-5):
    """Within fp32 rounding of the truth, relative to the largest entry; and the same bits when repeated."""
    numbers, again = (differentiate(fast, inputs, torch.float32) for _ in range(2))
    truth = differentiate(plain, inputs, torch.float64)
    assert len(numbers) == len(truth)
    for number, repeated, true in zip(numbers, again, truth, strict=True):
        assert torch.equal(number, repeated)
        assert (number - true).abs().max() <= tolerance * true.abs().max()


POINTS = torch.rand(400, 3, generator=torch.Generator().manual_seed(5)) * 1.2 - 0.1
CORNERS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 1.0, 0.0], [-3.0, 0.5, 2.0]])


@pytest.mark.parametrize(
    "grid",
    [
        HashGrid(levels=8, features=2, log2_size=12, base=4, finest=1024),
        HashGrid(levels=3, features=1, log2_size=8, base=1, finest=64),
        HashGrid(levels=5, features=5, log2_size=10, base=3, finest=100),
    ],
)
def test_hash_encoding(grid):
    # More than one thread's chunk, and no whole number of blocks.
    many = torch.rand(9001, 3, generator=torch.Generator().manual_seed(6))
    unit, table = torch.cat([POINTS, CORNERS, many]), torch.randn(grid.entries, grid.features)
    assert_equal(lambda u, t: numba.hash_encode(u, t, grid), lambda u, t: reference.hash_encode(u, t, grid), [unit, table])


@pytest.mark.parametrize("features", [2, 3])
def test_the_gradient_of_positions_is_differentiable_in_table_and_cotangent(features):
    grid = HashGrid(levels=5, features=features, log2_size=9, base=3, finest=70)
    unit = torch.cat([POINTS, CORNERS])

    def gradient(kernels, table, cotangent):
        moving = unit.to(table.dtype).requires_grad_()
        encoded = kernels.hash_encode(moving, table, grid)[0]
        return torch.autograd.grad(encoded, moving, cotangent, create_graph=True)[0]

    inputs = [torch.randn(grid.entries, features), torch.randn(len(unit), grid.levels * features)]
    assert_equal(lambda t, c: gradient(numba, t, c), lambda t, c: gradient(reference, t, c), inputs)


def test_a_position_just_below_a_vertex_lies_in_the_cell_below():
    """Its product with the number of cells is rounded up to the vertex; the derivative along it tells the cells apart."""
    grid = HashGrid(levels=1, features=2, log2_size=12, base=4093, finest=4093)
    unit = (torch.arange(1, 4093) / torch.tensor(4093.0, dtype=torch.float64)).float()[:, None].expand(-1, 3)
    assert ((unit * 4093).floor() > (unit.double() * 4093).floor()).sum() > 1000
    assert_equal(
        lambda u, t: numba.hash_encode(u, t, grid), lambda u, t: reference.hash_encode(u, t, grid),
        [unit, torch.randn(grid.entries, 2)],
    )  # fmt: skip


def test_hash_encoding_of_nothing_and_of_bad_numbers():
    grid = HashGrid(levels=2, log2_size=6, base=2, finest=32)
    table = torch.randn(grid.entries, 2, requires_grad=True)
    features, _ = numba.hash_encode(torch.zeros(0, 3), table, grid)
    features.sum().backward()
    assert features.shape == (0, 4)
    assert not table.grad.any()
    bad = torch.tensor([[torch.nan, 0.5, 0.5], [torch.inf, -torch.inf, 0.5], [1e30, -1e30, 0.0]], requires_grad=True)
    numba.hash_encode(bad, table, grid)[0].sum().backward()


def test_numbers_of_a_table_that_31_bits_cannot_count():
    grid = HashGrid(levels=2, features=2, log2_size=31, base=2, finest=4096)
    points = POINTS[:40]
    try:
        table = torch.from_numpy(np.zeros((grid.entries, grid.features), np.float32))  # 17 GB; untouched pages take no memory
    except MemoryError:
        pytest.skip("this machine promises no memory beyond what it has")
    table[: grid.sizes[0]] = torch.randn(grid.sizes[0], 2)
    vertices = locate(points, torch.tensor([4096] * 3)).vertices
    rows = grid.offsets[1] + entry_index(vertices, 4096, grid.log2_size).flatten().unique()
    assert rows.max() * grid.features > 1 << 31 > rows.min() * grid.features
    table[rows] = torch.randn(len(rows), 2)
    features, _ = numba.hash_encode(points, table, grid)
    assert torch.allclose(features, reference.hash_encode(points, table, grid)[0], atol=1e-5)


def test_jacobian_comes_from_the_reference():
    grid = HashGrid(levels=2, log2_size=6, base=2, finest=32)
    table = torch.randn(grid.entries, 2)
    for ours, theirs in zip(
        numba.hash_encode(POINTS, table, grid, True), reference.hash_encode(POINTS, table, grid, True), strict=True
    ):
        assert torch.equal(ours, theirs)


def packed(n):
    """Sorted ray indices, with rays of no sample, of one and of many."""
    counts = torch.randint(0, 60, (n,))
    counts[::7], counts[1::7] = 0, 1
    return torch.repeat_interleave(torch.arange(n), counts)


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_compositing(channels):
    ray = packed(120)
    depth = torch.rand(len(ray)) ** 6 * 2
    depth[7], depth[30:40] = 1e6, 0.0
    inputs = [depth, torch.randn(len(ray), channels)]
    assert_equal(lambda d, c: numba.composite(d, c, ray, 120), lambda d, c: reference.composite(d, c, ray, 120), inputs)


def test_thin_media_keep_their_digits():
    ray, depth = torch.zeros(1000, dtype=torch.int64), torch.full((1000,), 1e-6)
    _, _, alpha = numba.composite(depth, torch.ones(1000, 1), ray, 1)
    assert alpha.item() == pytest.approx(-torch.expm1(torch.tensor(-1e-3, dtype=torch.float64)).item(), rel=1e-5)


def test_compositing_of_nothing():
    weights, sums, alpha = numba.composite(torch.zeros(0), torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), 4)
    assert (weights.shape, sums.shape, alpha.shape) == ((0,), (4, 3), (4,))
    assert not sums.any()
    assert not alpha.any()


def test_compositing_refuses_rays_out_of_range():
    with pytest.raises(IndexError, match="5 rays"):
        numba.composite(torch.ones(2), torch.ones(2, 1), torch.tensor([0, 5]), 5)


@pytest.mark.parametrize("size", [(37, 45, 3), (5, 4, 1), (12, 30, 4), (1, 1, 3)])
def test_ssim(size):
    target = torch.rand(size)
    image = (target + 0.1 * torch.randn(size)).clamp(0, 1)
    assert_equal(lambda x: numba.ssim(x, target), lambda x: reference.ssim(x, target.double()), [image])


def box_of_rays(n, space):
    bounds = Bounds(torch.tensor([-1.0, -1.2, -0.8]), torch.tensor([1.0, 1.1, 1.0]), space)
    origins = torch.nn.functional.normalize(torch.randn(n, 3), dim=1) * 3
    directions = torch.nn.functional.normalize(torch.randn(n, 3) * 0.4 - origins, dim=1)
    directions[0] = torch.tensor([0.0, 0.0, 1.0])
    return bounds, bounds.clip(Rays.make(origins, directions))


@pytest.mark.parametrize(
    ("space", "cone", "limit", "step"),
    [("box", 0.0, 1024, 0.01), ("box", 0.0, 7, 0.01), ("box", 1 / 64, 1024, 0.005), ("box", 0.0, 1024, 5.0)],
)
def test_march_keeps_the_same_intervals(space, cone, limit, step):
    bounds, rays = box_of_rays(150, space)
    occupied = torch.rand(24, 24, 24) < 0.05
    start, steps = rays.near + torch.rand(150) * 0.01, MarchSteps(step, cone, limit)
    ours, theirs = (kernels.ray_march(rays, occupied, bounds, steps, start) for kernels in (numba, reference))
    assert len(ours.ray) > 0
    for name in ("ray", "t0", "t1", "resume"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name


def test_march_through_contracted_space_keeps_nearly_the_same_intervals():
    bounds, rays = box_of_rays(150, "contracted")
    occupied = torch.rand(24, 24, 24) < 0.05
    ours, theirs = (k.ray_march(rays, occupied, bounds, MarchSteps(0.02, 1 / 64), rays.near) for k in (numba, reference))
    # A sum of three squares may be rounded in another order, which can flip a sample that lies on a cell's wall.
    both = set(zip(ours.ray.tolist(), ours.t0.tolist(), strict=True)) & set(
        zip(theirs.ray.tolist(), theirs.t0.tolist(), strict=True)
    )
    assert len(both) >= 0.99 * max(len(ours.ray), len(theirs.ray)) > 100


def test_march_goes_on_in_parts():
    bounds, rays = box_of_rays(60, "box")
    occupied = torch.rand(24, 24, 24) < 0.2
    whole = numba.ray_march(rays, occupied, bounds, MarchSteps(0.01), rays.near)
    start, t0 = rays.near, []
    while (start < rays.far).any():
        part = numba.ray_march(rays, occupied, bounds, MarchSteps(0.01, limit=5), start)
        t0.append(part.t0[part.ray == 3])
        start = part.resume
    torch.testing.assert_close(torch.cat(t0), whole.t0[whole.ray == 3])


def test_march_of_nothing_and_of_bad_numbers():
    bounds, rays = box_of_rays(8, "box")
    full, steps = torch.ones(4, 4, 4, dtype=torch.bool), MarchSteps(0.1)
    assert len(numba.ray_march(rays[:0], full, bounds, steps, rays.near[:0]).ray) == 0
    assert len(numba.ray_march(rays, ~full, bounds, steps, rays.near).ray) == 0
    for tensor in (rays.origins, rays.directions, rays.near, rays.far):
        tensor[::3] = torch.nan
    march = numba.ray_march(rays, full, bounds, steps, rays.near)
    assert set(march.ray.tolist()) <= {1, 2, 4, 5, 7}


def test_warm_up_leaves_nothing_to_compile():
    """All but what serves several threads; the same calls need no more."""
    numba.warm_up()
    before = {kernel: len(kernel.signatures) for kernel in _compiler.kernels}
    for_threads = {"sample_rows", "add_copies"} if numba_threads() == 1 else set()
    assert {kernel.py_func.__name__ for kernel, count in before.items() if not count} <= for_threads
    began = time.perf_counter()
    assert 0 < numba.warm_up() <= time.perf_counter() - began
    assert {kernel: len(kernel.signatures) for kernel in _compiler.kernels} == before
