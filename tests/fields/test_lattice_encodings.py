"""Voxels, factors and planes against dense tensors, torch's own sampler, a hash grid and their own resized selves."""

from itertools import combinations, product

import pytest
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from invgraphics import kernels
from invgraphics.config import fill, to_table
from invgraphics.core.ngp import HashGrid
from invgraphics.errors import InputError
from invgraphics.fields.encodings.factors import CpConfig, VmConfig
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.encodings.lattices import LatticeFeatures, vertices_along
from invgraphics.fields.encodings.triplane import TriplaneConfig
from invgraphics.fields.encodings.voxels import VoxelsConfig

EDGES = (5.0, 6.0, 7.0)
"""Of a box in which every axis has another number of vertices."""
KINDS = {
    "voxels": VoxelsConfig(resolution=6, features=3, spread=1.0),
    "levels": VoxelsConfig(resolution=13, features=2, levels=3, coarsest=4, spread=1.0),
    "vm": VmConfig(resolution=6, components=5, initial=1.0),
    "cp": CpConfig(resolution=6, components=7, initial=1.0),
    "triplane": TriplaneConfig(resolution=6, features=4, initial=1.0),
}


def encoding_of(kind: str, seed: int = 0) -> LatticeFeatures:
    torch.manual_seed(seed)
    return KINDS[kind].build(EDGES)


def values(encoding: LatticeFeatures) -> dict[str, Tensor]:
    return {name: parameter.detach() for name, parameter in encoding.named_parameters()}


def trilinear(grid: Tensor, unit: Tensor) -> Tensor:
    """Torch's own interpolation of a grid [x, y, z] at points in the unit cube."""
    places = (2 * unit - 1)[None, None, None]
    return grid_sample(grid.permute(2, 1, 0)[None, None], places, align_corners=True).reshape(-1)


@pytest.mark.parametrize("kind", ["vm", "cp"])
def test_factors_are_the_dense_tensor_that_they_factor(kind: str) -> None:
    encoding, unit = encoding_of(kind), torch.rand(200, 3)
    v = values(encoding)
    assert encoding.resolution == (5, 6, 7)
    if kind == "vm":
        dense = (
            torch.einsum("xyr,zr->xyz", v["planes.xy"], v["lines.z"])
            + torch.einsum("xzr,yr->xyz", v["planes.xz"], v["lines.y"])
            + torch.einsum("yzr,xr->xyz", v["planes.yz"], v["lines.x"])
        )
    else:
        dense = torch.einsum("xr,yr,zr->xyz", v["lines.x"], v["lines.y"], v["lines.z"])
    assert dense.shape == (5, 6, 7)
    torch.testing.assert_close(encoding(unit).sum(dim=1), trilinear(dense, unit), atol=1e-5, rtol=1e-5)


def test_dense_levels_are_a_hash_grid_without_collisions() -> None:
    """A level of R cells has R + 1 vertices, of which the first lies at 0 and the last at 1, in both.

    The hash grid's table is large enough for all vertices of all levels, which it then stores x fastest.
    """
    grid = HashGrid(levels=3, features=2, log2_size=11, base=3, finest=11)
    hashed = HashConfig(**vars(grid)).build()
    assert grid.sizes == tuple((r + 1) ** 3 for r in grid.resolutions)
    torch.nn.init.normal_(hashed.table)
    dense = VoxelsConfig(resolution=12, features=2, levels=3, coarsest=4).build()
    assert dense.width == hashed.width
    with torch.no_grad():
        parts = hashed.table.split(list(grid.sizes))
        for parameter, part, r in zip(dense.parameters(), parts, grid.resolutions, strict=True):
            parameter.copy_(part.view(r + 1, r + 1, r + 1, 2).permute(2, 1, 0, 3))
    unit = torch.rand(300, 3, requires_grad=True)
    one, other = dense(unit), hashed(unit)
    torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)
    slopes = [torch.autograd.grad(features.square().sum(), unit)[0] for features in (one, other)]
    torch.testing.assert_close(*slopes, atol=1e-4, rtol=1e-4)


def test_the_triplane_is_the_mean_of_three_planes() -> None:
    encoding, unit = encoding_of("triplane"), torch.rand(100, 3)
    v = values(encoding)
    expected = torch.zeros(100, encoding.width)
    for axes in ("xy", "xz", "yz"):
        columns = ["xyz".index(axis) for axis in axes]
        places = (2 * unit[:, columns[::-1]] - 1)[None, None]
        expected += grid_sample(v[f"planes.{axes}"].permute(2, 0, 1)[None], places, align_corners=True)[0, :, 0].T / 3
    torch.testing.assert_close(encoding(unit), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", ["triplane", "vm"])
def test_no_plane_repeats_another(kind: str) -> None:
    """Of every two axes there is a plane: without, features would be a sum of functions of one of them each."""
    encoding, base = encoding_of(kind), torch.full((3,), 0.3)
    if kind == "vm":
        with torch.no_grad():
            for line in "xyz":
                encoding.get_parameter(f"lines.{line}").fill_(1.0)
    for first, second in combinations(range(3), 2):
        corners = []
        for a, b in product((0.2, 0.7), repeat=2):
            point = base.clone()
            point[first], point[second] = a, b
            corners.append(encoding(point[None])[0])
        mixed = corners[0] - corners[1] - corners[2] + corners[3]
        assert float(mixed.detach().abs().max()) > 1e-2, f"no plane of axes {first} and {second}"
    planes = [frozenset(lattice.axes) for lattice in encoding.lattices() if len(lattice.axes) == 2]
    assert len(set(planes)) == len(planes) == 3


@pytest.mark.parametrize("kind", KINDS)
def test_twice_the_cells_leave_the_function_unchanged(kind: str) -> None:
    encoding, unit = encoding_of(kind), torch.rand(300, 3)
    before, old = encoding(unit).detach(), dict(encoding.named_parameters())
    x, y, z = encoding.resolution
    encoding.resize((2 * x - 1, 2 * y - 1, 2 * z - 1))
    torch.testing.assert_close(encoding(unit), before, atol=1e-5, rtol=1e-5)
    new = dict(encoding.named_parameters())
    assert encoding.resolution == (2 * x - 1, 2 * y - 1, 2 * z - 1)
    assert new.keys() == old.keys()
    assert all(new[name] is not old[name] and new[name].is_contiguous() and new[name].requires_grad for name in new)
    assert all(new[name].numel() > old[name].numel() for name in new)


def test_a_resized_grid_has_the_old_function_at_its_vertices() -> None:
    encoding = encoding_of("voxels")
    old = values(encoding)["levels.0"]
    encoding.resize((9, 4, 11))
    new = values(encoding)["levels.0"]
    vertices = torch.cartesian_prod(*(torch.linspace(0, 1, size) for size in (9, 4, 11)))
    for channel in range(3):
        expected = trilinear(old[..., channel], vertices).view(9, 4, 11)
        torch.testing.assert_close(new[..., channel], expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_resized_state_loads_into_a_new_encoding(kind: str) -> None:
    one, other, unit = encoding_of(kind), encoding_of(kind, 1), torch.rand(50, 3)
    one.resize((8, 9, 12))
    kept = dict(other.named_parameters())
    other.load_state_dict(one.state_dict())
    assert torch.equal(one(unit), other(unit))
    assert all(parameter is kept[name] for name, parameter in other.named_parameters())


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_by_finite_differences(kind: str) -> None:
    encoding = encoding_of(kind).double()
    unit = torch.rand(3, 3, dtype=torch.float64, requires_grad=True)
    names, parameters = zip(*encoding.named_parameters(), strict=True)
    called = lambda u, *p: torch.func.functional_call(encoding, dict(zip(names, p, strict=True)), (u,))  # noqa: E731
    assert torch.autograd.gradcheck(called, (unit, *parameters), fast_mode=True)

    def steepness(*p: Tensor) -> Tensor:
        features = called(unit, *p)
        return torch.autograd.grad(features.square().sum(), unit, create_graph=True)[0].norm(dim=1)

    assert torch.autograd.gradcheck(steepness, parameters, fast_mode=True)


@pytest.mark.parametrize("kind", KINDS)
def test_the_kernel_gets_the_lattices(kind: str) -> None:
    encoding, unit = encoding_of(kind), torch.rand(20, 3)
    found = kernels.lattice_encode(unit, encoding.lattices(), encoding.combine) * encoding.scale
    assert torch.equal(encoding(unit), found)
    assert encoding(unit).shape == (20, encoding.width)


def test_voxels_of_a_box_are_about_cubes() -> None:
    assert vertices_along(128, (1.0, 1.0, 1.0)) == (128, 128, 128)
    x, y, z = vertices_along(100, (1.0, 2.0, 4.0))
    assert (x, y, z) == (50, 100, 200)
    assert vertices_along(4, (1e-3, 1.0, 1.0))[0] == 2


def test_initial_values_are_the_papers() -> None:
    torch.manual_seed(0)
    for config, spread in ((VmConfig(), 0.1), (CpConfig(), 0.2), (TriplaneConfig(initial=0.3), 0.3)):
        for parameter in config.build().parameters():
            assert float(parameter.detach().std()) == pytest.approx(spread, rel=0.1)
    (still,) = VoxelsConfig(initial=0.1, spread=0.0).build().parameters()
    assert bool((still == 0.1).all())
    (noisy,) = VoxelsConfig().build().parameters()
    assert 0.9e-4 < float(noisy.detach().abs().max()) <= 1e-4


def test_configs_survive_a_round_trip_and_refuse_nonsense() -> None:
    for config in KINDS.values():
        assert fill(type(config), to_table(config)) == config
    for schema, table in (
        (VoxelsConfig, {"resolution": 1}),
        (VoxelsConfig, {"levels": 2, "coarsest": 99}),
        (VoxelsConfig, {"spread": -1.0}),
        (VmConfig, {"initial": 0.0}),
        (CpConfig, {"components": 0}),
        (TriplaneConfig, {"resolution": 0}),
    ):
        with pytest.raises(InputError) as caught:
            fill(schema, table)
        assert "Unknown key" not in caught.value.sentence
    with pytest.raises(InputError, match="at least 2"):
        encoding_of("vm").resize((1, 8, 8))
