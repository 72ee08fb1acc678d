"""Projection and rasterisation of Gaussians, against Monte Carlo, closed forms, plain loops and finite differences."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invgraphics.core import Camera, Gaussians
from invgraphics.core.transforms import look_at, quaternion_to_matrix, se3_exp
from invgraphics.kernels import reference
from invgraphics.kernels.types import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Footprints

F64 = torch.float64


def camera(width: int = 20, height: int = 16, focal: float = 20.0) -> Camera:
    """Looks at the origin from two units away; unequal focal lengths, principal point off the centre."""
    eye, up = torch.tensor([0.3, -2.0, 0.5], dtype=F64), torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    pose = look_at(eye, torch.zeros(3, dtype=F64), up)
    lens, centre = torch.tensor([focal, 1.1 * focal], dtype=F64), torch.tensor([width / 2 + 1.7, height / 2 - 0.6], dtype=F64)
    return Camera(pose, lens, centre, width, height)


def gaussians(n: int, size: float = 0.1, degree: int = 1) -> Gaussians:
    return Gaussians(
        means=torch.randn(n, 3, dtype=F64) * 0.4,
        quaternions=torch.randn(n, 4, dtype=F64),
        scales=(torch.rand(n, 3, dtype=F64) + 0.2) * size,
        opacities=torch.rand(n, dtype=F64) * 0.8 + 0.1,
        sh=torch.randn(n, (degree + 1) ** 2, 3, dtype=F64) * 0.3,
    )


def conic_matrices(footprints: Footprints) -> Tensor:
    xx, xy, yy = footprints.conics.unbind(dim=1)
    return torch.stack([torch.stack([xx, xy], 1), torch.stack([xy, yy], 1)], 1)


@pytest.mark.parametrize("scales", [(0.01, 0.01, 0.01), (0.02, 0.005, 0.001)])
def test_projection_agrees_with_projected_samples(scales: tuple[float, float, float]) -> None:
    view, count = camera(), 400_000
    one = replace(gaussians(1), means=torch.tensor([[0.2, 0.1, -0.15]], dtype=F64), scales=torch.tensor([scales], dtype=F64))
    footprints, _ = reference.splat_project(one, view, dilation=0.0)
    turned = quaternion_to_matrix(one.quaternions)[0]
    points = one.means + (torch.randn(count, 3, dtype=F64) * one.scales) @ turned.T
    pixels, _ = view.project(points)
    distance = (points - view.position).norm(dim=1)

    offset = pixels - footprints.means2d
    covariance = torch.linalg.inv(conic_matrices(footprints))[0]
    spread = covariance.diagonal().sqrt()
    assert bool((offset.mean(dim=0).abs() < 0.02 * spread).all())
    measured = offset.T @ offset / count
    assert bool(((measured - covariance).abs() < 0.02 * spread[:, None] * spread[None, :]).all())

    # The plane of distances is the regression of a sample's distance on its pixel.
    features = torch.cat([torch.ones(count, 1, dtype=F64), offset], dim=1)
    fit = torch.linalg.lstsq(features, distance[:, None]).solution[:, 0]
    reach = torch.cat([torch.ones(1, dtype=F64), spread])
    assert bool(((fit - footprints.depth_planes[0]).abs() * reach < 0.02 * one.scales.max()).all())


def test_colour_is_seen_from_the_camera() -> None:
    view, splats = camera(), gaussians(5, degree=0)
    _, rgb = reference.splat_project(splats, view)
    torch.testing.assert_close(rgb, (splats.sh[:, 0] * 0.5 / math.sqrt(math.pi) + 0.5).clamp_min(0))
    # Band 1 is c (-y, z, -x): the coefficient of the second function alone gives c times the direction's z.
    sh = torch.zeros(5, 4, 3, dtype=F64)
    sh[:, 2] = 0.5
    direction = torch.nn.functional.normalize(splats.means - view.position, dim=1)
    _, rgb = reference.splat_project(replace(splats, sh=sh), view)
    torch.testing.assert_close(rgb[:, 0], 0.5 * math.sqrt(3 / (4 * math.pi)) * direction[:, 2] + 0.5)


def test_one_splat_equals_its_closed_form() -> None:
    view = camera()
    footprints, _ = reference.splat_project(gaussians(1, size=0.3), view)
    image, alpha = reference.splat_rasterise(footprints, torch.tensor([[2.0, -1.0]], dtype=F64), 20, 16, 8)
    offset = view.pixel_centres() - footprints.means2d[0]
    q = torch.einsum("hwi,ij,hwj->hw", offset, conic_matrices(footprints)[0], offset)
    expected = footprints.opacities[0] * torch.exp(-q / 2)
    expected = torch.where(expected < ALPHA_MIN, 0.0, expected)
    assert int((expected > 0).sum()) > 10
    torch.testing.assert_close(alpha, expected)
    torch.testing.assert_close(image, expected[..., None] * torch.tensor([2.0, -1.0], dtype=F64))


def test_radius_is_where_the_response_becomes_invisible() -> None:
    footprints, _ = reference.splat_project(gaussians(30), camera())
    seen = footprints.radii > 0
    assert int(seen.sum()) > 5
    # The largest eigenvalue of the covariance is one over the smallest of the conic.
    smallest = torch.linalg.eigvalsh(conic_matrices(footprints))[:, 0]
    at_edge = footprints.opacities * torch.exp(-0.5 * footprints.radii**2 * smallest)
    torch.testing.assert_close(at_edge[seen], torch.full_like(at_edge[seen], ALPHA_MIN))


def test_what_is_culled_was_invisible() -> None:
    view, splats = camera(), gaussians(400, size=0.05)
    splats = replace(splats, means=splats.means * 4, opacities=torch.rand(400, dtype=F64) * 0.05)
    footprints, rgb = reference.splat_project(splats, view)
    _, z = view.project(splats.means)
    in_front = z > 0.01
    assert not footprints.radii[~in_front].any()
    assert not footprints.radii[splats.opacities < ALPHA_MIN].any()
    assert 20 < int((footprints.radii > 0).sum()) < int(in_front.sum())
    everywhere = replace(footprints, radii=torch.where(in_front, 1e4, 0.0))
    torch.testing.assert_close(
        reference.splat_rasterise(footprints, rgb, 20, 16), reference.splat_rasterise(everywhere, rgb, 20, 16)
    )


def test_equals_a_loop_over_sorted_splats() -> None:
    """Opaque, overlapping splats: clamping, skipping and stopping all happen."""
    opaque = replace(gaussians(60, 1.5), opacities=torch.rand(60, dtype=F64) ** 0.05)
    footprints, rgb = reference.splat_project(opaque, camera())
    image, alpha = reference.splat_rasterise(footprints, rgb, 20, 16, 8)
    order = [i for i in torch.argsort(footprints.depths).tolist() if footprints.radii[i] > 0]
    clamped = stopped = 0
    for y in range(16):
        for x in range(20):
            light, colour = 1.0, torch.zeros(3, dtype=F64)
            for i in order:
                dx, dy = float(x + 0.5 - footprints.means2d[i, 0]), float(y + 0.5 - footprints.means2d[i, 1])
                xx, xy, yy = footprints.conics[i].tolist()
                response = float(footprints.opacities[i]) * math.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))
                a = min(response, ALPHA_MAX)
                clamped += response > ALPHA_MAX
                if response < ALPHA_MIN:
                    continue
                if light * (1 - a) < TRANSMITTANCE_MIN:
                    stopped += 1
                    break
                colour, light = colour + light * a * rgb[i], light * (1 - a)
            torch.testing.assert_close(image[y, x], colour)
            torch.testing.assert_close(float(alpha[y, x]), 1 - light)
    assert clamped > 10
    assert stopped > 20


def test_the_nearer_splat_wins_whatever_the_order() -> None:
    view = camera()
    forward = view.cam_to_world[:3, 2]
    splats = replace(
        gaussians(2, size=0.5), means=torch.stack([forward * 0.2, -forward * 0.2]), opacities=torch.full((2,), 0.99, dtype=F64)
    )
    colours = torch.eye(2, dtype=F64)
    footprints, _ = reference.splat_project(splats, view)
    centre = footprints.means2d[0].long()
    image, _ = reference.splat_rasterise(footprints, colours, 20, 16)
    assert image[centre[1], centre[0], 1] > 0.9
    reordered = Footprints(**{k: v.flip(0) for k, v in vars(footprints).items() if v is not None})
    torch.testing.assert_close(reference.splat_rasterise(reordered, colours.flip(0), 20, 16)[0], image)


def test_bins_list_every_tile_that_is_touched() -> None:
    footprints, _ = reference.splat_project(gaussians(50), camera(37, 21, 30.0))
    bins = reference.splat_bin(footprints, 37, 21, 8)
    assert (bins.columns, bins.rows) == (5, 3)
    for row in range(bins.rows):
        for column in range(bins.columns):
            index = row * bins.columns + column
            got = bins.splats[bins.starts[index] : bins.starts[index + 1]].tolist()
            low = torch.tensor([column * 8.0, row * 8.0])
            reaches = (footprints.means2d + footprints.radii[:, None] >= low) & (
                footprints.means2d - footprints.radii[:, None] < low + 8
            )
            touching = torch.nonzero(reaches.all(dim=1) & (footprints.radii > 0))[:, 0].tolist()
            assert got == sorted(touching, key=lambda i: (float(footprints.depths[i]), i))
    assert int(bins.starts[-1]) == len(bins.splats) > 50


def test_gradients_of_the_whole_pipeline_and_the_pose() -> None:
    """Central differences in float64, for every input including a twist of the camera."""
    view, splats = camera(), gaussians(8)
    cotangent = torch.randn(16, 20, 7, dtype=F64)

    def render(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, twist: Tensor) -> Tensor:
        moved = view.moved(se3_exp(twist) @ view.cam_to_world)
        footprints, rgb = reference.splat_project(Gaussians(means, quats, scales, opacities, sh), moved)
        image, alpha = reference.splat_rasterise(footprints, torch.cat([rgb, footprints.depth_planes], dim=1), 20, 16, 8)
        return (torch.cat([image, alpha[..., None]], dim=2) * cotangent).sum()

    inputs = (splats.means, splats.quaternions, splats.scales, splats.opacities, splats.sh, torch.zeros(6, dtype=F64))
    leaves = tuple(tensor.clone().requires_grad_() for tensor in inputs)
    assert torch.autograd.gradcheck(render, leaves, eps=1e-7, atol=1e-4, rtol=1e-4)


def test_culled_splats_have_zero_gradients() -> None:
    splats = gaussians(4)
    behind = replace(splats, means=(splats.means + torch.tensor([0.0, -9.0, 0.0])).requires_grad_())
    footprints, rgb = reference.splat_project(behind, camera())
    image, alpha = reference.splat_rasterise(footprints, rgb, 20, 16)
    (image.sum() + alpha.sum()).backward()
    assert not image.any()
    assert behind.means.grad is not None
    assert not behind.means.grad.any()


def test_needles_survive_single_precision() -> None:
    """A splat 1000 times longer than wide, seen close: xx yy - xy² would lose all digits in float32."""
    scales = torch.tensor([[1.0, 1e-3, 1e-3]], dtype=F64).expand(20, 3)
    needles, view = replace(gaussians(20), scales=scales), camera(640, 480, 2000.0)
    exact, _ = reference.splat_project(needles, view, dilation=0.0)
    single = Gaussians(**{name: tensor.float() for name, tensor in vars(needles).items()})
    rough, _ = reference.splat_project(single, view.to(torch.float32), dilation=0.0)
    torch.testing.assert_close(rough.conics.double(), exact.conics, rtol=5e-3, atol=1e-6)


def test_discs_are_hit_where_rays_meet_their_plane() -> None:
    view, count = camera(), 3
    axes = quaternion_to_matrix(torch.randn(count, 4, dtype=F64))
    centres, scales = torch.randn(count, 3, dtype=F64) * 0.2, torch.rand(count, 2, dtype=F64) * 0.3 + 0.1
    # Pixel to camera direction K^-1 (x, y, 1); disc plane to camera [u a, v b, centre]; the homography inverts the latter.
    lens = torch.diag(torch.cat([view.focal, torch.ones(1, dtype=F64)]))
    lens[:2, 2] = view.principal_point
    turn = view.cam_to_world[:3, :3].T
    plane = torch.stack([axes[:, :, 0] * scales[:, :1], axes[:, :, 1] * scales[:, 1:], centres - view.position], dim=2)
    homography = torch.linalg.inv(lens @ turn @ plane)
    none = torch.zeros(count, dtype=F64)
    footprints = Footprints(
        means2d=torch.full((count, 2), 8.0, dtype=F64),
        conics=torch.zeros(count, 3, dtype=F64),
        opacities=torch.full((count,), 0.9, dtype=F64),
        depths=torch.arange(count, dtype=F64),
        depth_planes=torch.zeros(count, 3, dtype=F64),
        radii=torch.full((count,), 100.0, dtype=F64),
        homography=homography,
    )
    rays = view.rays()
    for i in range(count):
        alone = Footprints(**{k: v[i : i + 1] for k, v in vars(footprints).items() if v is not None})
        _, alpha = reference.splat_rasterise(alone, none[:1, None], 20, 16)
        normal = axes[i, :, 2]
        t = ((centres[i] - rays.origins) @ normal) / (rays.directions @ normal)
        offset = rays.at(t) - centres[i]
        u, v = (offset @ axes[i, :, 0]) / scales[i, 0], (offset @ axes[i, :, 1]) / scales[i, 1]
        expected = 0.9 * torch.exp(-0.5 * (u * u + v * v))
        torch.testing.assert_close(alpha.flatten(), torch.where(expected < ALPHA_MIN, 0.0, expected))
