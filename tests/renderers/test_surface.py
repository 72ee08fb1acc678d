"""Rasterised meshes: against closed forms, finite differences and Mitsuba's primary hits."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from invgraphics import kernels
from invgraphics.core import Bounds, Camera, Context, Mesh, Quantity, harmonics
from invgraphics.core.transforms import look_at
from invgraphics.errors import NotComposableError
from invgraphics.fields.analytic import Box, Sphere
from invgraphics.fields.isosurface import extract_mesh
from invgraphics.fields.mesh import ExtractedMesh, MeshField
from invgraphics.formats.mesh import write_mesh
from invgraphics.renderers import surface
from invgraphics.renderers.surface import Surface, SurfaceConfig
from invgraphics.scenes.mitsuba import gbuffer
from invgraphics.testing import check_field, check_renderer, toy_scene

BOX = Bounds(torch.full((3,), -1.5), torch.full((3,), 1.5))
RADIUS = 0.8


@pytest.fixture(scope="module")
def ball() -> Mesh:
    return extract_mesh(Sphere(1.0, RADIUS, colour=(0.2, 0.6, 0.4)), BOX, 32).mesh


@pytest.fixture
def camera(make_camera: Callable[..., Camera]) -> Camera:
    return make_camera(32, 24, 34.0).to(torch.float32)


def picture(mesh: Mesh, camera: Camera, bounds: Bounds = BOX, **settings: object):
    field = MeshField(mesh, 0 if mesh.sh is None else harmonics.degree_of(mesh.sh.shape[1]))
    with torch.no_grad():
        return Surface(SurfaceConfig(**settings)).render_image(field, camera, Context(bounds, geometry=True))[0]


def test_a_ball_in_closed_form(ball: Mesh, camera: Camera) -> None:
    """Depth along the unit ray, normals, and silhouettes as soft as the share of a pixel that is covered."""
    seen = picture(ball, camera, supersampling=1)
    rays = camera.rays()
    middle = -(rays.origins * rays.directions).sum(dim=1)
    half = RADIUS**2 - (rays.origins + middle[:, None] * rays.directions).square().sum(dim=1)
    inside = half > 0.02
    assert int(inside.sum()) > 150
    assert bool((seen.alpha.reshape(-1)[inside] == 1).all())
    assert not bool(seen.alpha.reshape(-1)[half < 0].any())
    t = middle - half.clamp_min(0).sqrt()
    # The middle of a triangle of 32 voxels over 3 units lies up to 0.005 inside of the sphere; aslant, more along the ray.
    assert float((seen.depth.reshape(-1) - t)[half > 0.3].abs().max()) < 7e-3
    expected = rays.at(t) / RADIUS
    assert seen.normal is not None
    cosine = (seen.normal.reshape(-1, 3) * expected).sum(dim=1)[inside]
    assert float(cosine.min()) > 0.995
    colour = torch.tensor([0.2, 0.6, 0.4])
    torch.testing.assert_close(seen.rgb.reshape(-1, 3)[inside], colour.expand(int(inside.sum()), 3), atol=1e-5, rtol=0)
    soft, fine = picture(ball, camera), picture(ball, camera.resized(96, 72), supersampling=1)
    mean = fine.alpha.view(24, 3, 32, 3).mean(dim=(1, 3))
    torch.testing.assert_close(soft.alpha, mean)
    assert bool(((soft.alpha > 0) & (soft.alpha < 1)).any())
    assert soft.normal is not None
    assert bool(((soft.normal.norm(dim=-1) - 1).abs() < 1e-5)[soft.alpha >= 0.5].all())


def test_normals_do_not_cancel_along_a_silhouette(ball: Mesh, make_camera: Callable[..., Camera]) -> None:
    """Those of triangles that reach over the horizon: near the radius of the hit, as everywhere."""
    camera = make_camera(96, 72, 102.0).to(torch.float32)
    seen = picture(ball, camera, supersampling=1)
    assert seen.normal is not None
    hit = (seen.alpha == 1).reshape(-1)
    where = camera.rays().at(torch.where(hit, seen.depth.reshape(-1), 0.0))
    cosine = (seen.normal.reshape(-1, 3) * torch.nn.functional.normalize(where, dim=1)).sum(dim=1)[hit]
    assert float(cosine.min()) > 0.99


@pytest.mark.parametrize("normals", ["vertices", "faces"])
@pytest.mark.parametrize("height", [-0.6, 0.6])
def test_a_sheet_has_the_normal_of_the_side_that_is_seen(normals: str, height: float) -> None:
    """Also aslant: a normal that points away from the camera is that of the other side, by however little it does."""
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    sheet = Mesh.coloured(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.full((4, 3), 0.5))
    pose = look_at(torch.tensor([0.0, -3.0, height]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    seen = picture(sheet, Camera(pose, torch.full((2,), 30.0), torch.full((2,), 16.0), 32, 32), normals=normals)
    assert seen.normal is not None
    hit = seen.alpha == 1
    assert int(hit.sum()) > 20
    side = torch.tensor([0.0, 0.0, math.copysign(1.0, height)])
    torch.testing.assert_close(seen.normal[hit], side.expand(int(hit.sum()), 3))


def test_flat_normals_are_those_of_the_faces(camera: Camera) -> None:
    cube = extract_mesh(Box(1.0, (0.5, 0.5, 0.5)), BOX, 24).mesh
    seen = picture(cube, camera, supersampling=1, normals="faces")
    assert seen.normal is not None
    largest = seen.normal[seen.alpha > 0].abs().amax(dim=1)
    assert float((largest > 0.999).float().mean()) > 0.75  # all but the bevels that marching cubes leaves


def test_strips_of_rows_are_one_picture(ball: Mesh, camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = picture(ball, camera)
    monkeypatch.setattr("invgraphics.renderers.surface.STRIP", 96 * 3 * 5)
    parts = picture(ball, camera)
    torch.testing.assert_close(parts.rgb, whole.rgb, atol=1e-6, rtol=0)
    torch.testing.assert_close(parts.depth, whole.depth)


@pytest.mark.parametrize("pixel", [(16, 12), (9, 12), (0, 0)])
def test_hits_of_a_pixel_make_its_colour_and_depth(ball: Mesh, camera: Camera, pixel: tuple[int, int]) -> None:
    """Inside, on the silhouette (some rays miss) and beside the ball."""
    whole, (column, row) = picture(ball, camera), pixel
    field = MeshField(ball, 0)
    found = Surface(SurfaceConfig()).contributions(field, camera, pixel, Context(BOX, geometry=True))
    assert len(found) == round(9 * float(whole.alpha[row, column]))
    assert bool((found.t.diff() >= 0).all())
    torch.testing.assert_close(found.colour, whole.rgb[row, column])
    torch.testing.assert_close(found.transmittance * found.alpha, found.weight)
    if float(whole.alpha[row, column]) >= 0.5:
        assert found.expected_depth == pytest.approx(float(whole.depth[row, column]), rel=1e-6)
        assert found.median_depth == pytest.approx(float(found.t[4]))


def test_crop_and_near_open_the_ball(ball: Mesh, camera: Camera) -> None:
    """Behind the crop's front, the far half is seen from inside."""
    rays = camera.rays()
    middle = -(rays.origins * rays.directions).sum(dim=1)
    half = RADIUS**2 - (rays.origins + middle[:, None] * rays.directions).square().sum(dim=1)
    far = middle + half.clamp_min(0).sqrt()
    behind = replace(BOX, near=float(middle.mean()))
    cropped = replace(BOX, crop=(torch.tensor([-2.0, 0.0, -2.0]), torch.full((3,), 2.0)))
    for bounds in (behind, cropped):
        seen = picture(ball, camera, bounds, supersampling=1).depth.reshape(-1)
        assert float((seen - far)[half > 0.4].abs().max()) < 7e-3


def test_pictures_are_linear_in_the_harmonics(ball: Mesh, camera: Camera) -> None:
    """The difference of two pictures is the picture of the difference; the gradient is that of a linear map."""
    generator = torch.Generator().manual_seed(0)
    field = MeshField(ball, 2)
    with torch.no_grad():
        field.sh_rest.copy_(0.02 * torch.randn(field.sh_rest.shape, generator=generator))
    renderer, ctx = Surface(SurfaceConfig(supersampling=2)), Context(BOX, training=True)
    seen, _ = renderer.render_image(field, camera, ctx)
    weights = torch.randn(seen.rgb.shape, generator=generator)
    (seen.rgb * weights).sum().backward()
    gradient, step = field.sh_rest.grad, 0.02 * torch.randn(field.sh_rest.shape, generator=generator)
    assert gradient is not None
    with torch.no_grad():
        field.sh_rest.add_(step)
        changed, _ = renderer.render_image(field, camera, ctx)
    expected = float((gradient * step).sum())
    assert float(((changed.rgb - seen.rgb) * weights).sum().detach()) == pytest.approx(
        expected, abs=1e-4 * float(weights.numel()) ** 0.5
    )
    assert abs(expected) > 0.01


def test_the_pose_has_the_slope_of_the_surface(ball: Mesh, camera: Camera) -> None:
    """Colour and depth at pixels far from the silhouette, against central differences of the camera's place."""
    coloured = replace(ball, sh=harmonics.constant((ball.vertices + 1) / 2))
    field, renderer = MeshField(coloured, 0), Surface(SurfaceConfig(supersampling=1))
    ctx = Context(BOX, training=True)

    def values(offset: torch.Tensor) -> torch.Tensor:
        pose = torch.cat(
            [camera.cam_to_world[:, :3], (camera.cam_to_world[:, 3] + torch.nn.functional.pad(offset, (0, 1)))[:, None]], 1
        )
        seen, _ = renderer.render_image(field, camera.moved(pose), ctx)
        return torch.cat([seen.rgb[10:14, 14:18].reshape(-1), seen.depth[10:14, 14:18].reshape(-1)]).sum()

    offset = torch.zeros(3, requires_grad=True)
    (gradient,) = torch.autograd.grad(values(offset), offset)
    with torch.no_grad():
        numeric = torch.stack([(values(h) - values(-h)) / 0.02 for h in 0.01 * torch.eye(3)])
    torch.testing.assert_close(gradient, numeric, rtol=0.05, atol=0.5)  # a step crosses faces, whose slopes differ
    assert float(numeric.abs().max()) > 10


def test_contracts(ball: Mesh) -> None:
    scene = toy_scene(views=2, size=8)
    field, renderer = MeshField(ball, 1), Surface(SurfaceConfig())
    check_field(field, scene)
    check_renderer(renderer, field, scene)
    with pytest.raises(NotComposableError, match="MeshField has no gaussians"):
        field.primitives(Quantity.GAUSSIANS, Context(scene.bounds))


def test_a_distance_is_shown_as_its_mesh(camera: Camera) -> None:
    """Colours are the field's own, towards the camera; the mesh is extracted once."""

    class Looking(Sphere):
        def radiance_along(self, direction: torch.Tensor) -> torch.Tensor:
            return (direction + 1) / 2

    field = ExtractedMesh(Looking(1.0, RADIUS), 32)
    with torch.no_grad():
        seen, _ = Surface(SurfaceConfig(supersampling=1)).render_image(field, camera, Context(BOX))
    inside = seen.alpha > 0
    expected = (camera.rays().directions.view(24, 32, 3) + 1) / 2
    assert float((seen.rgb - expected)[inside].abs().max()) < 0.01
    assert field.primitives(Quantity.MESH, Context(BOX)) is field.primitives(Quantity.MESH, Context(BOX))
    assert field.state_dict().keys() == field.source.state_dict().keys()


def test_mitsuba_has_the_same_primary_hits(ball: Mesh, camera: Camera, tmp_path: Path) -> None:
    """The exported file, traced by Mitsuba at pixel centres: the same pixels, depths and face normals."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    write_mesh(tmp_path / "ball.ply", ball, torch.full_like(ball.vertices, 0.5))
    given = {"type": "ply", "filename": str(tmp_path / "ball.ply"), "face_normals": True}
    scene = mitsuba.load_dict({"type": "scene", "ball": given})
    traced = gbuffer.trace(scene, camera)
    ours = picture(ball, camera, supersampling=1, normals="faces")
    hit = traced.alpha > 0
    assert hit.sum() > 200
    assert np.array_equal(ours.alpha.numpy() > 0, hit)
    np.testing.assert_allclose(ours.depth.numpy()[hit], traced.depth[hit], atol=1e-4)
    assert ours.normal is not None
    cosine = (ours.normal.numpy() * traced.normal).sum(axis=-1)[hit]
    assert (cosine > 0.9999).mean() > 0.99  # a ray through an edge may find either face


def test_the_reference_draws_the_same_picture(ball: Mesh, camera: Camera) -> None:
    fast = picture(ball, camera)
    with kernels.using("reference"):
        slow = picture(ball, camera)
    torch.testing.assert_close(fast.rgb, slow.rgb, atol=1e-5, rtol=0)
    torch.testing.assert_close(fast.alpha, slow.alpha)


def test_strips_without_a_triangle_have_normals_of_nothing(monkeypatch) -> None:
    """The renderer works on strips of rows, of which those above and below the object see no face."""
    monkeypatch.setattr(surface, "STRIP", 16 * 9 * 2)
    corners = torch.tensor([[-0.2, 0.0, -0.2], [0.2, 0.0, -0.2], [0.0, 0.0, 0.2]])
    triangle = Mesh.coloured(corners, torch.tensor([[0, 1, 2]]), torch.full((3, 3), 0.5))
    pose = look_at(torch.tensor([0.0, -3.0, 0.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    view = Camera(pose, torch.tensor([16.0, 16.0]), torch.tensor([8.0, 8.0]), 16, 16)
    found = picture(triangle, view, normals="faces")
    assert 0 < float(found.alpha.sum()) < 16
    assert bool((found.normal[0] == 0).all()) and bool(found.normal.isfinite().all())
