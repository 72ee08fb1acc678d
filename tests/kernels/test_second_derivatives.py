"""Second derivatives of compiled kernels: right where there are any, an error and never silently zero where there are none."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Camera, Gaussians
from invgraphics.core.lattice import Lattice
from invgraphics.core.ngp import HashGrid
from invgraphics.core.rays import Rays
from invgraphics.kernels import dispatch, reference
from invgraphics.kernels.differentiation import gradients_of_positions
from invgraphics.kernels.gaussians import gaussian_composites, gaussian_density, gaussian_integrals
from invgraphics.kernels.meshes import mesh_interpolate
from invgraphics.kernels.reference.gaussian_rays import precompute
from invgraphics.kernels.segments import segment_sums
from invgraphics.kernels.types import Fragments

pytestmark = pytest.mark.skipif("numba" not in dispatch.cpu_implementations(), reason="Numba does not work here")
RAY = torch.zeros(3, dtype=torch.int64)
GRID = HashGrid(levels=4, features=2, log2_size=8, base=2, finest=30)
PLANES = "xy", "xz", "yz"


def rand(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(sum(shape)))


def blobs(means: Tensor) -> Gaussians:
    n = len(means)
    return Gaussians(means, rand(n, 4) - 0.5, 0.2 * rand(n, 3) + 0.2, 0.8 * rand(n), rand(n, 4, 3))


def project(means: Tensor) -> Tensor:
    camera = Camera(torch.eye(4), torch.full((2,), 20.0), torch.full((2,), 8.0), 16, 16)
    return kernels.splat_project(blobs(means), camera)[0].conics


def rasterise(features: Tensor) -> Tensor:
    camera = Camera(torch.eye(4), torch.full((2,), 20.0), torch.full((2,), 8.0), 16, 16)
    with torch.no_grad():
        footprints, _ = kernels.splat_project(blobs(MEANS), camera)
    return kernels.splat_rasterise(footprints, features, 16, 16)[0]


def interpolate(features: Tensor) -> Tensor:
    fragments = Fragments(torch.zeros(2, 2, dtype=torch.int64), rand(2, 2, 3), rand(2, 2))
    return mesh_interpolate(fragments, torch.tensor([[0, 1, 2]]), features)


MEANS = rand(5, 3) - 0.5 + torch.tensor([0.0, 0.0, 2.0])
RAYS = Rays.make(torch.zeros(4, 3), torch.nn.functional.normalize(rand(4, 3) - 0.5 + torch.tensor([0.0, 0.0, 3.0]), dim=1))
ONCE: dict[str, tuple[Callable[[Tensor], Tensor], Tensor]] = {
    "composite": (lambda tau: kernels.composite(tau, rand(3, 1), RAY, 1)[1], rand(3)),
    "ssim": (lambda image: kernels.ssim(image, rand(20, 20, 3) ** 2), rand(20, 20, 3)),
    "segment sums": (lambda weights: segment_sums(rand(3, 2), weights, RAY, 1), rand(3)),
    "projection": (project, MEANS),
    "rasterisation": (rasterise, rand(5, 3)),
    "mesh": (interpolate, rand(3, 2)),
    "integrals": (lambda means: gaussian_integrals(precompute(blobs(means), "peak", 1e-3), RAYS, 8), MEANS),
    "composites": (lambda means: gaussian_composites(precompute(blobs(means), "peak", 1e-3), RAYS, None), MEANS),
    "density": (lambda means: gaussian_density(blobs(means), MEANS.detach(), None, 1e-3), MEANS),
}


@pytest.mark.parametrize("name", ONCE)
def test_a_gradient_that_cannot_be_differentiated_says_so(name: str) -> None:
    """Cotangents are constants here, as those of a sum are, so that torch's own decorator raises nothing."""
    function, start = ONCE[name]
    x = start.clone().requires_grad_()
    (alone,) = torch.autograd.grad(function(x).sum(), x)
    assert not alone.requires_grad
    (gradient,) = torch.autograd.grad(function(x).sum(), x, create_graph=True)
    assert float(alone.abs().max()) > 0
    assert torch.equal(gradient.detach(), alone)
    # The other term hid that the first one had no gradient.
    with pytest.raises(RuntimeError, match=r"no second derivative of .*using\('reference'\)"):
        (gradient.square().sum() + x.sum()).backward()


def test_the_reference_has_the_second_derivative_that_the_message_promises() -> None:
    function, start = ONCE["composite"]
    with kernels.using("reference"):
        x = start.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(function(x).sum(), x, create_graph=True)
        (second,) = torch.autograd.grad(gradient.square().sum(), x)
    # Of sum_i c_i (exp(-before) - exp(-after)), by differences of its gradient in float64.
    c, step = rand(3, 1).double()[:, 0], 1e-5

    def slope(tau: Tensor) -> Tensor:
        ends = torch.exp(-torch.cat([tau.new_zeros(1), tau.cumsum(0)]))
        return torch.stack([ends[j + 1] * c[j] - ((ends[:-1] - ends[1:]) * c)[j + 1 :].sum() for j in range(3)])

    tau = start.double()
    columns = [(slope(tau + step * e).square().sum() - slope(tau - step * e).square().sum()) / (2 * step) for e in torch.eye(3)]
    torch.testing.assert_close(second.double(), torch.stack(columns), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("features", [2, 3])
def test_the_gradient_of_hash_encoded_positions_is_differentiable_in_them(features: int) -> None:
    grid = HashGrid(levels=4, features=features, log2_size=8, base=2, finest=30)
    unit, table = rand(50, 3) * 1.2 - 0.1, rand(grid.entries, features) - 0.5
    cotangent, along = rand(50, grid.levels * features) - 0.5, rand(50, 3) - 0.5
    x = unit.clone().requires_grad_()
    encoded, _ = kernels.hash_encode(x, table.clone().requires_grad_(), grid)
    (slope,) = torch.autograd.grad(encoded, x, cotangent, create_graph=True)
    (found,) = torch.autograd.grad(slope, x, along)
    # Trilinear within a cell: central differences of the Jacobian in float64 are exact.
    step, columns = 1e-7, []
    for axis in torch.eye(3, dtype=torch.float64):
        ends = [reference.hash_encode(unit.double() + s * axis, table.double(), grid, jacobian=True)[1] for s in (step, -step)]
        assert ends[0] is not None and ends[1] is not None
        columns.append(torch.einsum("mfa,mf,ma->m", (ends[0] - ends[1]) / (2 * step), cotangent.double(), along.double()))
    expected = torch.stack(columns, dim=1)
    assert float(expected.abs().max()) > 1
    inside = ((unit > 1e-3) & (unit < 1 - 1e-3)).all(dim=1)
    torch.testing.assert_close(found.double()[inside], expected[inside], rtol=1e-4, atol=1e-4 * float(expected.abs().max()))
    assert not found[(unit < 0) | (unit > 1)].any()


def test_the_gradient_of_a_hash_table_is_differentiable_in_all_it_depends_on() -> None:
    unit, table, weights = (rand(40, 3) * 0.9 + 0.05, rand(GRID.entries, 2) - 0.5, rand(40, GRID.levels * 2))

    def second(dtype: torch.dtype) -> tuple[Tensor, ...]:
        u, t, w = (x.to(dtype).clone().requires_grad_() for x in (unit, table, weights))
        (slope,) = torch.autograd.grad(kernels.hash_encode(u, t, GRID)[0].square(), t, w, create_graph=True)
        return torch.autograd.grad(slope.square().sum(), (u, t, w))

    for found, expected in zip(second(torch.float32), second(torch.float64), strict=True):
        assert float(expected.abs().max()) > 0.1
        torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


def encoded(kind: str, unit: Tensor, table: Tensor) -> Tensor:
    if kind == "hash":
        return kernels.hash_encode(unit, table, GRID)[0]
    rows = table.reshape(3, -1, 4)
    planes, lines = rows[:, :36].reshape(3, 6, 6, 4), rows[:, :6]
    if kind == "planes":
        return kernels.lattice_encode(unit, [Lattice(x, axes) for x, axes in zip(planes, PLANES, strict=True)], "sum")
    pairs = zip(planes, PLANES, lines, "zyx", strict=True)
    return kernels.lattice_encode(unit, [Lattice(x, a) for p, a, q, b in pairs for x, a in ((p, a), (q, b))], "vm")


@pytest.mark.parametrize("kind", ["hash", "planes", "vm"])
def test_vector_jacobian_products_in_positions_are_those_of_ordinary_gradients(kind: str) -> None:
    """And theirs in table and cotangent: what a loss on normals takes."""
    unit, table = rand(300, 3), rand(GRID.entries if kind == "hash" else 660, 2) - 0.5

    def run(alone: bool, dtype: torch.dtype) -> tuple[Tensor, ...]:
        u, t = unit.to(dtype).clone().requires_grad_(), table.to(dtype).clone().requires_grad_()
        if alone:
            with gradients_of_positions():
                out = encoded(kind, u, t)
        else:
            out = encoded(kind, u, t)
        cotangent = rand(*out.shape).to(dtype).requires_grad_()
        (slope,) = torch.autograd.grad(out, u, cotangent, create_graph=True)
        return slope, *torch.autograd.grad((slope * rand(300, 3).to(dtype)).square().sum(), (t, cotangent))

    for found, same, expected in zip(
        run(True, torch.float32), run(False, torch.float32), run(False, torch.float64), strict=True
    ):
        scale = float(expected.detach().abs().max())
        assert scale > 0.01
        assert (found - same).abs().max() <= 1e-6 * scale
        assert (found - expected).abs().max() <= 1e-5 * scale


def test_the_mode_ends_with_its_block_and_is_one_threads_own() -> None:
    table = (rand(GRID.entries, 2)).requires_grad_()
    with gradients_of_positions():
        moving = rand(5, 3).requires_grad_()
        out = encoded("hash", moving, table)
    again = encoded("hash", moving, table)
    assert torch.autograd.grad(out.sum(), table, allow_unused=True)[0] is None
    assert torch.autograd.grad(again.sum(), table)[0].any()
