"""Triangles on pixels: against Möller and Trumbore's ray intersection, closed forms, and the transpose of interpolation."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from invgraphics import kernels
from invgraphics.core import Camera
from invgraphics.core.transforms import look_at
from invgraphics.kernels.reference.mesh import hit
from invgraphics.kernels.types import Fragments

IMPLEMENTATIONS = kernels.dispatch.cpu_implementations()


def camera_at(eye: tuple[float, float, float], width: int = 24, height: int = 18) -> Camera:
    pose = look_at(torch.tensor(eye), torch.tensor([0.0, 0.1, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(pose, torch.tensor([26.0, 24.0]), torch.tensor([11.3, 9.6]), width, height)


def soup(count: int = 60, size: float = 0.35) -> tuple[torch.Tensor, torch.Tensor]:
    """Random triangles around the camera's place: ahead, behind, and across its plane."""
    generator = torch.Generator().manual_seed(3)
    middle = 4 * torch.rand(count, 1, 3, generator=generator) - 2
    corners = middle + size * torch.randn(count, 3, 3, generator=generator)
    return corners.reshape(-1, 3), torch.arange(3 * count).view(-1, 3)


def moeller_trumbore(vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance of every triangle (rows) along every ray (columns), inf where it is missed (Möller and Trumbore 1997)."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    out = np.full((len(faces), len(rays)), np.inf)
    for i, direction in enumerate(rays):
        p = np.cross(direction, c - a)
        scale = 1 / (p * (b - a)).sum(1)
        s = origin - a
        u = (p * s).sum(1) * scale
        q = np.cross(s, b - a)
        v = (q * direction).sum(1) * scale
        t = (q * (c - a)).sum(1) * scale
        out[:, i] = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    return out


@pytest.mark.parametrize("name", IMPLEMENTATIONS)
def test_the_nearest_hit_of_every_ray(name: str) -> None:
    vertices, faces = soup()
    camera = camera_at((0.6, -0.9, 0.3))
    rays = camera.to(torch.float64).rays()
    near, far = torch.full((18, 24), 0.4), torch.full((18, 24), 2.5)
    ahead = ((vertices - camera.position) @ camera.cam_to_world[:3, 2] > 0)[faces]
    assert int((ahead.any(dim=1) & ~ahead.all(dim=1)).sum()) > 2, "some triangles cross the camera's plane"
    distance = moeller_trumbore(vertices.double().numpy(), faces.numpy(), rays.origins[0].numpy(), rays.directions.numpy())
    for interval, lowest, highest in ((None, 0.0, np.inf), ((near, far), 0.4, 2.5)):
        with kernels.using(name):
            found = kernels.mesh_rasterise(vertices, faces, camera, interval)
        counted = np.where((distance >= lowest) & (distance <= highest), distance, np.inf)
        expected = np.where(np.isfinite(counted.min(0)), counted.argmin(0), -1)
        assert (expected >= 0).sum() > 50
        assert (expected < 0).sum() > 10
        assert np.array_equal(found.face.reshape(-1).numpy(), expected)
        np.testing.assert_allclose(found.depth.reshape(-1).numpy(), counted.min(0), rtol=1e-6)


@pytest.mark.parametrize("name", IMPLEMENTATIONS)
def test_interpolation_is_perspective_correct(name: str) -> None:
    """The interpolated position of a plane seen aslant is where the ray is at its depth."""
    vertices = torch.tensor([[-4.0, -1.0, -0.5], [4.0, -1.0, -0.5], [4.0, 9.0, -0.5], [-4.0, 9.0, -0.5]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    camera = camera_at((0.2, -1.5, 0.4))
    with kernels.using(name):
        fragments = kernels.mesh_rasterise(vertices, faces, camera)
        position = kernels.mesh_interpolate(fragments, faces, vertices)
    seen = (fragments.face >= 0).reshape(-1)
    assert 100 < int(seen.sum()) < seen.numel()
    rays = camera.rays()
    expected = rays.at(fragments.depth.reshape(-1))
    torch.testing.assert_close(position.reshape(-1, 3)[seen], expected[seen], atol=2e-5, rtol=1e-5)
    assert float((expected[seen, 2] + 0.5).abs().max()) < 2e-5
    assert not bool(position.reshape(-1, 3)[~seen].any())


def test_both_kernels_agree_on_a_fine_mesh() -> None:
    """A sphere of small triangles, no hole in it, and the same faces to the last pixel."""
    angle = torch.linspace(0, torch.pi, 41)
    turn = torch.linspace(0, 2 * torch.pi, 81)[:-1]
    rings = torch.stack(
        [angle.sin()[:, None] * turn.cos(), angle.sin()[:, None] * turn.sin(), angle.cos()[:, None].expand(-1, 80)], dim=-1
    )
    corner = torch.arange(40)[:, None] * 80 + torch.arange(80)
    right = torch.arange(40)[:, None] * 80 + (torch.arange(80) + 1) % 80
    faces = torch.cat([torch.stack([corner, corner + 80, right], -1), torch.stack([right, corner + 80, right + 80], -1)])
    vertices, faces = rings.reshape(-1, 3), faces.reshape(-1, 3)
    camera = replace(
        camera_at((0.0, -3.0, 0.0), 96, 72), focal=torch.full((2,), 90.0), principal_point=torch.tensor([47.7, 36.2])
    )
    found = {}
    for name in IMPLEMENTATIONS:
        with kernels.using(name):
            found[name] = kernels.mesh_rasterise(vertices, faces, camera)
    one, *others = found.values()
    rays = camera.rays()
    closest = (rays.origins + -(rays.origins * rays.directions).sum(1, keepdim=True) * rays.directions).norm(dim=1)
    assert bool((one.face.reshape(-1)[closest < 0.99] >= 0).all())
    assert bool((one.face.reshape(-1)[closest > 1.0] < 0).all())
    for other in others:
        assert torch.equal(one.face, other.face)
        torch.testing.assert_close(one.barycentric, other.barycentric, atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", IMPLEMENTATIONS)
def test_the_backward_pass_is_the_transpose(name: str) -> None:
    vertices, faces = soup()
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(len(vertices), 5, generator=generator, requires_grad=True)
    with kernels.using(name):
        fragments = kernels.mesh_rasterise(vertices, faces, camera_at((0.6, -0.9, 0.3)))
        barycentric = fragments.barycentric.clone().requires_grad_()
        image = kernels.mesh_interpolate(replace(fragments, barycentric=barycentric), faces, features)
        weights = torch.randn(image.shape, generator=generator)
        (image * weights).sum().backward()
    assert features.grad is not None
    assert barycentric.grad is not None
    # <A x, y> = <x, A'y> for the linear map A, and the same for the weights with fixed features.
    total = float((image * weights).sum().detach())
    assert float((features.grad * features).sum().detach()) == pytest.approx(total, rel=1e-4)
    assert float((barycentric.grad * barycentric).sum().detach()) == pytest.approx(total, rel=1e-4)
    other = torch.randn(features.shape, generator=generator)
    with kernels.using(name):
        seen = kernels.mesh_interpolate(fragments, faces, other)
    assert float((features.grad * other).sum()) == pytest.approx(float((seen * weights).sum()), rel=1e-4)
    unused = torch.ones(len(vertices), dtype=torch.bool)
    unused[faces[fragments.face[fragments.face >= 0]].reshape(-1)] = False
    assert not bool(features.grad[unused].any())


def test_hits_move_with_corners_and_rays() -> None:
    """Gradients of barycentric coordinates and distances against finite differences."""
    generator = torch.Generator().manual_seed(1)
    corners = torch.randn(4, 3, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 4.0])
    origins = 0.1 * torch.randn(4, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(corners.mean(dim=1) - origins, dim=1)
    assert torch.autograd.gradcheck(hit, (origins.requires_grad_(), directions.requires_grad_(), corners.requires_grad_()))


@pytest.mark.parametrize("name", IMPLEMENTATIONS)
def test_nothing_to_see(name: str) -> None:
    """No triangle, a triangle without area, one that is not finite, and one behind the camera leave every pixel empty."""
    camera = camera_at((0.0, -3.0, 0.0))
    behind = torch.tensor([[-1.0, -5.0, -1.0], [1.0, -5.0, -1.0], [0.0, -5.0, 1.0]])
    line = torch.tensor([[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    nan = torch.full((3, 3), torch.nan)
    faces = torch.arange(9).view(3, 3)
    for chosen in (faces, faces[:0]):
        with kernels.using(name):
            found: Fragments = kernels.mesh_rasterise(torch.cat([behind, line, nan]), chosen, camera)
        assert bool((found.face == -1).all())
        assert bool(found.depth.isinf().all())
        assert not bool(found.barycentric.any())


@pytest.mark.parametrize("corner", [-1, 3, 100_000])
@pytest.mark.parametrize("name", IMPLEMENTATIONS)
def test_corners_that_are_no_vertices_are_refused(name: str, corner: int) -> None:
    if name == "reference" and corner == -1:
        pytest.skip("torch counts negative indices from the end")
    vertices, faces = torch.tensor([[-0.5, -0.5, 2.0], [0.5, -0.5, 2.0], [0.0, 0.5, 2.0]]), torch.tensor([[0, 1, corner]])
    camera = Camera(torch.eye(4), torch.full((2,), 20.0), torch.full((2,), 8.0), 16, 16)
    with kernels.using(name):
        fragments = kernels.mesh_rasterise(vertices, torch.tensor([[0, 1, 2]]), camera)
        assert bool((fragments.face == 0).any())
        with pytest.raises(IndexError):
            kernels.mesh_rasterise(vertices, faces, camera)
        with pytest.raises(IndexError):
            kernels.mesh_interpolate(fragments, faces, torch.rand(3, 2))
        with pytest.raises(IndexError):
            kernels.mesh_interpolate(replace(fragments, face=fragments.face + 1), torch.tensor([[0, 1, 2]]), torch.rand(3, 2))
