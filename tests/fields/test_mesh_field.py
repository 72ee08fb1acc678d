"""Meshes to fit: a hull carved from silhouettes in closed form, colours taken from photographs, shapes that reload."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Context, Mesh, Quantity, Scene, View, harmonics
from invgraphics.errors import InputError
from invgraphics.fields import visual_hull as module
from invgraphics.fields.analytic import Sphere
from invgraphics.fields.isosurface import extract_mesh
from invgraphics.fields.mesh import MeshField, MeshFieldConfig
from invgraphics.fields.visual_hull import photograph_colours, visual_hull
from invgraphics.testing import toy_cameras

BOX = Bounds(-torch.ones(3), torch.ones(3))
RADIUS = 0.55


class NoDensity(Sphere):
    provides = Quantity.FEATURES

    def __init__(self) -> None:
        super().__init__(1.0, RADIUS)


def ball_scene(views: int = 24, size: int = 48) -> Scene:
    """A ball coloured by place, with antialiased alpha in closed form and exact depth."""
    upside_down = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    cameras = toy_cameras(views // 2, size)
    cameras += [camera.moved(upside_down @ camera.cam_to_world) for camera in cameras]
    train = []
    for index, camera in enumerate(cameras):
        rays = camera.rays()
        middle = -(rays.origins * rays.directions).sum(dim=1)
        closest = (rays.origins + middle[:, None] * rays.directions).norm(dim=1)
        pixel = middle / camera.focal[0]
        alpha = ((RADIUS - closest) / pixel + 0.5).clamp(0, 1)
        depth = torch.where(closest < RADIUS, middle - (RADIUS**2 - closest**2).clamp_min(0).sqrt(), torch.inf)
        place = rays.at(torch.where(closest < RADIUS, depth, middle))
        shape = (camera.height, camera.width)
        image = ((place / RADIUS + 1) / 2).clamp(0, 1).view(*shape, 3)
        train.append(View(camera, image, f"{index}", alpha=alpha.view(shape), depth=depth.view(shape)))
    return Scene("ball", tuple(train), tuple(train[:1]), torch.ones(3), BOX)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ball_scene()


def test_the_hull_encloses_the_ball_closely(scene: Scene) -> None:
    field = MeshFieldConfig(resolution=48, sh_degree=1).build(scene)
    mesh: Mesh = field.primitives(Quantity.MESH, Context(BOX))
    radii = mesh.vertices.norm(dim=1)
    assert mesh.open_edges() == 0
    assert float(radii.min()) > RADIUS - 0.01  # a quarter of a voxel
    assert float(radii.mean()) < RADIUS + 0.03
    # Colours come from the photographs: of the ball's place, seen through the hull's.
    assert mesh.rgb is not None
    error = (mesh.rgb.detach() - (mesh.vertices / radii[:, None] + 1) / 2).abs()
    assert float(error.mean()) < 0.03
    assert field.sh_rest.shape[1:] == (3, 3)


def test_a_silhouette_is_made_once_for_all_chunks_of_voxels(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, opacity, made = visual_hull(scene, 24).mesh, View.opacity, []
    monkeypatch.setattr(module, "CHUNK", 1000)
    monkeypatch.setattr(View, "opacity", lambda view, index=None: made.append(view) or opacity(view, index))
    assert torch.equal(visual_hull(scene, 24).mesh.vertices, whole.vertices)
    assert len(made) == len(scene.train)


def test_views_that_do_not_see_a_voxel_leave_it_alone(scene: Scene) -> None:
    """Pixels outside a mask say nothing, nor does what lies beside a picture; what no view sees is empty."""
    masked = [
        replace(view, alpha=torch.zeros_like(view.alpha), mask=torch.zeros(48, 48, dtype=torch.bool)) for view in scene.train
    ]
    half = scene.with_views(train=(*scene.train[::2], *masked[1::2]))
    mesh = MeshFieldConfig(resolution=24).build(half).primitives(Quantity.MESH, Context(BOX))
    assert float(mesh.vertices.norm(dim=1).min()) > RADIUS - 0.03
    with pytest.raises(InputError, match="visual hull"):
        MeshFieldConfig(resolution=24).build(scene.with_views(train=tuple(masked)))


def test_opaque_photographs_are_refused(scene: Scene) -> None:
    opaque = scene.with_views(train=tuple(replace(view, alpha=None, depth=None) for view in scene.train))
    with pytest.raises(InputError, match="opaque") as refusal:
        MeshFieldConfig().build(opaque)
    assert "field.source" in str(refusal.value.remedy)
    with pytest.raises(InputError, match="no depth maps"):
        MeshFieldConfig(init="depth").build(opaque)


def test_depth_maps_fuse_to_the_ball(scene: Scene) -> None:
    mesh = MeshFieldConfig(init="depth", resolution=32).build(scene).primitives(Quantity.MESH, Context(BOX))
    assert float((mesh.vertices.norm(dim=1) - RADIUS).abs().mean()) < 0.015


def test_colours_are_weighted_means_of_the_photographs(scene: Scene) -> None:
    """On the true shape, each vertex has its own colour, and a hidden one is grey."""
    ball = extract_mesh(Sphere(1.0, RADIUS), BOX, 32).mesh
    inner = replace(ball, vertices=0.5 * ball.vertices)
    both = Mesh(torch.cat([ball.vertices, inner.vertices]), torch.cat([ball.faces, inner.faces + len(ball.vertices)]))
    rgb = photograph_colours(both, scene.train, 0.05)
    outer, hidden = rgb[: len(ball.vertices)], rgb[len(ball.vertices) :]
    assert float((outer - (ball.vertices / RADIUS + 1) / 2).abs().mean()) < 0.02
    assert bool((hidden == 0.5).all())


def test_a_field_becomes_a_mesh(scene: Scene) -> None:
    config = MeshFieldConfig(source="a run", resolution=32, sh_degree=0)
    assert len(config.build(scene).faces) == 12
    field = config.converted(Sphere(1.0, RADIUS), scene)
    assert float((field.vertices.norm(dim=1) - RADIUS).abs().max()) < 2e-3
    again = config.converted(field, scene)
    assert torch.equal(again.vertices, field.vertices)
    features = NoDensity()
    with pytest.raises(InputError, match="NoDensity has no density") as refusal:
        config.converted(features, scene)
    assert "--to mesh" in str(refusal.value.remedy)


def test_a_checkpoint_of_another_size_loads() -> None:
    small, large = (MeshField(extract_mesh(Sphere(1.0, RADIUS), BOX, n).mesh, 1) for n in (12, 20))
    with torch.no_grad():
        large.sh_dc.add_(0.3)
    parameter = small.sh_dc
    small.load_state_dict(large.state_dict())
    assert small.sh_dc is parameter
    for name, value in large.state_dict().items():
        assert torch.equal(small.state_dict()[name], value)
    normals = small.primitives(Quantity.MESH, Context(BOX)).outwards()
    assert float((normals * small.vertices / RADIUS).sum(dim=1).min()) > 0.9


def test_extraction_evaluates_distances_near_the_surface_only() -> None:
    """Blocks far from the surface are not looked into, and the mesh is that of the full grid."""

    class Counting(Sphere):
        looked = 0

        def sdf_at(self, position: torch.Tensor) -> torch.Tensor:
            self.looked += len(position)
            return super().sdf_at(position)

    field = Counting(1.0, RADIUS)
    mesh = extract_mesh(field, BOX, 64).mesh
    assert field.looked < 0.45 * 64**3
    radii = mesh.vertices.norm(dim=1)
    assert float((radii - RADIUS).abs().max()) < 1e-3
    assert mesh.open_edges() == 0
    shifted = extract_mesh(field, BOX, 64, 0.1).mesh
    assert float((shifted.vertices.norm(dim=1) - RADIUS - 0.1).abs().max()) < 1e-3


def test_a_mesh_turns_with_its_colours() -> None:
    """Colours, normals and places after a similarity are those of the turned directions."""
    mesh = extract_mesh(Sphere(1.0, RADIUS), BOX, 12).mesh
    generator = torch.Generator().manual_seed(0)
    mesh = replace(mesh, sh=0.1 * torch.randn(len(mesh.vertices), 9, 3, generator=generator))
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
    turn = turn * torch.linalg.det(turn).sign()
    similarity = torch.eye(4)
    similarity[:3, :3], similarity[:3, 3] = 2.0 * turn, torch.tensor([1.0, 2.0, 3.0])
    turned = mesh.transformed(similarity)
    direction = torch.nn.functional.normalize(torch.randn(len(mesh.vertices), 3, generator=generator), dim=1)
    assert mesh.sh is not None
    assert turned.sh is not None
    torch.testing.assert_close(
        harmonics.evaluate(turned.sh, direction @ turn.T), harmonics.evaluate(mesh.sh, direction), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(turned.outwards(), Mesh(turned.vertices, turned.faces).outwards(), atol=1e-4, rtol=0)
