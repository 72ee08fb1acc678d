"""Warping by depth: the identity, a plane's homography, occlusion, and depth of a fitted field."""

from dataclasses import replace

import pytest
import torch

from invgraphics.core import Camera, Context, Quantity, Scene, View
from invgraphics.core.planes import homographies
from invgraphics.errors import InputError
from invgraphics.fields import depth_maps as module
from invgraphics.fields.depth_maps import DepthMapField, DepthMapsConfig, field_depth, stored_bytes
from invgraphics.renderers.depth_warp import DepthWarp, DepthWarpConfig
from invgraphics.testing import TwoBalls, check_field, check_renderer, toy_scene


@pytest.fixture
def scene() -> Scene:
    return toy_scene(views=5, size=24, facing="forward")


def facing(x: float = 0.0, size: int = 40) -> Camera:
    pose = torch.eye(4)
    pose[0, 3] = x
    return Camera(pose, torch.full((2,), 40.0), torch.full((2,), size / 2), size, size)


def wall(camera: Camera, z: float, colour: torch.Tensor) -> View:
    """A photograph of the plane z = const, whose colour depends on the place."""
    rays = camera.rays()
    depth = z / rays.directions[:, 2]
    x = (rays.origins + depth[:, None] * rays.directions)[:, :2]
    image = 0.5 + 0.4 * torch.sin(3 * x[:, :1] + torch.tensor([0.0, 1.0, 2.0]) + x[:, 1:]) * colour
    return View(camera, image.view(camera.height, camera.width, 3), "wall", depth=depth.view(camera.height, camera.width))


def shown(field: DepthMapField, camera: Camera, scene: Scene, **settings: float) -> tuple[torch.Tensor, ...]:
    picture, _ = DepthWarp(DepthWarpConfig(**settings)).render_image(field, camera, Context(scene.bounds, geometry=True))
    return picture.rgb, picture.alpha, picture.depth, picture.normal


def test_a_photograph_is_itself_from_its_own_camera(scene: Scene) -> None:
    field = DepthMapsConfig().build(scene)
    view = scene.train[2]
    rgb, alpha, depth, _ = shown(field, view.camera, scene, views=1)
    hit = view.depth.isfinite()
    torch.testing.assert_close(rgb[hit], (view.colour() * view.opacity()[..., None])[hit], atol=2e-3, rtol=0)
    torch.testing.assert_close(alpha[hit], view.opacity()[hit], atol=2e-3, rtol=0)
    torch.testing.assert_close(depth[hit], view.depth[hit], atol=1e-3, rtol=0)


def test_a_wall_moves_by_its_homography(scene: Scene) -> None:
    """Colour, distance and normal of a plane from another place, against the plane itself and the homography's shift."""
    source, target = facing(), facing(0.2)
    field = DepthMapField([wall(source, 2.0, torch.ones(3))], [wall(source, 2.0, torch.ones(3)).depth])
    rgb, alpha, depth, normal = shown(field, target, scene, views=1)
    truth = wall(target, 2.0, torch.ones(3))
    moved = homographies(source, torch.tensor([2.0]), target)[0] @ torch.tensor([0.5, 0.5, 1.0])
    shift = float(moved[0] / moved[2]) - 0.5
    reach = 40 - round(shift)  # what the source has seen
    assert 3 < shift < 5
    assert not bool(alpha[:, reach + 1 :].any())
    torch.testing.assert_close(rgb[:, : reach - 1], truth.image[:, : reach - 1], atol=2e-3, rtol=0)
    torch.testing.assert_close(depth[:, : reach - 1], truth.depth[:, : reach - 1], atol=1e-3, rtol=0)
    inner = normal[2:-2, 2 : reach - 2]
    torch.testing.assert_close(inner, torch.tensor([0.0, 0.0, -1.0]).expand_as(inner), atol=1e-2, rtol=0)


def test_the_nearer_surface_wins_and_the_next_view_fills_gaps(scene: Scene) -> None:
    """The left half of a view is a near wall, which moves by 8 px where the far one moves by 4: over it, or off a gap."""
    far, near, source = wall(facing(), 4.0, torch.ones(3)), wall(facing(), 2.0, torch.zeros(3)), facing()
    depth = torch.where(torch.arange(40) < 20, near.depth, far.depth)
    image = torch.where((torch.arange(40) < 20)[:, None], near.image, far.image)
    cut = View(source, image, "cut", depth=depth)
    left = facing(-0.4)  # from where things move to the right: 8 px at distance 2, 4 px at distance 4
    _, alpha, found, _ = shown(DepthMapField([cut], [depth]), left, scene, views=1)
    assert float(found[5:35, 9:27].max()) < 2.6
    assert float(found[5:35, 29:].min()) > 3.9
    assert not bool(alpha[:, :3].any())
    right = facing(0.4)  # from where the near wall uncovers 4 px of the far one
    _, alpha, _, _ = shown(DepthMapField([cut], [depth]), right, scene, views=1)
    assert not bool(alpha[:, 13:15].any())
    both = DepthMapField([cut, wall(facing(0.9), 4.0, torch.ones(3))], [depth, far.depth])
    rgb, alpha, found, _ = shown(both, right, scene, views=2)
    assert bool(alpha[:, 13:15].all())
    truth = wall(right, 4.0, torch.ones(3)).image
    torch.testing.assert_close(rgb[:, 13:15], truth[:, 13:15], atol=2e-3, rtol=0)


def test_depth_of_a_field_is_the_rendered_one(scene: Scene) -> None:
    view = scene.train[0]
    found = field_depth(TwoBalls(), view.camera, scene.bounds)
    both = found.isfinite() & view.depth.isfinite()
    assert float((found.isfinite() == view.depth.isfinite()).float().mean()) > 0.98
    assert float((found - view.depth)[both].abs().max()) < 0.03
    field = DepthMapsConfig("field", "somewhere").converted(TwoBalls(), scene)
    assert torch.equal(field.primitives(Quantity.DEPTH_MAPS, Context(scene.bounds)).view(0).depth, found)


def test_contracts(scene: Scene) -> None:
    field = DepthMapsConfig().build(scene)
    check_field(field, scene)
    check_renderer(DepthWarp(DepthWarpConfig()), field, scene)


def test_views_without_depth_are_refused(scene: Scene) -> None:
    blind = scene.with_views(train=tuple(View(view.camera, view.image, view.name) for view in scene.train))
    with pytest.raises(InputError, match=r"5 training views of scene 'toy' have no depth.*train0"):
        DepthMapsConfig().build(blind)


def test_soft_edges_are_averaged_premultiplied(scene: Scene) -> None:
    """Two columns to a pixel: opaque red beside almost transparent blue. A mean of colours times a mean alpha is no light."""
    camera = facing(size=32)
    colours = torch.zeros(32, 32, 3)
    colours[:, 0::2, 0] = colours[:, 1::2, 2] = 1.0
    alpha = torch.ones(32, 32)
    alpha[:, 1::2] = 0.1
    view = replace(wall(camera, 3.0, torch.ones(3)), image=colours, alpha=alpha)
    assert view.depth is not None
    rgb, opacity, *_ = shown(DepthMapField([view], [view.depth]), camera.resized(16, 16), scene)
    torch.testing.assert_close(rgb[8, 8], torch.tensor([0.5, 0.0, 0.05]), atol=1e-3, rtol=0)
    assert float(opacity[8, 8]) == pytest.approx(0.55, abs=1e-3)


def test_pixels_that_do_not_count_are_not_warped(scene: Scene) -> None:
    camera = facing(size=16)
    view = wall(camera, 3.0, torch.ones(3))
    mask = torch.ones(16, 16, dtype=torch.bool)
    mask[:, :8] = False
    assert view.depth is not None
    _, opacity, *_ = shown(DepthMapField([replace(view, mask=mask)], [view.depth]), camera, scene)
    assert float(opacity[:, :8].max()) == 0.0
    assert float(opacity[:, 9:].min()) > 0.99


def test_photographs_stay_bytes_and_show_what_floats_do(scene: Scene) -> None:
    """Bytes in the checkpoint too: colour, alpha and a distance in float32, 8 bytes for each pixel."""
    field = DepthMapsConfig().build(scene)
    floats = scene.with_views(train=tuple(replace(view, image=view.colour(), alpha=view.opacity()) for view in scene.train))
    same = DepthMapsConfig().build(floats)
    camera = scene.test[0].camera
    for found, expected in zip(shown(field, camera, scene), shown(same, camera, scene), strict=True):
        torch.testing.assert_close(found, expected)
    pictures = sum(
        field.state_dict()[name].numel() * field.state_dict()[name].element_size() for name in ("rgb", "alpha", "depth")
    )
    assert pictures == stored_bytes(scene.train) == 8 * 24 * 24 * 5
    assert stored_bytes(floats.train) == 20 * 24 * 24 * 5
    opaque = scene.with_views(train=tuple(replace(view, alpha=None) for view in scene.train))
    assert bool(
        (DepthMapsConfig().build(opaque).primitives(Quantity.DEPTH_MAPS, Context(scene.bounds)).view(0).opacity() == 1).all()
    )


def test_checkpoints_of_earlier_versions_hold_floats(scene: Scene) -> None:
    """And a fit to some of the photographs holds those alone."""
    few = scene.with_views(train=scene.train[1:4])
    field, again = DepthMapsConfig().build(few), DepthMapsConfig().build(scene)
    old = {name: value / 255 if value.dtype == torch.uint8 else value for name, value in field.state_dict().items()}
    again.load_state_dict(old)
    camera = scene.test[0].camera
    for found, expected in zip(shown(again, camera, scene), shown(field, camera, scene), strict=True):
        torch.testing.assert_close(found, expected)
    with pytest.raises(RuntimeError, match="size mismatch for depth"):
        again.load_state_dict(old | {"depth": old["depth"][0]})


def test_only_the_photographs_that_are_warped_are_made(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    field, made = DepthMapsConfig().build(scene), []
    monkeypatch.setattr(module, "View", lambda *args, **more: made.append(1) or View(*args, **more))
    shown(field, scene.test[0].camera, scene, views=2)
    assert len(made) == 2
