"""Multi-plane images against camera projection, quadrature on the planes, closed forms and finite differences."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Camera, Context, Field, Planes, Quantity, Samples, Scene, View
from invgraphics.core.compositing import layer_alphas_from_weights
from invgraphics.core.planes import homographies, homographies_to, inverse_depths, mean_camera, widened, widest_angle
from invgraphics.core.transforms import look_at, transform_points
from invgraphics.errors import InputError
from invgraphics.fields.plane_sweep import plane_sweep
from invgraphics.fields.planes import PlaneField, PlanesConfig
from invgraphics.renderers.planes import PlaneRenderer
from invgraphics.testing import check_field, check_renderer, toy_cameras, toy_scene

DEPTHS = inverse_depths(2.0, 5.0, 4)


class Fixed(Field):
    """Planes as they are."""

    provides = Quantity.PLANES

    def __init__(self, planes: Planes) -> None:
        super().__init__()
        self.planes = planes

    def query(self, samples: Samples, want: Quantity) -> Any:
        raise NotImplementedError

    def primitives(self, want: Quantity, ctx: Context) -> Planes:
        return self.planes


@pytest.fixture
def scene() -> Scene:
    return toy_scene(views=6, size=12, facing="forward")


def camera_at(eye: tuple[float, float, float], width: int = 9, height: int = 7, focal: float = 8.0) -> Camera:
    pose = look_at(torch.tensor(eye).double(), torch.zeros(3).double(), torch.tensor([0.1, 0.0, 1.0]).double())
    lens, centre = torch.tensor([focal, 1.1 * focal]).double(), torch.tensor([width / 2 + 0.3, height / 2 - 0.2]).double()
    return Camera(pose, lens, centre, width, height)


def some_planes() -> Planes:
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(4, 3, 11, 13, generator=generator, dtype=torch.float64)
    alpha = 0.8 * torch.rand(4, 11, 13, generator=generator, dtype=torch.float64)
    return Planes(camera_at((0.0, -3.5, 0.1), 13, 11, 9.0), DEPTHS, rgb, alpha)


def picture(planes: Planes, camera: Camera, scene: Scene, **context: Any) -> Any:
    return PlaneRenderer().render_image(Fixed(planes), camera, Context(scene.bounds, **context))[0]


def test_homographies_agree_with_projection() -> None:
    """Points on each plane, projected by both cameras: the map of one image is the other, to far less than 0.01 px."""
    reference, camera = camera_at((0.1, -3.5, 0.2), 640, 480, 500.0), camera_at((-0.6, -3.1, 0.5), 320, 240, 300.0)
    maps = homographies(reference, DEPTHS, camera)
    on_plane = torch.rand(50, 2, dtype=torch.float64) * 2 - 1
    for depth, to_reference in zip(DEPTHS, maps, strict=True):
        local = torch.cat([on_plane, torch.ones(50, 1, dtype=torch.float64)], dim=1) * depth
        points = transform_points(reference.cam_to_world, local)
        (here, _), (there, _) = camera.project(points), reference.project(points)
        mapped = torch.cat([here, torch.ones_like(here[:, :1])], dim=1) @ to_reference.T
        assert float((mapped[:, :2] / mapped[:, 2:] - there).abs().max()) < 1e-6
    # The third coordinate is that of the ray, scaled to z = 1 before the camera, times the plane's depth.
    assert float((mapped[:, 2] - DEPTHS[-1] * _ray_z(reference, camera, here)).abs().max()) < 1e-9


@pytest.mark.parametrize("forward", [0.0, 2.0, 5.0])
def test_homographies_to_a_camera_know_what_is_behind_it(forward: float) -> None:
    """Also of a camera that has passed some of the planes, and of one in a plane."""
    reference = camera_at((0.1, -3.5, 0.2), 640, 480, 500.0)
    pose = camera_at((-0.6, -3.1, 0.5), 320, 240, 300.0).cam_to_world.clone()
    pose[:3, 3] += forward * reference.cam_to_world[:3, 2]
    camera = replace(camera_at((-0.6, -3.1, 0.5), 320, 240, 300.0), cam_to_world=pose)
    depths = torch.cat([DEPTHS, ((camera.position - reference.position) @ reference.cam_to_world[:3, 2])[None]])
    pixels = torch.rand(50, 2, dtype=torch.float64) * reference.focal.new_tensor([640, 480])
    rays = reference.rays(pixels)
    along = rays.directions @ reference.cam_to_world[:3, 2]
    behind = 0
    for depth, to_camera in zip(depths, homographies_to(reference, depths, camera), strict=True):
        there, z = camera.project(rays.origins + (depth / along)[:, None] * rays.directions)
        mapped = torch.cat([pixels, torch.ones_like(pixels[:, :1])], dim=1) @ to_camera.T
        torch.testing.assert_close(mapped[:, 2], z)
        before = z > 1e-3
        torch.testing.assert_close(mapped[before, :2] / mapped[before, 2:], there[before])
        behind += int((z < 0).sum())
    assert (behind > 0) == (forward > 0)


def _ray_z(reference: Camera, camera: Camera, pixels: Tensor) -> Tensor:
    rays = camera.rays(pixels)
    ahead = rays.directions @ camera.cam_to_world[:3, 2]
    return rays.directions @ reference.cam_to_world[:3, 2] / ahead


def test_equals_quadrature_with_samples_on_the_planes(scene: Scene) -> None:
    """Rays cut the planes one by one, scipy interpolates them there, and the volumetric compositing kernel does the rest."""
    planes, camera = some_planes(), camera_at((0.4, -3.2, -0.3), focal=5.0)
    rays, axis = camera.rays(), planes.camera.cam_to_world[:3, 2]
    t = (planes.depths - (rays.origins - planes.camera.position) @ axis[:, None]) / (rays.directions @ axis)[:, None]
    alpha, rgb = [], []
    for index in range(4):
        pixel, _ = planes.camera.project(rays.at(t[:, index]))
        row, column = (pixel.numpy() - 0.5).T[::-1]
        inside = ((pixel >= 0) & (pixel <= torch.tensor([13, 11]))).all(dim=1)
        look = [map_coordinates(layer.numpy(), (row, column), order=1, mode="nearest") for layer in
                (*planes.rgb[index], planes.alpha[index])]  # fmt: skip
        rgb.append(np.stack(look[:3], axis=1))
        alpha.append(torch.from_numpy(look[3]) * inside)
    assert 0.2 < float((torch.stack(alpha) > 0).double().mean()) < 0.95  # some pixels miss some planes
    thickness = -torch.log1p(-torch.stack(alpha, dim=1)).reshape(-1)
    features = torch.cat([torch.from_numpy(np.stack(rgb, axis=1)).reshape(-1, 3), t.reshape(-1, 1)], dim=1)
    _, sums, opacity = kernels.composite(thickness, features, torch.arange(len(rays)).repeat_interleave(4), len(rays))
    shown = picture(planes, camera, scene)
    torch.testing.assert_close(shown.rgb.reshape(-1, 3), sums[:, :3], atol=1e-5, rtol=0)
    torch.testing.assert_close(shown.alpha.reshape(-1), opacity, atol=1e-5, rtol=0)
    seen = opacity >= 0.5
    torch.testing.assert_close(shown.depth.reshape(-1)[seen], (sums[:, 3] / opacity)[seen], atol=1e-5, rtol=0)


def test_gradients_are_those_of_finite_differences(scene: Scene) -> None:
    planes, camera = some_planes(), camera_at((0.4, -3.2, -0.3), 4, 3)

    def render(rgb: Tensor, alpha: Tensor, pose: Tensor) -> Tensor:
        shown = picture(replace(planes, rgb=rgb, alpha=alpha), camera.moved(pose), scene, training=True)
        return torch.cat([shown.rgb, shown.alpha[..., None]], dim=-1).sum(dim=(0, 1))

    inputs = [value.clone().requires_grad_(True) for value in (planes.rgb, planes.alpha, camera.cam_to_world)]
    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-5, fast_mode=True)


def test_one_opaque_plane_is_a_plane(scene: Scene) -> None:
    """Depth is the distance along the ray; the normal is the plane's, towards the camera; nothing is seen from behind it."""
    planes = some_planes()
    planes = replace(planes, alpha=torch.zeros_like(planes.alpha).index_fill(0, torch.tensor(1), 1.0))
    camera = camera_at((0.3, -3.3, 0.2), focal=20.0)
    shown = picture(planes, camera, scene, geometry=True)
    rays, axis = camera.rays(), planes.camera.cam_to_world[:3, 2]
    t = (DEPTHS[1] - (camera.position - planes.camera.position) @ axis) / (rays.directions @ axis)
    assert bool((shown.alpha > 0.999).all())
    torch.testing.assert_close(shown.depth.reshape(-1), t)
    torch.testing.assert_close(shown.normal, (-axis).expand_as(shown.normal))
    behind = camera.moved(camera.cam_to_world.clone().index_put((torch.arange(3), torch.tensor(3)), 6 * axis))
    assert not bool(picture(planes, behind, scene).alpha.any())


def test_view_dependence_is_the_basis_at_the_viewing_direction(scene: Scene) -> None:
    """With the x of the viewing direction as the only basis function, that is what is added."""
    planes, camera = some_planes(), camera_at((0.3, -3.3, 0.2), focal=20.0)
    opaque = torch.zeros_like(planes.alpha).index_fill(0, torch.tensor(2), 1.0)
    coefficients = torch.zeros(4, 1, 3, 22, 26, dtype=torch.float64)
    coefficients[:, :, 0] = 0.5
    planes = replace(planes, rgb=torch.full_like(planes.rgb, 0.5), alpha=opaque)
    shown = picture(replace(planes, coefficients=coefficients, basis=lambda v: v[:, :1]), camera, scene)
    along_x = camera.rays().directions @ planes.camera.cam_to_world[:3, 0]
    assert float(along_x.abs().max()) > 0.1
    torch.testing.assert_close(shown.rgb[..., 0].reshape(-1), 0.5 + 0.5 * along_x, atol=1e-3, rtol=0)
    torch.testing.assert_close(shown.rgb[..., 1], torch.full_like(shown.rgb[..., 1], 0.5))


def test_weights_and_alphas_are_inverses() -> None:
    weights = torch.softmax(torch.randn(5, 3, 4), dim=0)
    light = torch.cumprod(1 - layer_alphas_from_weights(weights), dim=0).roll(1, 0)
    light[0] = 1
    torch.testing.assert_close(light * layer_alphas_from_weights(weights), weights, atol=1e-5, rtol=0)


def test_a_sweep_finds_a_textured_plane(scene: Scene) -> None:
    """Views of one plane, made by a homography per view: the sweep makes that plane opaque, and the others not."""
    field = PlanesConfig(count=6, near=2.0, far=5.0, init="uniform").build(scene)
    texture = torch.rand(3, *field.alpha_logits.shape[1:])
    alpha = torch.zeros_like(field.alpha_logits).index_fill(0, torch.tensor(3), 1.0)
    truth = Planes(field.camera, field.depths, texture.expand(6, -1, -1, -1), alpha)
    views = tuple(View(view.camera, picture(truth, view.camera, scene).rgb, view.name) for view in scene.train)
    swept = PlanesConfig(count=6, near=2.0, far=5.0, agreement=0.02).build(scene.with_views(train=views))
    shown = picture(swept.primitives(Quantity.PLANES, Context(scene.bounds)), mean_camera([v.camera for v in views]), scene)
    depth = shown.depth[2:-2, 2:-2]
    assert float((depth - float(field.depths[3])).detach().abs().median()) < 0.15


def test_planes_span_what_is_seen(scene: Scene) -> None:
    cameras = [view.camera for view in scene.train]
    field = PlanesConfig(count=5, init="uniform").build(scene)
    z = field.camera.project(scene.points.position)[1]
    assert float(field.depths[0]) <= float(z.min()) * 1.01
    assert float(field.depths[-1]) >= float(z.max()) * 0.99
    steps = (1 / field.depths).diff()
    torch.testing.assert_close(steps, steps[:1].expand(4), atol=1e-4, rtol=0)
    wide = widened(mean_camera(cameras), cameras, (2.0, 5.0), 5.0)
    for camera in cameras:  # the corners of every picture fall on both planes' pictures
        corners = torch.tensor([[0.0, 0.0, 1.0], [12, 0, 1], [0, 12, 1], [12, 12, 1]])
        places = corners @ homographies(wide, torch.tensor([2.0, 5.0]), camera).transpose(1, 2)
        pixels = places[..., :2] / places[..., 2:]
        assert bool((pixels > -1e-3).all())
        assert bool((pixels < torch.tensor([wide.width, wide.height]) + 1e-3).all())


def test_cameras_all_around_are_refused() -> None:
    around = toy_scene(views=5, size=8)
    assert widest_angle([view.camera for view in around.train]) > 90
    assert widest_angle(toy_cameras(5, 8, facing="forward")) < 20
    with pytest.raises(InputError, match=r"cameras of scene 'toy' look up to \d+ degrees away"):
        PlanesConfig().build(around)


def test_contracts(scene: Scene) -> None:
    for basis in (0, 2):
        torch.manual_seed(0)
        field = PlanesConfig(count=4, basis=basis).build(scene)
        check_field(field, scene)
        check_renderer(PlaneRenderer(), field, scene)
        other = PlanesConfig(count=4, init="uniform", basis=basis).build(scene)
        other.load_state_dict(field.state_dict())
        assert isinstance(other, PlaneField)
        assert torch.equal(other.rgb_logits, field.rgb_logits)


def test_pixels_that_do_not_count_make_no_planes() -> None:
    """The left half of each photograph is something red in the way; with masks it is never looked at."""
    mask = torch.ones(16, 16, dtype=torch.bool)
    mask[:, :8] = False
    photograph = torch.full((16, 16, 3), 0.2)
    photograph[:, :8] = torch.tensor([1.0, 0.0, 0.0])
    cameras = [camera_at((x, -3.0, 0.0), 16, 16, 16.0).to(torch.float32) for x in (-0.05, 0.0, 0.05)]
    found = {}
    for masked in (False, True):
        views = tuple(View(camera, photograph, str(i), mask=mask if masked else None) for i, camera in enumerate(cameras))
        seen = replace(toy_scene(2, 16), train=views)
        found[masked] = plane_sweep(seen, cameras[1], torch.tensor([2.0, 3.0, 4.0]), 3, 0.05)
    red = [(rgb[:, 0] - rgb[:, 1])[:, :, :6].mul(alpha[:, :, :6]).amax() for rgb, alpha in found.values()]
    assert float(red[0]) > 0.2
    assert float(red[1]) < 1e-3
