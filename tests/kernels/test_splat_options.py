"""What rendering options need of the kernels: compensation, absolute gradients, limited gradients, median depth, discs."""

import math
from dataclasses import replace

import pytest
import torch
from test_numba_splats import assert_close, camera, cloud, leaves_of

from invgraphics.core import Camera, Gaussians
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels import numba, reference
from invgraphics.kernels.types import ALPHA_MIN, Footprints

F64 = torch.float64
SIZE = 37, 29
FEW = 20, 18
"""Pixels of a test that takes a backward pass for each; two tiles each way."""


def small_cloud(n: int) -> Footprints:
    """Overlapping footprints in float64, on a picture of `FEW`."""
    gaussians = Gaussians(*(getattr(cloud(n), name).double() for name in ("means", "quaternions", "scales", "opacities", "sh")))
    return reference.splat_project(gaussians, camera(*FEW).to(F64))[0]


def test_compensation_keeps_the_integral_of_a_small_gaussian() -> None:
    """Far smaller than a pixel: sum of alpha over pixels is 2 pi o sqrt(det) of the unfiltered covariance."""
    view = camera(64, 64).to(F64)
    small = Gaussians(
        means=torch.zeros(1, 3, dtype=F64),
        quaternions=torch.tensor([[0.8, 0.3, -0.2, 0.4]], dtype=F64),
        scales=torch.tensor([[0.012, 0.009, 0.015]], dtype=F64),
        opacities=torch.tensor([0.9], dtype=F64),
        sh=torch.zeros(1, 1, 3, dtype=F64),
    )
    bare, _ = reference.splat_project(small, view, dilation=0.0)
    xx, xy, yy = bare.conics[0]
    expected = 2 * math.pi * 0.9 / (xx * yy - xy * xy).sqrt()
    sums = {}
    for antialiased in (False, True):
        footprints, rgb = reference.splat_project(small, view, 0.3, antialiased)
        footprints = replace(footprints, radii=torch.full((1,), 99.0, dtype=F64))
        sums[antialiased] = float(reference.splat_rasterise(footprints, rgb, 64, 64)[1].sum())
    assert sums[True] == pytest.approx(float(expected), rel=0.1)  # what is below 1/255 is cut off
    assert sums[False] > 3 * float(expected)


def test_compensated_energy_falls_with_the_square_of_distance() -> None:
    def energy(distance: float, antialiased: bool) -> float:
        pose = torch.eye(4, dtype=F64)
        pose[2, 3] = -distance
        view = Camera(pose, torch.full((2,), 60.0, dtype=F64), torch.full((2,), 16.0, dtype=F64), 32, 32)
        one = Gaussians(*(x.double() for x in (torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.03),
                                               torch.tensor([0.95]), torch.zeros(1, 1, 3))))  # fmt: skip
        footprints, _ = reference.splat_project(one, view, 0.1, antialiased)
        conic = footprints.conics[0]
        return float(2 * math.pi * footprints.opacities[0] / (conic[0] * conic[2] - conic[1] ** 2).sqrt())

    assert energy(4.0, True) / energy(8.0, True) == pytest.approx(4.0, rel=1e-6)
    assert energy(4.0, False) / energy(8.0, False) < 2.5


def test_compensation_gradients_by_finite_differences() -> None:
    view = camera(*SIZE).to(F64)
    base = cloud(6)
    leaves = tuple(getattr(base, name).double().requires_grad_() for name in ("means", "quaternions", "scales", "opacities"))
    weights = torch.randn(6, dtype=F64)

    def faded(means, quaternions, scales, opacities):
        footprints, _ = reference.splat_project(
            Gaussians(means, quaternions, scales, opacities, base.sh.double()), view, 0.3, True
        )
        return (footprints.opacities * weights).sum()

    assert torch.autograd.gradcheck(faded, leaves, eps=1e-7, atol=1e-5)


def test_numba_compensation_equals_reference() -> None:
    results, gaussians = [], cloud(200, 4)
    for kernels, dtype in ((numba, torch.float32), (reference, F64)):
        primitives, eye, leaves = leaves_of(gaussians, camera(), dtype)
        footprints, rgb = kernels.splat_project(primitives, eye, 0.3, True)
        image, alpha = kernels.splat_rasterise(footprints, rgb, 72, 56)
        probe = torch.linspace(-1, 1, 72).to(dtype)
        ((image.sum(dim=2) + alpha) * probe).sum().backward()
        results.append(([image.detach(), alpha.detach()], [leaf.grad for leaf in leaves]))
    assert_close(results[0][0], results[1][0])
    assert_close(results[0][1], results[1][1], 1e-4)


def probe_of(height: int, width: int) -> torch.Tensor:
    return torch.randn(height, width, 3, dtype=F64, generator=torch.Generator().manual_seed(3))


@pytest.mark.parametrize(("kernels", "dtype"), [(reference, F64), (numba, torch.float32)])
def test_absolute_gradients_are_sums_over_pixels(kernels, dtype) -> None:
    """Brute force: one backward pass per pixel."""
    footprints = small_cloud(25)
    rgb, probe = torch.rand(25, 3, dtype=F64), probe_of(FEW[1], FEW[0])
    mean = footprints.means2d.detach().requires_grad_()
    image, _ = reference.splat_rasterise(replace(footprints, means2d=mean), rgb, *FEW)
    pixels = (image * probe).sum(dim=2).flatten()
    truth = sum(torch.autograd.grad(pixel, mean, retain_graph=True)[0].abs() for pixel in pixels)

    cast = {name: value.to(dtype) for name, value in vars(footprints).items() if value is not None}
    absgrad = torch.zeros(25, 2, dtype=dtype, requires_grad=True)
    cast["means2d"] = cast["means2d"].detach().requires_grad_()
    image, _ = kernels.splat_rasterise(Footprints(**cast, absgrad=absgrad), rgb.to(dtype), *FEW)
    (image * probe.to(dtype)).sum().backward()
    assert_close([absgrad.grad], [truth], 1e-4)
    assert bool((truth >= cast["means2d"].grad.abs() - 1e-5).all())


@pytest.mark.parametrize(("max_grad_splats", "channels"), [(1, 6), (4, 3)])
def test_only_the_first_splats_of_a_pixel_receive_gradients(max_grad_splats: int, channels: int) -> None:
    """Brute force: every pixel's gradient, kept for the splats that come first on it."""
    footprints, features = small_cloud(40), torch.rand(40, channels, dtype=F64)
    probe = torch.randn(FEW[1], FEW[0], channels, dtype=F64)
    leaves = [x.detach().requires_grad_() for x in (footprints.means2d, footprints.conics, footprints.opacities, features)]
    image, _ = reference.splat_rasterise(Footprints(*leaves[:3], *rest_of(footprints, F64)), leaves[3], *FEW)
    order = torch.argsort(footprints.depths)
    truth = [torch.zeros_like(leaf) for leaf in leaves]
    for y in range(FEW[1]):
        for x in range(FEW[0]):
            offset = torch.tensor([x + 0.5, y + 0.5], dtype=F64) - footprints.means2d
            xx, xy, yy = footprints.conics.unbind(1)
            q = xx * offset[:, 0] ** 2 + 2 * xy * offset[:, 0] * offset[:, 1] + yy * offset[:, 1] ** 2
            seen = (footprints.opacities * torch.exp(-q / 2) >= ALPHA_MIN) & (footprints.radii > 0)
            first = order[seen[order]][:max_grad_splats]
            for total, gradient in zip(
                truth, torch.autograd.grad((image[y, x] * probe[y, x]).sum(), leaves, retain_graph=True), strict=True
            ):
                total[first] += gradient[first]
    for kernels, dtype in ((reference, F64), (numba, torch.float32)):
        again = [leaf.detach().to(dtype).requires_grad_() for leaf in leaves]
        limited = Footprints(*again[:3], *rest_of(footprints, dtype))
        whole, _ = kernels.splat_rasterise(limited, again[3], *FEW, None, max_grad_splats)
        torch.testing.assert_close(whole.detach().double(), image.detach(), atol=1e-5, rtol=1e-4)
        (whole * probe.to(dtype)).sum().backward()
        assert_close([leaf.grad for leaf in again], truth, 1e-4)


def rest_of(footprints: Footprints, dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
    return tuple(x.to(dtype) for x in (footprints.depths, footprints.depth_planes, footprints.radii))


@pytest.mark.parametrize("kernels", [reference, numba])
def test_median_is_where_half_of_the_light_is_gone(kernels) -> None:
    def layer(opacity: float, t: float) -> list[float]:
        return [opacity, t]

    layers = [layer(0.3, 1.0), layer(0.2, 2.0), layer(0.2, 3.0), layer(0.9, 4.0)]
    n = len(layers)
    footprints = Footprints(
        means2d=torch.full((n, 2), 4.0),
        conics=torch.tensor([[1e-6, 0.0, 1e-6]]).repeat(n, 1),
        opacities=torch.tensor([opacity for opacity, _ in layers]),
        depths=torch.tensor([t for _, t in layers]),
        depth_planes=torch.tensor([[t, 0.1, 0.0] for _, t in layers]),
        radii=torch.full((n,), 100.0),
    )
    x = torch.arange(9) + 0.5
    # Transmittances 0.7, 0.56, 0.448: the third layer crosses.
    torch.testing.assert_close(kernels.splat_median(footprints, 9, 9), (3.0 + 0.1 * (x - 4)).expand(9, 9))
    faint = replace(footprints, opacities=torch.full((n,), 0.1))
    assert bool(torch.isinf(kernels.splat_median(faint, 9, 9)).all())


def test_numba_median_equals_reference() -> None:
    footprints, _ = numba.splat_project(cloud(300), camera())
    ours, theirs = numba.splat_median(footprints, 72, 56), reference.splat_median(footprints, 72, 56)
    assert 500 < int(torch.isfinite(theirs).sum()) < 72 * 56
    same = torch.isfinite(theirs) == torch.isfinite(ours)
    assert float(same.float().mean()) > 0.999
    both = torch.isfinite(theirs) & torch.isfinite(ours)
    assert float(((ours - theirs)[both].abs() < 1e-3).float().mean()) > 0.999


def discs(n: int = 12) -> Gaussians:
    base = cloud(n)
    return Gaussians(
        *(x.double() for x in (base.means * 0.7, base.quaternions, base.scales * 2, base.opacities * 0.5 + 0.4, base.sh))
    )


def test_projected_discs_are_hit_where_rays_meet_their_plane() -> None:
    view, all_discs = camera(*SIZE).to(F64), discs()
    rays = view.rays()
    footprints, _ = reference.splat_project_discs(all_discs, view, dilation=0.0)
    assert int((footprints.radii > 0).sum()) > 8
    for i in range(len(all_discs)):
        alone = Footprints(**{name: value[i : i + 1] for name, value in vars(footprints).items() if value is not None})
        _, alpha = reference.splat_rasterise(alone, torch.zeros(1, 1, dtype=F64), *SIZE)
        axes = quaternion_to_matrix(all_discs.quaternions[i : i + 1])[0]
        t = ((all_discs.means[i] - rays.origins) @ axes[:, 2]) / (rays.directions @ axes[:, 2])
        offset = (rays.at(t) - all_discs.means[i]) @ axes[:, :2] / all_discs.scales[i][:2]
        expected = torch.where(t > 0, all_discs.opacities[i] * torch.exp(-0.5 * offset.square().sum(dim=1)), 0.0)
        expected = torch.where(expected < ALPHA_MIN, 0.0, expected.clamp_max(0.99))
        torch.testing.assert_close(alpha.flatten(), expected, atol=1e-9, rtol=1e-6)


def test_a_disc_seen_edge_on_keeps_a_pixels_width() -> None:
    view = camera(*SIZE).to(F64)
    edge_on = replace(
        discs(1),
        means=torch.zeros(1, 3, dtype=F64),
        quaternions=torch.full((1, 4), 0.5, dtype=F64),  # x to y, y to z, z to x: the normal is across the view
        scales=torch.tensor([[0.3, 0.3, 1e-4]], dtype=F64),
        opacities=torch.ones(1, dtype=F64),
    )
    footprints, rgb = reference.splat_project_discs(edge_on, view)
    _, alpha = reference.splat_rasterise(footprints, rgb, *SIZE)
    assert float(alpha.max()) > 0.6
    assert 3 < int((alpha > 0.01).sum()) < 60


def test_a_disc_seen_exactly_edge_on_has_finite_gradients() -> None:
    """Its ray-disc intersection is 0 / 0; what is left is the low-pass filter's Gaussian around its centre."""
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1.0, -2.0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])  # looks along +y
    view = Camera(pose, torch.full((2,), 32.0), torch.full((2,), 16.0), 32, 32)
    leaves = tuple(
        tensor.requires_grad_()
        for tensor in (
            torch.tensor([[0.0, 0.0, 0.25]]),
            torch.tensor([[0.5, 0.5, 0.5, 0.5]]),  # x to y, y to z, z to x: the plane is x = 0, which holds the camera
            torch.tensor([[0.25, 0.125, 1e-3]]),
            torch.tensor([0.75]),
        )
    )
    footprints, rgb = reference.splat_project_discs(Gaussians(*leaves, torch.zeros(1, 1, 3)), view, 0.5)
    _, alpha = reference.splat_rasterise(footprints, rgb, 32, 32)
    pixels = torch.cartesian_prod(torch.arange(32), torch.arange(32)).flip(dims=(1,)) + 0.5
    expected = 0.75 * torch.exp(-0.5 * (pixels - torch.tensor([16.0, 12.0])).square().sum(dim=1) / 0.5)
    torch.testing.assert_close(alpha.flatten(), torch.where(expected < ALPHA_MIN, 0.0, expected))
    (alpha * torch.arange(1024.0).view(32, 32)).sum().backward()
    assert all(leaf.grad is None or bool(leaf.grad.isfinite().all()) for leaf in leaves)
    assert leaves[0].grad is not None and bool(leaves[0].grad.any())


def test_disc_gradients_by_finite_differences() -> None:
    view, base = camera(*SIZE).to(F64), discs(3)
    leaves = tuple(getattr(base, name).clone().requires_grad_() for name in ("means", "quaternions", "scales", "opacities"))
    probe = torch.randn(SIZE[1], SIZE[0], dtype=F64)

    def render(means, quaternions, scales, opacities):
        footprints, rgb = reference.splat_project_discs(Gaussians(means, quaternions, scales, opacities, base.sh), view)
        return (reference.splat_rasterise(footprints, rgb, *SIZE)[1] * probe).sum()

    assert torch.autograd.gradcheck(render, leaves, eps=1e-8, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("scales", [(0.1, 0.0, 0.1), (0.1, 1e-12, 0.1), (0.1, 0.0, 0.0), (0.1, 1e-22, 1e-22)])
def test_compensated_gradients_stay_finite_where_a_footprint_has_no_area(scales: tuple[float, float, float]) -> None:
    """Seen edge-on: the compensation is at its lower bound, and a constant."""

    def gradients(kernels, dtype: torch.dtype) -> list[torch.Tensor]:
        view = Camera(*(x.to(dtype) for x in (torch.eye(4), torch.full((2,), 100.0), torch.full((2,), 32.0))), 64, 64)
        values = [[[0.0, 0.0, 2.0]], [[1.0, 0.0, 0.0, 0.0]], [list(scales)], [0.9], [[[0.0, 0.0, 0.0]]]]
        leaves = [torch.tensor(value, dtype=dtype, requires_grad=True) for value in values]
        footprints, _ = kernels.splat_project(Gaussians(*leaves), view, 0.3, True)
        assert float(footprints.radii) > 0
        total = footprints.means2d.sum() + footprints.conics.sum() + footprints.opacities.sum()
        return list(torch.autograd.grad(total, leaves[:4]))

    for found, expected in zip(gradients(numba, torch.float32), gradients(reference, F64), strict=True):
        torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-5)
