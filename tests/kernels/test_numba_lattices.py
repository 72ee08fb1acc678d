"""Numba's lattice encoding against the plain reference in float64: features, gradients, and gradients of gradients."""

from dataclasses import replace

import pytest
import torch
from lattice_cases import VM_AXES, derivatives, lattice, linked

from invgraphics.core.lattice import Lattice
from invgraphics.kernels import numba, reference
from invgraphics.kernels.numba.lattice.backward import split_rows
from invgraphics.kernels.numba.lattice.cells import records

# More than one block, and no whole number of them.
POINTS = torch.rand(1000, 3, generator=torch.Generator().manual_seed(5)) * 1.2 - 0.1
CORNERS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 1.0, 0.0], [-3.0, 0.5, 2.0]])
UNIT = torch.cat([POINTS, CORNERS])


def assert_equal(lattices, combine):
    """Within fp32 rounding of the truth, relative to the largest entry, on one thread and two; the same bits again."""
    before, found = torch.get_num_threads(), []
    try:
        for count in (1, 1, 2, 2):
            torch.set_num_threads(count)
            found.append(derivatives(numba, UNIT, lattices, combine, torch.float32))
    finally:
        torch.set_num_threads(before)
    truth = derivatives(reference, UNIT, lattices, combine, torch.float64)
    assert len(truth) > 2 + len(lattices)
    for number, again, threaded, threaded_again, true in zip(*found, truth, strict=True):
        assert torch.equal(number, again)
        assert torch.equal(threaded, threaded_again)
        for one in (number, threaded):
            assert (one - true).abs().max() <= 1e-5 * true.abs().max()


@pytest.mark.parametrize("channels", [1, 2, 4, 5, 12, 16, 28, 48])
def test_channels(channels):
    assert_equal([lattice("xyz", channels), lattice("zx", channels), lattice("y", channels)], "concat")


@pytest.mark.parametrize("combine", ["sum", "vm", "cp"])
@pytest.mark.parametrize("channels", [3, 16, 20])
def test_combinations(combine, channels):
    axes = {"sum": ("xy", "xz", "yz"), "vm": VM_AXES, "cp": "xyz"}[combine]
    assert_equal([lattice(name, channels) for name in axes], combine)


@pytest.mark.parametrize("sizes", [(60, 50, 40), (900, 4, 3)])
@pytest.mark.parametrize("names", [("xy", "z"), ("z", "xy"), ("xz", "yz")])
def test_products_of_lattices_that_are_too_large_for_copies(names, sizes):
    """Threads share out the rows of a large factor, and the points that write a small one, whichever comes first."""
    assert_equal([lattice(name, 16, sizes) for name in names], "vm")


def test_a_product_of_planes_and_voxels_of_unequal_widths():
    assert_equal([lattice("xy", 3), lattice("yz", 3), lattice("zyx", 17), lattice("x", 17)], "vm")


@pytest.mark.parametrize("sizes", [(2, 2, 2), (1, 4, 1), (9, 1, 3), (40, 30, 20)])
def test_sizes(sizes):
    assert_equal([lattice("xyz", 4, sizes), lattice("xz", 4, sizes)], "sum")


def test_links():
    assert_equal([linked(5), linked(3, rows=200)], "concat")


def test_links_that_share_a_row_or_are_none():
    links = torch.randint(-3, 30, (5, 6, 7), dtype=torch.int32)
    assert (links >= 20).any()
    assert_equal([Lattice(torch.randn(20, 3), "xyz", links)], "concat")
    nothing = numba.lattice_encode(UNIT, [Lattice(torch.zeros(0, 2), "xyz", links)])
    assert torch.equal(nothing, torch.zeros(len(UNIT), 2))


def test_an_empty_vertex_reads_no_row():
    links = torch.full((2, 2, 2), -1, dtype=torch.int32)
    features = torch.full((1, 3), torch.nan)
    assert torch.equal(numba.lattice_encode(POINTS, [Lattice(features, "xyz", links)]), torch.zeros(len(POINTS), 3))


def test_tensors_that_are_not_contiguous():
    features, links = torch.randn(7, 5, 6, 4).permute(1, 2, 0, 3), linked(3).links
    assert links is not None
    assert_equal([Lattice(features, "xyz")], "concat")
    wide = torch.full((*links.shape, 2), 10**6, dtype=torch.int32)
    wide[..., 0] = links
    assert_equal([Lattice(torch.randn(40, 3), "xyz", wide[..., 0])], "concat")


def test_bad_numbers_read_nothing_outside():
    bad = torch.tensor([[torch.nan, 0.5, 0.5], [torch.inf, -torch.inf, 0.5], [1e30, -1e30, 0.0]])
    planes = [lattice(axes, 3) for axes in VM_AXES]
    found, truth = (
        derivatives(k, bad, planes, "vm", dtype) for k, dtype in ((numba, torch.float32), (reference, torch.float64))
    )
    for number, true in zip(found, truth, strict=True):
        torch.testing.assert_close(number.double(), true, atol=1e-4, rtol=1e-4)


def test_no_points():
    found = derivatives(numba, torch.zeros(0, 3), [lattice(axes, 3) for axes in VM_AXES], "vm", torch.float32)
    assert found[0].shape == (0, 9)
    assert not any(x.any() for x in found)


def test_gradients_that_nobody_wants_are_left_out():
    plane, line = lattice("xy", 3), lattice("z", 3)
    line.features.requires_grad_()
    numba.lattice_encode(UNIT, [plane, line], "vm").sum().backward()
    truth = lattice("z", 3).features.clone().copy_(line.features.detach()).requires_grad_()
    reference.lattice_encode(UNIT, [plane, Lattice(truth, "z")], "vm").sum().backward()
    torch.testing.assert_close(line.features.grad, truth.grad, atol=1e-4, rtol=1e-4)


def test_rows_are_shared_out_by_work():
    """Points crowd in one corner: each job still gets about as many of their rows' visits."""
    crowd = (torch.rand(20_000, 3) ** 4).T.contiguous().numpy()
    starts = split_rows(crowd, records([lattice("xyz", 1, (32, 32, 32))], "concat"), 4)[0]
    assert starts[0] == 0
    assert starts[-1] == 32**3
    cell = (crowd * 31).astype(int)
    visits, _ = torch.tensor((cell[0] * 32 + cell[1]) * 32 + cell[2]).sort()
    shares = torch.searchsorted(visits, torch.from_numpy(starts)).diff() / len(visits)
    assert (shares - 0.25).abs().max() < 0.1


LARGE = (40, 30, 20)
"""Vertices of lattices that are large for `FEW` points."""
FEW = UNIT[-40:]


def gradients(lattices, combine, **options):
    """Gradients of all features, of a weighted sum at few points."""
    leaves = [x.features.detach().clone().requires_grad_() for x in lattices]
    out = numba.lattice_encode(FEW, [replace(x, features=f) for x, f in zip(lattices, leaves, strict=True)], combine, **options)
    return torch.autograd.grad((out * torch.arange(out.numel()).reshape(out.shape).sin()).sum(), leaves)


def assert_sparse_equals_dense(lattices, combine, sparse):
    """The same bits, on one thread and two; ``sparse``: which lattices' gradients are."""
    before = torch.get_num_threads()
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found, whole = gradients(lattices, combine, sparse_gradients=True), gradients(lattices, combine)
            assert [x.is_sparse for x in found] == sparse
            assert not any(x.is_sparse for x in whole)
            for one, dense in zip(found, whole, strict=True):
                assert one.shape == dense.shape
                assert (dense != 0).any()
                assert torch.equal(one.to_dense(), dense)
    finally:
        torch.set_num_threads(before)


def test_sparse_gradients_of_voxels():
    lattices = [lattice("xyz", 3, LARGE), lattice("xyz", 1, (3, 4, 5)), lattice("zxy", 12, LARGE), lattice("xz", 40, LARGE)]
    assert_sparse_equals_dense(lattices, "concat", [True, False, True, True])
    assert_sparse_equals_dense([lattice(axes, 20, LARGE) for axes in ("xy", "xyz")], "sum", [True, True])


def test_sparse_gradients_of_linked_voxels():
    shared = torch.randint(-300, 9000, LARGE, dtype=torch.int32)
    lattices = [linked(5, rows=9000, sizes=LARGE), Lattice(torch.randn(8000, 3), "xyz", shared)]
    assert_sparse_equals_dense(lattices, "concat", [True, True])
    increasing = torch.where(torch.rand(LARGE) < 0.6, torch.arange(24000).reshape(LARGE), -1).to(torch.int32)
    assert_sparse_equals_dense([Lattice(torch.randn(24000, 4), "xyz", increasing)], "concat", [True])


def test_a_sparse_gradient_holds_the_corners_of_the_points_cells_alone():
    (found,) = gradients([lattice("xyz", 12, LARGE)], "concat", sparse_gradients=True)
    vertices, cells = found.coalesce().indices().T, torch.tensor(LARGE) - 1
    steps = (vertices[:, None] - FEW.clamp(0, 1) * cells).abs().amax(dim=2)
    assert (steps.amin(dim=1) <= 1).all()
    assert 8 < len(vertices) <= 8 * len(FEW)


def test_gradients_of_factors_and_those_differentiated_again_are_dense():
    factors = [lattice("xyz", 12, LARGE), lattice("zyx", 12, LARGE)]
    assert not any(x.is_sparse for x in gradients(factors, "cp", sparse_gradients=True))
    features = factors[0].features.clone().requires_grad_()
    out = numba.lattice_encode(FEW, [Lattice(features)], sparse_gradients=True)
    (first,) = torch.autograd.grad((out**2).sum(), features, create_graph=True)
    assert not first.is_sparse
    (second,) = torch.autograd.grad((first**2).sum(), features)
    assert (second.to_dense() != 0).any()


@pytest.mark.parametrize("penalty", [False, True])
def test_sparse_gradients_add_up(penalty):
    """Those of two calls, and the dense one of a penalty."""
    features, found = torch.randn(*LARGE, 4, requires_grad=True), []
    for sparse in (True, False):
        out = [numba.lattice_encode(unit, [Lattice(features)], sparse_gradients=sparse) for unit in (FEW, FEW[:9] ** 2)]
        total = sum((one**2).sum() for one in out) + ((0.1 * features**2).sum() if penalty else 0.0)
        found += torch.autograd.grad(total, features)
    assert [x.is_sparse for x in found] == [not penalty, False]
    torch.testing.assert_close(found[0].to_dense(), found[1], atol=1e-5, rtol=1e-5)
