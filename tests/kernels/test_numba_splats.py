"""Numba's splatting against the plain reference in float64, gradients included, and on input that is no good."""

import math
from dataclasses import replace

import pytest
import torch

from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.kernels import numba, reference
from invgraphics.kernels.types import Footprints

PARAMETERS = ("means", "quaternions", "scales", "opacities", "sh")


def cloud(n: int, coefficients: int = 16) -> Gaussians:
    """Anisotropic Gaussians around the origin, some of them faint, some hidden."""
    return Gaussians(
        means=torch.randn(n, 3) * 0.6,
        quaternions=torch.randn(n, 4),
        scales=torch.exp(torch.randn(n, 3) * 0.5 - 2.5),
        opacities=torch.sigmoid(torch.randn(n) * 2),
        sh=torch.randn(n, coefficients, 3) * 0.3,
    )


def camera(width: int = 72, height: int = 56) -> Camera:
    """Three units away on -z, with an off-centre principal point."""
    pose = torch.eye(4)
    pose[2, 3] = -3.0
    return Camera(pose, torch.tensor([70.0, 75.0]), torch.tensor([width / 2 + 3.0, height / 2 - 4.0]), width, height)


def cast(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    return Gaussians(*(getattr(gaussians, name).to(dtype) for name in PARAMETERS))


def leaves_of(gaussians: Gaussians, view: Camera, dtype: torch.dtype) -> tuple[Gaussians, Camera, list[torch.Tensor]]:
    leaves = [getattr(gaussians, name).detach().to(dtype).requires_grad_() for name in PARAMETERS]
    pose = view.cam_to_world.detach().to(dtype).requires_grad_()
    return Gaussians(*leaves), view.to(dtype).moved(pose), [*leaves, pose]


def assert_close(numbers, truth, tolerance: float = 1e-5) -> None:
    for number, true in zip(numbers, truth, strict=True):
        worst = (number - true).abs().max() / true.abs().max().clamp_min(1e-12)
        assert worst < tolerance, f"relative to the largest entry: {worst}"


def project(kernels, dtype, gaussians, view, depth_planes):
    primitives, eye, leaves = leaves_of(gaussians, view, dtype)
    footprints, rgb = kernels.splat_project(primitives, eye)
    f, visible = footprints, footprints.radii > 0
    values = [x[visible] for x in (f.means2d, f.conics, f.depths, f.depth_planes, f.radii, rgb)]
    generator = torch.Generator().manual_seed(1)
    probed = [values[0], values[1], values[2], values[5]] + ([values[3]] if depth_planes else [])
    sum((x * torch.randn(x.shape, generator=generator).to(dtype)).sum() for x in probed).backward()
    return visible, [x.detach() for x in values], [leaf.grad for leaf in leaves if leaf.grad is not None]


@pytest.mark.parametrize(("coefficients", "depth_planes"), [(1, False), (4, False), (9, False), (16, True)])
def test_projection_equals_reference(coefficients, depth_planes):
    gaussians, view = cloud(300, coefficients), camera()
    seen, values, gradients = project(numba, torch.float32, gaussians, view, depth_planes)
    truly_seen, true_values, true_gradients = project(reference, torch.float64, gaussians, view, depth_planes)
    assert torch.equal(seen, truly_seen)
    assert 100 < seen.sum() < 300
    assert len(gradients) == 5
    assert_close(values, true_values)
    assert_close(gradients, true_gradients)


def rasterise(kernels, dtype, footprints, features, size, tile=None):
    names = ("means2d", "conics", "opacities")
    leaves = [getattr(footprints, name).detach().to(dtype).requires_grad_() for name in names]
    leaves.append(features.detach().to(dtype).requires_grad_())
    rest = {name: getattr(footprints, name).to(dtype) for name in ("depths", "depth_planes", "radii")}
    image, alpha = kernels.splat_rasterise(Footprints(*leaves[:3], **rest), leaves[3], *size, tile)
    generator = torch.Generator().manual_seed(1)
    probe = (image * torch.randn(image.shape, generator=generator).to(dtype)).sum()
    (probe + (alpha * torch.randn(alpha.shape, generator=generator).to(dtype)).sum()).backward()
    return [image.detach(), alpha.detach()], [leaf.grad for leaf in leaves]


@pytest.mark.parametrize(
    ("channels", "size", "tile"),
    [(3, (72, 56), None), (1, (37, 41), 16), (7, (33, 65), 32), (3, (3, 2), None), (4, (50, 50), 10), (11, (40, 30), None)],
)
def test_rasterising_equals_reference(channels, size, tile):
    footprints, _ = numba.splat_project(cloud(300), camera(*size))
    features = torch.randn(300, channels)
    values, gradients = rasterise(numba, torch.float32, footprints, features, size, tile)
    true_values, true_gradients = rasterise(reference, torch.float64, footprints, features, size)
    assert_close(values, true_values)
    assert_close(gradients, true_gradients)


def test_opaque_layers_stop_pixels_and_clamp_alpha():
    """Opacities of 1 exceed the largest alpha, and two such layers end a pixel."""
    n = 40
    footprints = Footprints(
        means2d=torch.rand(n, 2) * 20,
        conics=torch.tensor([[0.02, 0.005, 0.03]]).repeat(n, 1),
        opacities=torch.ones(n),
        depths=torch.rand(n),
        depth_planes=torch.zeros(n, 3),
        radii=torch.full((n,), 30.0),
    )
    features = torch.randn(n, 3)
    values, gradients = rasterise(numba, torch.float32, footprints, features, (21, 19))
    true_values, true_gradients = rasterise(reference, torch.float64, footprints, features, (21, 19))
    assert true_values[1].max() > 0.999
    assert_close(values, true_values)
    assert_close(gradients, true_gradients)


def test_bins_equal_reference():
    footprints, _ = reference.splat_project(cloud(300), camera(70, 50))
    # Equal depths: ties go by index.
    footprints = replace(footprints, depths=(footprints.depths * 8).round() - 20)
    for tile in (16, 32):
        ours, theirs = (kernels.splat_bin(footprints, 70, 50, tile) for kernels in (numba, reference))
        assert torch.equal(ours.splats, theirs.splats)
        assert torch.equal(ours.starts, theirs.starts)
        assert (ours.tile, ours.columns, ours.rows) == (theirs.tile, theirs.columns, theirs.rows)


def test_repetition_gives_the_same_bits():
    gaussians, view = cloud(2000), camera(129, 97)

    def gradients():
        primitives, eye, leaves = leaves_of(gaussians, view, torch.float32)
        footprints, rgb = numba.splat_project(primitives, eye)
        image, alpha = numba.splat_rasterise(footprints, rgb, 129, 97)
        (image.square().sum() + alpha.square().sum()).backward()
        return [image, alpha, *(leaf.grad for leaf in leaves)]

    for first, second in zip(gradients(), gradients(), strict=True):
        assert torch.equal(first, second)


def test_screen_gradient_is_visible():
    primitives, eye, _ = leaves_of(cloud(50), camera(), torch.float32)
    footprints, rgb = numba.splat_project(primitives, eye)
    footprints.means2d.retain_grad()
    numba.splat_rasterise(footprints, rgb, 72, 56)[0].sum().backward()
    assert footprints.means2d.grad.abs().max() > 0


def whole(gaussians, view):
    primitives, eye, leaves = leaves_of(gaussians, view, torch.float32)
    footprints, rgb = numba.splat_project(primitives, eye)
    image, alpha = numba.splat_rasterise(footprints, rgb, view.width, view.height)
    (image.sum() + alpha.sum()).backward()
    return image.detach(), alpha.detach(), leaves


def test_nothing_to_see():
    empty, view = cloud(0), camera()
    behind = replace(cloud(20), means=torch.tensor([0.0, 0.0, -9.0]).repeat(20, 1))
    transparent = replace(cloud(20), opacities=torch.zeros(20))
    for gaussians in (empty, behind, transparent):
        image, alpha, leaves = whole(gaussians, view)
        assert image.shape == (56, 72, 3)
        assert not image.any()
        assert not alpha.any()
        assert all(not leaf.grad.any() for leaf in leaves)


def test_the_culled_stay_out_of_the_gradients_of_their_neighbours():
    gaussians, rest = cloud(70), torch.arange(70) % 4 > 1
    gaussians.means[::4] = torch.nan
    gaussians.means[1::4] = torch.tensor([0.0, 0.0, -3.0])
    _, _, (*leaves, pose) = whole(gaussians, camera())
    _, _, (*alone, alone_pose) = whole(Gaussians(*(getattr(gaussians, name)[rest] for name in PARAMETERS)), camera())
    assert_close([leaf.grad[rest] for leaf in leaves], [leaf.grad for leaf in alone], 1e-6)
    assert_close([pose.grad], [alone_pose.grad], 1e-6)
    assert all(torch.equal(leaf.grad[~rest], torch.zeros_like(leaf.grad[~rest])) for leaf in leaves)


def test_one_gaussian_covers_the_screen():
    one = cloud(1, 1)
    one = replace(one, means=torch.zeros(1, 3), scales=torch.full((1, 3), 1e3), opacities=torch.tensor([0.5]))
    image, alpha, _ = whole(one, camera())
    truth = reference.splat_rasterise(*reference.splat_project(cast(one, torch.float64), camera().to(torch.float64)), 72, 56)
    assert_close([image, alpha], truth, 1e-4)


def test_many_on_one_pixel():
    crowd = replace(cloud(20_000, 1), means=torch.zeros(20_000, 3), scales=torch.full((20_000, 3), 1e-4))
    image, alpha, leaves = whole(crowd, camera())
    assert torch.isfinite(image).all()
    assert alpha.max() > 0.999
    assert all(torch.isfinite(leaf.grad).all() for leaf in leaves)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1e30])
@pytest.mark.parametrize("name", PARAMETERS)
def test_bad_numbers_do_not_crash(name, value):
    gaussians, rest = cloud(64), torch.arange(64) % 7 > 0
    getattr(gaussians, name)[::7] = value
    image, alpha, _ = whole(gaussians, camera(45, 43))
    assert image.shape == (43, 45, 3)
    if math.isnan(value) and name != "sh":  # a colour that is not a number is drawn, so that a fit notices it
        alone, alone_alpha, _ = whole(Gaussians(*(getattr(gaussians, one)[rest] for one in PARAMETERS)), camera(45, 43))
        assert_close([image, alpha], [alone, alone_alpha], 1e-6)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1e30, -1.0, 0.0, 1e-30])
@pytest.mark.parametrize("name", ["means2d", "conics", "opacities", "depths", "radii"])
def test_bad_footprints_do_not_crash(name, value):
    footprints, rgb = reference.splat_project(cloud(64), camera(45, 43))
    getattr(footprints, name)[::7] = value
    image, _ = numba.splat_rasterise(footprints, rgb, 45, 43)
    assert image.shape == (43, 45, 3)
    assert len(numba.splat_bin(footprints, 45, 43, 16).starts) == 10
