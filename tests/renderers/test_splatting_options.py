"""Rendering options of the splatter, and ellipsoids, against closed forms."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from test_splatting import BOUNDS, F64, Fixed, gaussians

from invgraphics.core import Bounds, Camera, Context, Gaussians
from invgraphics.core.transforms import look_at, quaternion_to_matrix
from invgraphics.renderers.base import normals_from_depth, to_rendering
from invgraphics.renderers.gaussians.ellipsoids import draw_ellipsoids
from invgraphics.renderers.splatting import Splatting, SplattingConfig
from invgraphics.testing import toy_scene

GEOMETRY = Context(BOUNDS, geometry=True)


def render(splats, view, **options):
    return Splatting(SplattingConfig(**options)).render_image(Fixed(splats), view, GEOMETRY)[0]


def sheet(count: int, y: float, opacity: float) -> dict[str, torch.Tensor]:
    """Many overlapping flat Gaussians in the plane of this y, turned to the camera of `make_camera`."""
    spots = torch.stack([torch.linspace(-1, 1, count).repeat(count), torch.linspace(-1, 1, count).repeat_interleave(count)], 1)
    n = count * count
    return {
        "means": torch.stack([spots[:, 0], torch.full((n,), y), spots[:, 1]], dim=1).to(F64),
        "quaternions": torch.tensor([[1.0, 0, 0, 0]], dtype=F64).repeat(n, 1),
        "scales": torch.tensor([[0.1, 1e-4, 0.1]], dtype=F64).repeat(n, 1),
        "opacities": torch.full((n,), opacity, dtype=F64),
        "sh": torch.zeros(n, 1, 3, dtype=F64),
    }


def test_median_depth_ignores_what_is_behind(make_camera: Callable[..., Camera]) -> None:
    """A sheet that stops three quarters of the light, in front of another: the mean is drawn backwards, the median is not."""
    view = make_camera(24, 20, 40.0)
    front, back = sheet(30, -0.5, 0.1), sheet(30, 1.0, 0.9)
    both = gaussians(1, **{name: torch.cat([front[name], back[name]]) for name in front})
    rays = view.rays()
    plane = ((-0.5 - rays.origins[:, 1]) / rays.directions[:, 1]).view(20, 24)
    middle = (slice(6, 14), slice(7, 17))
    expected, median = (render(both, view, depth=kind).depth[middle] for kind in ("expected", "median"))
    torch.testing.assert_close(median, plane[middle], atol=0.03, rtol=0)
    assert float((expected - plane[middle]).abs().mean()) > float((median - plane[middle]).abs().mean())


def test_normals_from_depth_are_those_of_the_plane(make_camera: Callable[..., Camera]) -> None:
    """Also where the Gaussians are round, and have no shortest axis."""
    view = make_camera(24, 20, 40.0)
    round_gaussians = gaussians(1, **(sheet(30, 0.0, 0.9) | {"scales": torch.full((900, 3), 0.05, dtype=F64)}))
    for splats in (gaussians(1, **sheet(30, 0.0, 0.9)), round_gaussians):
        rendering = render(splats, view, normals="depth")
        assert rendering.normal is not None
        middle = rendering.normal[6:14, 7:17]
        assert float(middle[..., 1].mean()) < -0.98
        torch.testing.assert_close(middle.norm(dim=-1), torch.ones_like(middle[..., 0]))


def test_normals_from_depth_are_those_of_a_ball(make_camera: Callable[..., Camera]) -> None:
    """Of the exact distance to a ball, up to its silhouette, where the surface is oblique to the ray."""
    view = make_camera(120, 100, 200.0)
    rays = view.rays()
    towards = (rays.origins * rays.directions).sum(dim=1)
    under = towards**2 - rays.origins.square().sum(dim=1) + 1
    seen = under > 0
    distance = torch.where(seen, -towards - under.clamp_min(0).sqrt(), 0)
    directions, seen = rays.directions.view(100, 120, 3), seen.view(100, 120)
    normal = normals_from_depth(distance.view(100, 120), seen, directions)
    facing = to_rendering(normal, seen.double(), distance.view(100, 120), normal, distance.view(100, 120), directions).normal
    true = rays.origins.view(100, 120, 3) + distance.view(100, 120, 1) * directions
    for found in (normal, facing):
        error = torch.rad2deg((found * true).sum(dim=-1)[seen].clamp(-1, 1).acos())
        assert seen.sum() > 1000 and float(error.mean()) < 1
        assert float((error > 20).double().mean()) < 0.01


def test_discs_agree_with_ellipses_where_both_are_small(make_camera: Callable[..., Camera]) -> None:
    """Flat, seen from afar: EWA's first order suffices, and so little is beyond the filter that both treat alike."""
    view = make_camera(48, 40, 400.0)
    splats = gaussians(12, scales=torch.rand(12, 3, dtype=F64) * torch.tensor([0.1, 0.1, 1e-6]) + torch.tensor([0.05, 0.05, 0]))
    disc, ellipse = (render(splats, view, shape=shape, dilation=1e-3) for shape in ("disc", "ellipsoid"))
    assert float(disc.alpha.max()) > 0.5
    assert float((disc.rgb - ellipse.rgb).abs().mean()) < 0.01
    assert float((disc.rgb - ellipse.rgb).abs().mean()) > 0


def test_the_third_axis_of_discs_is_their_normal(make_camera: Callable[..., Camera]) -> None:
    """Its scale changes neither the picture nor the normals, be it the longest, and has no gradient."""
    view, splats = make_camera(), gaussians(10)
    thin, thick = (
        replace(splats, scales=torch.cat([splats.scales[:, :2], torch.full((10, 1), size, dtype=F64)], dim=1))
        for size in (1e-4, 10.0)
    )
    thick.scales.requires_grad_()
    ours, theirs = (render(each, view, shape="disc", dilation=0.5) for each in (thin, thick))
    for name in ("rgb", "alpha", "depth", "normal"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    theirs.rgb.sum().backward()
    assert bool(thick.scales.grad[:, :2].any()) and not bool(thick.scales.grad[:, 2].any())
    one = Gaussians(**{name: value[:1] for name, value in vars(thick).items()})
    one = replace(one, means=torch.zeros(1, 3, dtype=F64), opacities=torch.full((1,), 0.95, dtype=F64))
    normal = render(one, view, shape="disc", dilation=0.5).normal
    axis = quaternion_to_matrix(one.quaternions)[0, :, 2]
    shown = normal[normal.norm(dim=2) > 0.5]
    assert len(shown) > 0
    torch.testing.assert_close((shown @ axis).abs(), torch.ones(len(shown), dtype=F64))


def test_discs_are_fitted(make_camera: Callable[..., Camera]) -> None:
    view, splats = make_camera(), gaussians(10)
    for leaf in (splats.means, splats.scales, splats.quaternions):
        leaf.requires_grad_()
    rendering, trace = Splatting(SplattingConfig(shape="disc", dilation=0.5)).render_image(
        Fixed(splats), view, Context(BOUNDS, training=True)
    )
    rendering.rgb.sum().backward()
    assert bool(splats.means.grad.any()) and bool(splats.quaternions.grad.any())
    assert bool(trace.screen.gradient.any())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])  # the reference, and the compiled kernel
def test_absolute_gradients_are_sums_over_pixels_of_absolute_ones(
    make_camera: Callable[..., Camera], dtype: torch.dtype
) -> None:
    """Against the ordinary gradients of one pixel's part of the loss at a time."""
    view, splats = make_camera(6, 5, 7.0).to(dtype), Gaussians(**{name: x.to(dtype) for name, x in vars(gaussians(4)).items()})
    splats.means.requires_grad_()
    factors, ctx = torch.randn(5, 6, 3, dtype=dtype), Context(BOUNDS, training=True)

    def screen(absolute: bool, at: tuple[slice | int, slice | int]) -> torch.Tensor:
        config = SplattingConfig(absolute_gradients=absolute)
        picture, trace = Splatting(config).render_image(Fixed(splats), view, ctx)
        (picture.rgb * factors)[at].sum().backward()
        assert trace.screen is not None and trace.screen.gradient is not None
        return trace.screen.gradient

    whole = (slice(None), slice(None))
    by_pixel = sum(screen(False, (row, column)).abs() for row in range(5) for column in range(6))
    torch.testing.assert_close(screen(True, whole), by_pixel, rtol=1e-3, atol=1e-5)
    assert bool((by_pixel > 1.1 * screen(False, whole).abs()).any())


def test_far_splats_keep_their_energy(make_camera: Callable[..., Camera]) -> None:
    """A field seen at a quarter of the size: with compensation the light per solid angle stays, without it grows."""
    splats = gaussians(30, scales=torch.full((30, 3), 0.01, dtype=F64), opacities=torch.full((30,), 0.9, dtype=F64))
    light = {}
    for antialiased in (False, True):
        fine = render(splats, make_camera(160, 144, 200.0), antialiased=antialiased).alpha.sum() / 200**2
        coarse = render(splats, make_camera(40, 36, 50.0), antialiased=antialiased).alpha.sum() / 50**2
        light[antialiased] = float(coarse / fine)
    assert light[True] == pytest.approx(1.0, abs=0.12)
    assert light[False] > 1.8


def test_ellipsoids_are_met_where_rays_meet_them(make_camera: Callable[..., Camera]) -> None:
    view = make_camera(30, 26, 40.0)
    one = gaussians(
        1,
        means=torch.tensor([[0.1, 0.2, -0.1]], dtype=F64),
        scales=torch.tensor([[0.4, 0.1, 0.25]], dtype=F64),
        opacities=torch.ones(1, dtype=F64),
    )
    drawn = draw_ellipsoids(one, view, reach=1.5)
    rays = view.rays()
    seen = drawn.alpha.flatten() > 0.5
    assert 20 < int(seen.sum()) < 600
    hit = rays.at(drawn.depth.flatten().where(seen, torch.zeros(()).double()))[seen] - one.means
    local = hit @ quaternion_to_matrix(one.quaternions)[0] / (1.5 * one.scales)
    torch.testing.assert_close(local.norm(dim=1), torch.ones(int(seen.sum()), dtype=F64))
    # It is the front, and the normal is the gradient of the quadric there.
    gradient = (local / one.scales) @ quaternion_to_matrix(one.quaternions)[0].T
    gradient = torch.nn.functional.normalize(gradient, dim=1)
    torch.testing.assert_close(drawn.normal.reshape(-1, 3)[seen], gradient)
    assert bool(((gradient * rays.directions[seen]).sum(dim=1) < 0).all())


def test_the_nearest_ellipsoid_hides_the_others(make_camera: Callable[..., Camera]) -> None:
    view, splats = make_camera(), gaussians(40)
    everything = draw_ellipsoids(splats, view)
    nearest = torch.stack(
        [draw_ellipsoids(type(splats)(*(x[i : i + 1] for x in vars(splats).values())), view).depth for i in range(40)]
    ).amin(dim=0)
    torch.testing.assert_close(everything.depth, nearest)
    assert not draw_ellipsoids(gaussians(0), view).alpha.any()


def test_refusals() -> None:
    with pytest.raises(ValueError, match="max_grad_splats"):
        SplattingConfig(max_grad_splats=-1)
    with pytest.raises(ValueError, match="discs"):
        SplattingConfig(shape="disc", antialiased=True)


def test_a_floor_of_one_disc_looks_the_same_in_every_crop() -> None:
    """A disc that reaches behind the camera may be seen anywhere, also where the principal point is far outside the picture."""
    floor = Gaussians(
        torch.tensor([[0.0, 0.0, -0.5]]), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[2.0, 2.0, 0.001]]),
        torch.tensor([0.95]), torch.zeros(1, 1, 3),
    )  # fmt: skip
    pose = look_at(torch.tensor([0.0, -2.0, 0.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    camera = Camera(pose, torch.tensor([150.0, 150.0]), torch.tensor([128.0, 128.0]), 256, 256)
    ctx = Context(Bounds(-torch.ones(3), torch.ones(3)))
    renderer = SplattingConfig(shape="disc").build(toy_scene(2, 8))
    whole = renderer.render_image(Fixed(floor), camera, ctx)[0].alpha
    for x, y in ((0, 192), (0, 240), (240, 240)):
        crop = replace(camera, principal_point=camera.principal_point - torch.tensor([float(x), float(y)]), width=16, height=16)
        part = renderer.render_image(Fixed(floor), crop, ctx)[0].alpha
        assert float(part.mean()) > 0.5
        torch.testing.assert_close(part, whole[y : y + 16, x : x + 16], atol=1e-3, rtol=0)
