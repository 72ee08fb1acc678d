"""Fused rendering and marching of fields over lattices against the unfused reference in float64."""

import itertools
from dataclasses import replace

import pytest
import torch
from lattice_cases import VM_AXES, lattice, linked
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core.bounds import Bounds
from invgraphics.core.fused import ColourHead, CombinedLattices, DensityHead, FusedLattice
from invgraphics.core.rays import Rays
from invgraphics.kernels import numba, reference
from invgraphics.kernels.types import MarchSteps

STEPS = MarchSteps(0.03)
Layers = tuple[tuple[Tensor, Tensor], ...]


def network(*widths: int) -> Layers:
    pairs = itertools.pairwise(widths)
    return tuple((torch.randn(outs, ins) / ins**0.5, 0.3 * torch.randn(outs)) for ins, outs in pairs)


def combined(axes, combine: str, channels: int, scale: float = 1.0) -> CombinedLattices:
    return CombinedLattices(tuple(lattice(name, channels) for name in axes), combine, scale)  # type: ignore[arg-type]


def total(width: int) -> Layers:
    """A network that adds up its inputs."""
    return ((torch.ones(1, width), torch.zeros(1)),)


def vm() -> FusedLattice:
    """TensoRF: components added up, a basis, octaves of its features and of the direction."""
    head = ColourHead("mlp", network(6 * 5 + 3 * 5, 17, 3), 2, "frequency", 2, padding=0.1)
    density = DensityHead("softplus", -1.0, 2.5)
    return FusedLattice(combined(VM_AXES, "vm", 5), total(15), density, combined(VM_AXES, "vm", 20), network(60, 6), head)


def triplane() -> FusedLattice:
    """EG3D: the planes' mean, one softplus network, and a second one that sees the direction."""
    head = ColourHead("mlp", network(7 + 9, 21, 21, 3), direction="sh", degree=3)
    planes = combined(("xy", "xz", "yz"), "sum", 32, 1 / 3)
    return FusedLattice(planes, network(32, 24, 8), DensityHead("exp", 1.0), None, (), head, "softplus")


def voxels() -> FusedLattice:
    """Plenoxels: density and spherical harmonics of degree 2 in one sparse grid, no network."""
    grid = CombinedLattices((linked(28, rows=150),), "concat")
    return FusedLattice(grid, (), DensityHead("relu", 0.5), None, (), ColourHead("sh", activation="clamp"))


def cp() -> FusedLattice:
    """Products of lines, colours of their own, in an endless space."""
    lines = combined("xyz", "cp", 9)
    colours = combined("xyz", "cp", 3)
    head = ColourHead("none", activation="softplus")
    return FusedLattice(lines, total(9), DensityHead("exp", 0.0, 1.5, 0.7), colours, (), head)


def pyramid() -> FusedLattice:
    """Levels of a dense grid, and a density handed on beside a colour encoding of its own."""
    levels = CombinedLattices(tuple(lattice("xyz", 2, (n, n + 1, n)) for n in (3, 5, 8)), "concat")
    head = ColourHead("mlp", network(4 + 18, 12, 3))
    return FusedLattice(levels, network(6, 10, 5), DensityHead("softplus", 1.0), combined(["xyz"], "concat", 18), (), head)


CASES = {make.__name__: make for make in (vm, triplane, voxels, cp, pyramid)}


def setting(space: str = "box", rays: int = 300):
    torch.manual_seed(3)
    bounds = Bounds(torch.tensor([-1.0, -0.8, -1.0]), torch.tensor([1.0, 1.0, 1.2]), space, near=0.1)  # type: ignore[arg-type]
    origins = 0.2 * torch.randn(rays, 3) + torch.tensor([0.0, 0.0, 3.0])
    directions = normalize(0.2 * torch.randn(rays, 3) - torch.tensor([0.0, 0.0, 1.0]), dim=1)
    return bounds, bounds.clip(Rays.make(origins, directions)), torch.rand(16, 16, 16) < 0.3


def in_float64(field: FusedLattice) -> FusedLattice:
    def network_of(layers: Layers) -> Layers:
        return tuple((weight.double(), bias.double()) for weight, bias in layers)

    def encoding_of(encoding: CombinedLattices) -> CombinedLattices:
        return replace(encoding, lattices=tuple(replace(x, features=x.features.double()) for x in encoding.lattices))

    return replace(
        field,
        geometry=encoding_of(field.geometry),
        geometry_net=network_of(field.geometry_net),
        appearance=None if field.appearance is None else encoding_of(field.appearance),
        basis=network_of(field.basis),
        colour=replace(field.colour, net=network_of(field.colour.net)),
    )


def doubled(bounds: Bounds, rays: Rays) -> tuple[Rays, Bounds]:
    exact = Rays(*(x.double() if x.is_floating_point() else x for x in vars(rays).values()))
    return exact, Bounds(bounds.lo.double(), bounds.hi.double(), bounds.space, bounds.near)


@pytest.mark.parametrize("name", CASES)
def test_a_picture_equals_its_parts(name: str) -> None:
    contracted = name == "cp"
    bounds, rays, occupied = setting("contracted" if contracted else "box")
    field, steps = CASES[name](), replace(STEPS, contracted=contracted)
    (sums, alpha), again = (numba.lattice_render(rays, occupied, bounds, steps, field) for _ in range(2))
    exact_rays, exact_bounds = doubled(bounds, rays)
    exact_sums, exact = reference.lattice_render(exact_rays, occupied, exact_bounds, steps, in_float64(field))
    assert 0.1 < float(exact.mean()) < 0.99
    assert float(exact_sums[:, :3].std()) > 0.02
    # A step on a cell's wall may be kept by one of the two only.
    near = (sums - exact_sums).abs() <= 2e-5 * exact_sums.abs().max()
    off = ~(((alpha - exact).abs() <= 2e-5) & near.all(dim=1))
    assert off.sum() <= 0.01 * len(rays)
    assert torch.equal(sums, again[0])
    assert torch.equal(alpha, again[1])


@pytest.mark.parametrize("name", ["vm", "voxels"])
@pytest.mark.parametrize("transmittance", [0.0, 0.2])
def test_a_march_keeps_what_light_reaches(name: str, transmittance: float) -> None:
    bounds, rays, occupied = setting()
    field = CASES[name]()
    field = replace(field, density=replace(field.density, scale=3.0))
    ours = numba.lattice_march(rays, occupied, bounds, STEPS, field, rays.near, transmittance)
    exact_rays, exact_bounds = doubled(bounds, rays)
    call = exact_rays, occupied, exact_bounds, STEPS, in_float64(field), exact_rays.near, transmittance
    theirs = reference.lattice_march(*call)
    counts = [torch.bincount(march.ray, minlength=len(rays)) for march in (ours, theirs)]
    same = counts[0] == counts[1]
    assert float(same.float().mean()) > 0.98
    torch.testing.assert_close(ours.t0[same[ours.ray]].double(), theirs.t0[same[theirs.ray]], rtol=0, atol=1e-5)
    everything = reference.ray_march(rays, occupied, bounds, STEPS, rays.near)
    assert (len(ours.ray) == len(everything.ray)) == (transmittance == 0)


def test_leaves_out_no_more_than_it_may() -> None:
    bounds, rays, occupied = setting()
    field = triplane()
    whole, alpha = numba.lattice_render(rays, occupied, bounds, STEPS, field)
    _, less = numba.lattice_render(rays, occupied, bounds, STEPS, field, min_transmittance=0.2)
    assert 0.02 < float((alpha - less).max()) <= 0.2 + 1e-5
    coarse, same = numba.lattice_render(rays, occupied, bounds, STEPS, field, max_error=0.1)
    assert torch.equal(same, alpha)
    missing = (whole - coarse)[:, :3]
    assert float(missing.min()) >= -1e-5 and 0.01 < float(missing.max()) <= 0.1 + 1e-5


@pytest.mark.parametrize("width", [7, 20])
def test_pictures_of_any_width_and_any_number_of_threads_are_alike(width: int) -> None:
    bounds, rays, occupied = setting()
    field, before, found = vm(), torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(numba.lattice_render(rays, occupied, bounds, STEPS, field, 1e-3, 0.0, (0, width)[count - 1]))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[0][1], found[1][1])
    torch.testing.assert_close(found[0][0], found[1][0], rtol=0, atol=1e-5)


def test_nothing_to_see() -> None:
    bounds, rays, occupied = setting(rays=9)
    sums, alpha = numba.lattice_render(rays[:0], occupied, bounds, STEPS, vm())
    assert sums.shape == (0, 4) and alpha.shape == (0,)
    sums, alpha = numba.lattice_render(rays, torch.zeros_like(occupied), bounds, STEPS, vm())
    assert float(sums.abs().sum() + alpha.sum()) == 0


def test_a_crop_leaves_the_contraction_of_densities_to_the_bounds() -> None:
    bounds, rays, occupied = setting("contracted")
    corner = torch.tensor([0.2, 0.15, 0.1]).tolist(), torch.tensor([0.8, 0.9, 0.95]).tolist()
    field = replace(cp(), crop=tuple(map(tuple, corner)))
    steps = replace(STEPS, contracted=True)
    exact_rays, exact_bounds = doubled(bounds, rays)
    exact_sums, exact = reference.lattice_render(exact_rays, occupied, exact_bounds, steps, in_float64(field))
    sums, alpha = numba.lattice_render(rays, occupied, bounds, steps, field)
    assert 0.1 < float(exact.mean()) < 0.99
    off = ((alpha - exact).abs() > 2e-5) | ((sums - exact_sums).abs() > 2e-5 * exact_sums.abs().max()).any(dim=1)
    assert off.sum() <= 0.02 * len(rays)
