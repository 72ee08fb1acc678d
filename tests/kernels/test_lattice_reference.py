"""The reference lattice encoding against closed forms, SciPy, torch's sampler, the hash grid and finite differences."""

import numpy as np
import pytest
import torch
from lattice_cases import VM_AXES, lattice, linked
from scipy.interpolate import RegularGridInterpolator

from invgraphics import kernels
from invgraphics.core.lattice import Lattice
from invgraphics.core.ngp import HashGrid
from invgraphics.errors import InputError
from invgraphics.kernels.reference import hash_encode, lattice_encode

EDGES = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5], [-0.3, 0.2, 1.7]], dtype=torch.float64)


@pytest.fixture(autouse=True)
def _double():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def points(count: int = 50):
    """Random positions, a fifth of the coordinates outside, and the cube's corners."""
    return torch.cat([torch.rand(count, 3) * 1.2 - 0.1, EDGES])


def vertices(size: int):
    return torch.linspace(0, 1, size)


def test_a_trilinear_function_is_reproduced():
    def function(x, y, z):
        return 0.3 + x - 2 * y + 0.5 * z + x * y - 3 * y * z + 4 * x * z - 5 * x * y * z

    values = function(*torch.meshgrid(vertices(4), vertices(3), vertices(6), indexing="ij"))
    inside = torch.rand(60, 3)
    found = lattice_encode(inside, [Lattice(values[..., None])])
    torch.testing.assert_close(found[:, 0], function(*inside.T), atol=1e-12, rtol=0)


@pytest.mark.parametrize("axes", ["x", "z", "xy", "zx", "yz", "xyz", "zxy"])
def test_equals_scipy(axes):
    one, where = lattice(axes, 2), points().clamp(0, 1)
    grid = RegularGridInterpolator([vertices(size).numpy() for size in one.resolution], one.features.numpy())
    np.testing.assert_allclose(
        lattice_encode(where, [one]), grid(where[:, ["xyz".index(axis) for axis in axes]].numpy()), atol=1e-12
    )


@pytest.mark.parametrize("axes", ["xy", "yz", "xyz"])
def test_equals_torch_with_corners_aligned_and_border_padding(axes):
    one, where = lattice(axes, 3), points()
    # torch wants channels first, the axes reversed and coordinates in [-1, 1].
    volume = one.features.permute(*reversed(range(len(axes) + 1)))[None]
    places = (2 * where[:, ["xyz".index(axis) for axis in axes]] - 1).reshape(1, *[1] * (len(axes) - 1), -1, len(axes))
    expected = torch.nn.functional.grid_sample(volume, places, align_corners=True, padding_mode="border")
    torch.testing.assert_close(lattice_encode(where, [one]), expected.reshape(3, -1).T)


def test_vm_equals_the_tensor_that_it_factors():
    factors, where = [lattice(axes, 4) for axes in VM_AXES], points()
    plane_xy, line_z, plane_xz, line_y, plane_yz, line_x = (x.features for x in factors)
    full = [
        torch.einsum("xyc,zc->xyzc", plane_xy, line_z),
        torch.einsum("xzc,yc->xyzc", plane_xz, line_y),
        torch.einsum("yzc,xc->xyzc", plane_yz, line_x),
    ]
    # At the vertices, where the tensor is; between them a product of interpolants is the interpolant of the product too,
    # because no axis has two factors.
    torch.testing.assert_close(lattice_encode(where, factors, "vm"), lattice_encode(where, [Lattice(x) for x in full]))


def test_cp_equals_the_tensor_that_it_factors():
    x, y, z = factors = [lattice(axis, 3) for axis in "xyz"]
    full = torch.einsum("xc,yc,zc->xyzc", x.features, y.features, z.features)
    where = points()
    torch.testing.assert_close(lattice_encode(where, factors, "cp"), lattice_encode(where, [Lattice(full)]))


def test_a_sum_adds_all_planes_and_a_concatenation_keeps_their_order():
    planes, where = [lattice(axes, 3) for axes in ("xy", "xz", "yz")], points()
    separate = [lattice_encode(where, [plane]) for plane in planes]
    torch.testing.assert_close(lattice_encode(where, planes, "sum"), separate[0] + separate[1] + separate[2])
    assert torch.equal(lattice_encode(where, planes), torch.cat(separate, dim=1))


def test_dense_lattices_equal_a_hash_grid_without_collisions():
    grid = HashGrid(levels=3, features=2, log2_size=12, base=3, finest=12)
    table, where = torch.randn(grid.entries, 2), points()
    assert all((r + 1) ** 3 <= 2**grid.log2_size for r in grid.resolutions)
    levels = []
    for r, level in zip(grid.resolutions, table.split(list(grid.sizes)), strict=True):
        levels.append(Lattice(level.reshape(r + 1, r + 1, r + 1, 2).permute(2, 1, 0, 3)))  # the table runs x fastest
    torch.testing.assert_close(lattice_encode(where, levels), hash_encode(where, table, grid)[0])


def test_links_equal_a_dense_grid_with_zeros():
    sparse, where = linked(3), points()
    dense, links = torch.zeros(*sparse.resolution, 3), sparse.links
    assert links is not None
    assert (links < 0).any()
    dense[links >= 0] = sparse.features[links[links >= 0].long()]
    torch.testing.assert_close(lattice_encode(where, [sparse]), lattice_encode(where, [Lattice(dense)]))


def test_numbers_that_are_no_row_mark_empty_vertices():
    links = torch.tensor([[[-1, 7], [2, -9]], [[0, 1], [2**31 - 1, 1]]], dtype=torch.int32)
    found = lattice_encode(
        torch.tensor([[0.0, 0, 1], [0, 1, 0], [1, 1, 0], [1, 0, 1]]), [Lattice(torch.ones(2, 1), "xyz", links)]
    )
    assert found[:, 0].tolist() == [0, 0, 0, 1]
    nothing = lattice_encode(torch.rand(4, 3), [Lattice(torch.zeros(0, 2), "xyz", links)])
    assert torch.equal(nothing, torch.zeros(4, 2))


@pytest.mark.parametrize("combine", ["concat", "sum", "vm", "cp"])
def test_gradients_of_first_and_second_order(combine):
    axes = {"concat": ("xyz", "x"), "sum": ("xy", "xz", "yz"), "vm": VM_AXES, "cp": "xyz"}[combine]
    shapes = [(name, lattice(name, 2, (3, 2, 4)).features) for name in axes]
    names, features = [name for name, _ in shapes], [x.requires_grad_() for _, x in shapes]

    def encode(unit, *values):
        return lattice_encode(unit, [Lattice(x, name) for x, name in zip(values, names, strict=True)], combine)

    inputs = (torch.rand(4, 3).requires_grad_(), *features)
    assert torch.autograd.gradcheck(encode, inputs)
    assert torch.autograd.gradgradcheck(encode, inputs)


def test_gradients_of_a_linked_lattice():
    sparse = linked(2, rows=12, sizes=(2, 3, 4))
    inputs = torch.rand(4, 3).requires_grad_(), sparse.features.requires_grad_()
    encode = lambda unit, x: lattice_encode(unit, [Lattice(x, "xyz", sparse.links)])  # noqa: E731
    assert torch.autograd.gradcheck(encode, inputs)
    assert torch.autograd.gradgradcheck(encode, inputs)


def test_positions_outside_are_clamped_and_nan_counts_as_zero():
    one = lattice("xyz", 2)
    where = torch.tensor([[1.5, 0.3, -2.0], [torch.nan, 0.3, torch.inf]], requires_grad=True)
    found = lattice_encode(where, [one])
    (gradient,) = torch.autograd.grad(found.sum(), where)
    torch.testing.assert_close(found, lattice_encode(torch.tensor([[1, 0.3, 0], [0, 0.3, 1]]), [one]))
    assert (gradient[:, [0, 2]] == 0).all()
    assert (gradient[:, 1] != 0).all()


def test_a_single_vertex_along_an_axis_is_constant_along_it():
    one = lattice("xyz", 1, (1, 2, 2))
    low, high = torch.tensor([[0.0, 0.3, 0.6]]), torch.tensor([[1.0, 0.3, 0.6]])
    torch.testing.assert_close(lattice_encode(low, [one]), lattice_encode(high, [one]))


def test_no_points():
    assert lattice_encode(torch.zeros(0, 3), [lattice(axes, 4) for axes in VM_AXES], "vm").shape == (0, 12)


LINKS = torch.zeros(2, 2, 2, dtype=torch.int32)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Lattice(torch.zeros(2, 2, 3), "xx"), "1 to 3 different letters"),
        (lambda: Lattice(torch.zeros(2, 2, 3), "xyz"), "3 axes and channels"),
        (lambda: Lattice(torch.zeros(2, 0, 3), "xy"), "a vertex on every axis"),
        (lambda: Lattice(torch.zeros(5, 3), "xyz", LINKS.long()), "int32"),
        (lambda: Lattice(torch.zeros(2, 2, 2, 3), "xyz", LINKS), "one link per vertex"),
        (lambda: kernels.lattice_encode(torch.rand(2, 3), []), "at least one lattice"),
        (lambda: kernels.lattice_encode(torch.rand(2, 3), [lattice("xy", 1)] * 3, "vm"), "pairs of lattices"),
        (lambda: kernels.lattice_encode(torch.rand(2, 3), [lattice("xy", 1), lattice("z", 2)], "vm"), "as many channels"),
        (lambda: kernels.lattice_encode(torch.rand(2, 2), [lattice("xy", 1)]), r"\(m, 3\), not \(2, 2\)"),
        (lambda: kernels.lattice_encode(torch.rand(2, 3).float(), [lattice("xy", 1)]), "one dtype"),
        (lambda: kernels.lattice_encode(torch.rand(2, 3), [lattice("xy", 1)], "mean"), "no combination 'mean'"),  # type: ignore
    ],
)
def test_shapes_that_do_not_fit_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
