"""Pictures of hash grids and marches through them, in one pass, against the operations they are made of, in float64."""

from dataclasses import replace
from importlib import import_module
from itertools import pairwise

import pytest
import torch
from torch.nn.functional import normalize

from invgraphics.core.bounds import Bounds
from invgraphics.core.ngp import FusedNGP, HashGrid
from invgraphics.core.rays import Rays
from invgraphics.kernels import numba, reference
from invgraphics.kernels.types import MarchSteps

GRID = HashGrid(levels=6, log2_size=12, base=8, finest=128)


def network(*widths: int):
    return tuple((torch.randn(o, i) / i**0.5, 0.1 * torch.randn(o)) for i, o in pairwise(widths))


def random_ngp(hidden=(20,), handed=13, bands=4, density="exp", space="srgb", features=2) -> FusedNGP:
    """Random tables and networks, about half transparent over a few units."""
    grid = replace(GRID, features=features)
    geometry, colour = network(grid.levels * features, *hidden, 1 + handed), network(handed + bands**2, 24, 24, 3)
    return FusedNGP(torch.randn(grid.entries, features), grid, geometry, colour, density, 1.0, bands, space)


def doubled(field: FusedNGP) -> FusedNGP:
    geometry, colour = (tuple((w.double(), b.double()) for w, b in net) for net in (field.density_net, field.colour_net))
    return replace(field, table=field.table.double(), density_net=geometry, colour_net=colour)


def setting(space="box", rays=500):
    bounds = Bounds(torch.tensor([-1.0, -0.8, -1.0]), torch.tensor([1.0, 1.0, 1.2]), space, near=0.1)
    origins = 0.2 * torch.randn(rays, 3) + torch.tensor([0.0, 0.0, 3.0])
    directions = normalize(0.2 * torch.randn(rays, 3) - torch.tensor([0.0, 0.0, 1.0]), dim=1)
    return bounds, bounds.clip(Rays.make(origins, directions)), torch.rand(16, 16, 16) < 0.3


def in_float64(rays, occupied, bounds, steps, field):
    """Arguments whose every number is exact."""
    where = Bounds(bounds.lo.double(), bounds.hi.double(), bounds.space, bounds.near)
    exact = Rays(*(x.double() if x.is_floating_point() else x for x in vars(rays).values()))
    return exact, occupied, where, steps, doubled(field)


@pytest.mark.parametrize(
    ("parts", "space", "cone"),
    [
        ({}, "box", 0.0),
        ({"hidden": (20, 33), "bands": 0, "density": "softplus", "space": "linear"}, "box", 0.02),
        ({"hidden": (), "bands": 1, "density": "relu", "handed": 3}, "box", 0.0),
        ({"hidden": (64,), "bands": 2}, "contracted", 0.02),
    ],
)
def test_equals_its_parts(parts, space, cone) -> None:
    bounds, rays, occupied = setting(space)
    field, steps = random_ngp(**parts), MarchSteps(0.03, cone)
    (sums, alpha), again = (numba.ngp_render(rays, occupied, bounds, steps, field) for _ in range(2))
    exact_sums, exact_alpha = reference.ngp_render(*in_float64(rays, occupied, bounds, steps, field))
    assert 0.2 < float(exact_alpha.mean()) < 0.99
    # A step on a cell's wall may be kept by one of the two only.
    near = (sums - exact_sums).abs() <= 1e-5 * exact_sums.abs().max()
    off = ~(((alpha - exact_alpha).abs() <= 1e-5) & near.all(dim=1))
    assert off.sum() <= 0.01 * len(rays)
    assert torch.equal(sums, again[0])
    assert torch.equal(alpha, again[1])


def test_leaves_out_no_more_than_it_may() -> None:
    """A share of the light, and a share of the colours, which are in [0, 1]; and it does leave something out."""
    bounds, rays, occupied = setting()
    field = replace(random_ngp(), density_bias=4.0)
    _, alpha = numba.ngp_render(rays, occupied, bounds, MarchSteps(0.03), field)
    _, less = numba.ngp_render(rays, occupied, bounds, MarchSteps(0.03), field, min_transmittance=0.2)
    assert 0.05 < float((alpha - less).max()) <= 0.2 + 1e-5
    assert bool((less >= torch.minimum(alpha, torch.tensor(0.8)) - 1e-5).all())
    # Each step of thinner fog weighs less than that; all of them together weigh more.
    field = replace(field, density_bias=0.0)
    whole, alpha = numba.ngp_render(rays, occupied, bounds, MarchSteps(0.03), field)
    coarse, same = numba.ngp_render(rays, occupied, bounds, MarchSteps(0.03), field, max_error=0.1)
    assert torch.equal(same, alpha)
    assert torch.equal(coarse[:, 3], whole[:, 3])
    missing = (whole - coarse)[:, :3]
    assert float(missing.min()) >= -1e-5 and float(missing.max()) <= 0.1 + 1e-5
    assert float((missing.amax(dim=1) > 0.02)[alpha > 0.2].float().mean()) > 0.9


def test_rays_do_not_depend_on_each_other_nor_on_the_threads() -> None:
    bounds, rays, occupied = setting()
    field, steps = random_ngp(), MarchSteps(0.03)
    before = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(numba.ngp_render(rays, occupied, bounds, steps, field, 1e-3))
    finally:
        torch.set_num_threads(before)
    some = torch.tensor([3, 77, 78, 400])
    results.append(numba.ngp_render(rays[some], occupied, bounds, steps, field, 1e-3))
    assert torch.equal(results[0][1], results[1][1])
    assert torch.equal(results[0][1][some], results[2][1])
    # Colours are added up as they come.
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=1e-5)
    torch.testing.assert_close(results[0][0][some], results[2][0], rtol=0, atol=1e-5)


@pytest.mark.parametrize("width", [1, 7, 8, 20, 33, 10_000])
def test_pictures_of_any_width_have_every_ray_once(width: int) -> None:
    bounds, rays, occupied = setting()
    call = rays, occupied, bounds, MarchSteps(0.03), random_ngp(), 1e-3, 0.0
    in_order, by_blocks = numba.ngp_render(*call), numba.ngp_render(*call, width)
    assert torch.equal(by_blocks[1], in_order[1])
    torch.testing.assert_close(by_blocks[0], in_order[0], rtol=0, atol=1e-5)


def test_nothing_to_see_and_bad_numbers() -> None:
    bounds, rays, occupied = setting(rays=9)
    field, steps = random_ngp(), MarchSteps(0.03)
    sums, alpha = numba.ngp_render(rays[:0], occupied, bounds, steps, field)
    assert sums.shape == (0, 4) and alpha.shape == (0,)
    sums, alpha = numba.ngp_render(rays, torch.zeros_like(occupied), bounds, steps, field)
    assert float(sums.abs().sum() + alpha.sum()) == 0
    whole = numba.ngp_render(rays, occupied, bounds, steps, field)
    for tensor in (rays.origins, rays.directions, rays.near, rays.far):
        tensor[::3] = torch.nan
    sums, alpha = numba.ngp_render(rays, occupied, bounds, steps, field)
    good = torch.arange(9) % 3 > 0
    torch.testing.assert_close(sums[good], whole[0][good], rtol=0, atol=1e-5)
    assert torch.equal(alpha[good], whole[1][good])


@pytest.mark.parametrize("transmittance", [0.0, 0.1])
def test_march_keeps_what_light_reaches(transmittance: float) -> None:
    bounds, rays, occupied = setting()
    field, steps = replace(random_ngp(), density_bias=2.0), MarchSteps(0.03)
    start = rays.near + 0.03 * torch.rand(len(rays))
    ours = numba.ngp_march(rays, occupied, bounds, steps, field, start, transmittance)
    exact = in_float64(rays, occupied, bounds, steps, field)
    theirs = reference.ngp_march(*exact, start.double(), transmittance)
    everything = reference.ray_march(rays, occupied, bounds, steps, start)
    counts = [torch.bincount(march.ray, minlength=len(rays)) for march in (ours, theirs, everything)]
    same = counts[0] == counts[1]
    assert float(same.float().mean()) > 0.98
    for name in ("t0", "t1"):
        a, b = (getattr(march, name)[same[march.ray]].double() for march in (ours, theirs))
        torch.testing.assert_close(a, b, rtol=0, atol=1e-5)
    assert torch.equal(ours.ray, ours.ray.sort().values)
    if transmittance:
        assert 0.1 < len(ours.ray) / len(everything.ray) < 0.9
    else:
        assert all(torch.equal(getattr(ours, name), getattr(everything, name)) for name in ("ray", "t0", "t1"))


def test_march_of_many_long_rays_is_done_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    bounds, rays, occupied = setting(rays=50)
    field, steps = random_ngp(), MarchSteps(0.03)
    whole = numba.ngp_march(rays, occupied, bounds, steps, field, rays.near, 0.1)
    # By path: the package's attribute of this name is the operation.
    monkeypatch.setattr(import_module("invgraphics.kernels.numba.ngp.march"), "MAX_INTERVALS", 700)
    parts = numba.ngp_march(rays, occupied, bounds, steps, field, rays.near, 0.1)
    assert all(torch.equal(getattr(whole, name), getattr(parts, name)) for name in ("ray", "t0", "t1", "resume"))
    none = numba.ngp_march(rays[:0], occupied, bounds, steps, field, rays.near[:0], 0.1)
    assert len(none.ray) == len(none.resume) == 0


def test_other_widths_of_an_entry_go_to_the_reference() -> None:
    bounds, rays, occupied = setting(rays=40)
    field, steps = random_ngp(features=3), MarchSteps(0.03)
    ours, theirs = (kernels.ngp_render(rays, occupied, bounds, steps, field) for kernels in (numba, reference))
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    ours, theirs = (k.ngp_march(rays, occupied, bounds, steps, field, rays.near, 0.1) for k in (numba, reference))
    assert torch.equal(ours.t1, theirs.t1)


def test_the_reference_goes_on_where_a_march_has_kept_all_it_may() -> None:
    bounds, rays, occupied = setting(rays=40)
    field = random_ngp()
    whole, parts = (reference.ngp_render(rays, occupied, bounds, MarchSteps(0.03, limit=n), field) for n in (1024, 5))
    for a, b in zip(whole, parts, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-5)
