"""Steps and densities per contracted length: against the contraction's own derivative, and compiled against reference."""

from dataclasses import replace

import torch

from invgraphics.core.bounds import Bounds, contract
from invgraphics.core.ngp import FusedNGP, HashGrid
from invgraphics.core.rays import Rays
from invgraphics.kernels import numba, reference
from invgraphics.kernels.numba.rays.march import max_steps
from invgraphics.kernels.reference.march import step_lengths
from invgraphics.kernels.types import March, MarchSteps

F64 = torch.float64
STEPS = MarchSteps(0.03, limit=10_000, contracted=True)


def setting(rays: int = 300, half: float = 0.4) -> tuple[Bounds, Rays]:
    """A small box, looked at from outside and inside, also past it."""
    lo, hi = torch.full((3,), -half, dtype=F64), torch.full((3,), half, dtype=F64)
    bounds = Bounds(lo, hi, "contracted", near=0.1)
    origins = torch.randn(rays, 3, dtype=F64)
    directions = torch.nn.functional.normalize(0.5 * torch.randn(rays, 3, dtype=F64) - origins, dim=1)
    return bounds, bounds.clip(Rays.make(origins, directions))


def single(bounds: Bounds, rays: Rays) -> tuple[Bounds, Rays]:
    return bounds.to(torch.float32), rays.to(torch.float32)


def test_a_step_is_as_long_everywhere_after_contraction() -> None:
    bounds, rays = setting()
    t = 10 ** (3 * torch.rand(len(rays), dtype=F64) - 1)
    length = step_lengths(rays, t, bounds, STEPS)
    tiny = 1e-6 * length
    ends = [contract((rays.at(at) - bounds.centre) / bounds.half) for at in (t, t + tiny)]
    moved = (ends[1] - ends[0]).norm(dim=1) / 1e-6 * float(bounds.half[0])
    torch.testing.assert_close(moved, torch.full_like(moved, STEPS.step), rtol=1e-3, atol=0)


def test_a_step_in_a_box_that_is_no_cube_follows_the_jacobian() -> None:
    bounds = Bounds(torch.tensor([-1.0, -0.5, 0.0], dtype=F64), torch.tensor([1.0, 1.0, 0.8], dtype=F64), "contracted")
    _, rays = setting()
    t = 5 * torch.rand(len(rays), dtype=F64)
    x, v = (rays.at(t) - bounds.centre) / bounds.half, rays.directions / bounds.half
    _, moved = torch.func.jvp(contract, (x,), (v,))
    expected = STEPS.step * v.norm(dim=1) / moved.norm(dim=1)
    torch.testing.assert_close(step_lengths(rays, t, bounds, STEPS), expected)


def test_every_ray_ends_within_the_steps_there_is_room_for() -> None:
    bounds, rays = single(*setting(half=0.1))
    everywhere = torch.ones(8, 8, 8, dtype=torch.bool)
    march = numba.ray_march(rays, everywhere, bounds, STEPS, rays.near)
    counts = torch.bincount(march.ray, minlength=len(rays))
    assert int(counts.max()) < max_steps(rays, bounds, rays.near, STEPS) < 100
    assert torch.equal(march.resume, rays.far)


def alike(ours: March, theirs: March, rays: int) -> None:
    """A step on a cell's wall may be kept by one of the two only."""
    counts = [torch.bincount(march.ray, minlength=rays) for march in (ours, theirs)]
    same = counts[0] == counts[1]
    assert float(same.float().mean()) > 0.97
    assert int(counts[1].sum()) > 10 * rays
    for name in ("t0", "t1"):
        a, b = (getattr(march, name)[same[march.ray]].double() for march in (ours, theirs))
        # Far steps multiply the rounding of those before them.
        assert float(((a - b).abs() < 1e-3 * b).float().mean()) > 0.99


def test_compiled_march_keeps_the_same_intervals() -> None:
    bounds, rays = single(*setting())
    occupied = torch.rand(24, 24, 24) < 0.5
    ours, theirs = (kernels.ray_march(rays, occupied, bounds, STEPS, rays.near) for kernels in (numba, reference))
    alike(ours, theirs, len(rays))


def random_ngp() -> FusedNGP:
    """Random, and about half transparent."""
    grid = HashGrid(levels=4, log2_size=10, base=4, finest=32)
    layer = lambda ins, outs: (torch.randn(outs, ins) / ins**0.5, 0.1 * torch.randn(outs))  # noqa: E731
    geometry, colour = (layer(8, 16), layer(16, 4)), (layer(3, 8), layer(8, 3))
    return FusedNGP(torch.randn(grid.entries, 2), grid, geometry, colour, "exp", -1.0, 0, "srgb", contracted_density=2.5)


def test_compiled_pictures_and_marches_scale_densities_alike() -> None:
    bounds, rays = single(*setting())
    occupied, field, steps = torch.rand(16, 16, 16) < 0.6, random_ngp(), replace(STEPS, step=0.02)
    sums, alpha = numba.ngp_render(rays, occupied, bounds, steps, field)
    exact_sums, exact_alpha = reference.ngp_render(rays, occupied, bounds, steps, field)
    _, other = reference.ngp_render(rays, occupied, bounds, steps, replace(field, contracted_density=0.0))
    assert 0.2 < float(exact_alpha.mean()) < 0.98
    assert float((exact_alpha - other).abs().mean()) > 0.05
    off = ~(((alpha - exact_alpha).abs() <= 1e-4) & ((sums - exact_sums)[:, :3].abs() <= 1e-4).all(dim=1))  # NaN too
    assert off.sum() <= 0.02 * len(rays)
    ours, theirs = (kernels.ngp_march(rays, occupied, bounds, steps, field, rays.near, 0.3) for kernels in (numba, reference))
    alike(ours, theirs, len(rays))


def test_uniform_steps_in_a_box_skip_empty_space_without_losing_any() -> None:
    """Steps that grow with the way from the middle are no lattice, along which empty cells could be skipped by counting."""
    bounds, rays = single(*setting(rays=100))
    bounds = replace(bounds, space="box", lo=bounds.lo * 6, hi=bounds.hi * 6)
    rays = bounds.clip(Rays.make(rays.origins * 2, rays.directions))
    occupied = torch.rand(16, 16, 16, generator=torch.Generator().manual_seed(0)) < 0.02
    ours, theirs = (kernels.ray_march(rays, occupied, bounds, STEPS, rays.near) for kernels in (numba, reference))
    assert len(theirs.ray) > 100
    counts = [torch.bincount(march.ray, minlength=len(rays)) for march in (ours, theirs)]
    same = counts[0] == counts[1]
    assert float(same.float().mean()) > 0.95
    torch.testing.assert_close(ours.t0[same[ours.ray]], theirs.t0[same[theirs.ray]], rtol=1e-4, atol=1e-4)
