"""The pinhole camera: rays and projection undo each other, also under resizing, and both differentiate in the pose."""

import pytest
import torch

from invgraphics.core import Camera
from invgraphics.core.transforms import look_at, se3_exp
from invgraphics.errors import InputError

F64 = torch.float64


def camera() -> Camera:
    eye, target = torch.tensor([1.0, -2.0, 0.7], dtype=F64), torch.tensor([0.1, 0.2, 0.0], dtype=F64)
    pose = look_at(eye, target, torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    return Camera(pose, torch.tensor([21.0, 24.0], dtype=F64), torch.tensor([8.3, 5.1], dtype=F64), 16, 12)


@pytest.mark.parametrize("name", ["cam_to_world", "focal", "principal_point"])
def test_plain_numbers_are_no_tensors(name: str) -> None:
    tensors = {"cam_to_world": torch.eye(4), "focal": torch.ones(2), "principal_point": torch.ones(2)}
    with pytest.raises(InputError, match=f"The camera's '{name}' is float"):
        Camera(**tensors | {name: 26.0}, width=2, height=2)


def test_pixel_centres_are_at_a_half_and_run_row_by_row() -> None:
    centres = camera().pixel_centres()
    assert centres.shape == (12, 16, 2)
    assert centres[0, 0].tolist() == [0.5, 0.5]
    assert centres[3, 7].tolist() == [7.5, 3.5]
    torch.testing.assert_close(camera().rays().directions[3 * 16 + 7], camera().rays(centres[3, 7][None]).directions[0])


def test_rays_and_projection_undo_each_other() -> None:
    view = camera()
    pixels = torch.rand(50, 2, dtype=F64) * torch.tensor([16.0, 12.0], dtype=F64)
    rays = view.rays(pixels, view=4)
    torch.testing.assert_close(rays.directions.norm(dim=1), torch.ones(50, dtype=F64))
    points = rays.at(torch.rand(50, dtype=F64) * 5 + 0.1)
    back, z = view.project(points)
    torch.testing.assert_close(back, pixels)
    torch.testing.assert_close(z, (points - view.position) @ view.cam_to_world[:3, 2])
    assert rays.view.tolist() == [4] * 50


def test_the_pixel_of_a_point_is_the_one_whose_ray_meets_it() -> None:
    """Points on the rays of all pixels, their mirror images behind the camera, and points at the picture's edges."""
    view = camera()
    points = view.rays().at(torch.rand(16 * 12, dtype=F64) + 0.5)
    inside, pixel = view.pixel_of(torch.cat([points, 2 * view.position - points]))
    assert inside.tolist() == [True] * 192 + [False] * 192
    assert pixel.tolist() == [*range(192), *[0] * 192]
    centres = view.pixel_centres_of(torch.arange(192))
    assert centres[[0, 15, 16, 191]].tolist() == [[0.5, 0.5], [15.5, 0.5], [0.5, 1.5], [15.5, 11.5]]
    beside = [[e, 6.5] for e in (0.01, -0.01, 15.99, 16.01)] + [[8.5, e] for e in (0.01, -0.01, 11.99, 12.01)]
    edges = torch.tensor(beside)
    inside, pixel = view.pixel_of(view.rays(edges.double()).at(torch.ones(8, dtype=F64)))
    assert inside.tolist() == [True, False] * 4
    assert pixel.tolist() == [96, 0, 111, 0, 8, 0, 184, 0]
    inside, pixel = view.pixel_of(view.position[None])  # projected nowhere
    assert (inside.tolist(), pixel.tolist()) == ([False], [0])


def test_axes_are_right_down_forward() -> None:
    view = camera()
    x, y, z = view.cam_to_world[:3, :3].unbind(dim=1)
    middle, depth = view.project((view.position + 2 * z)[None])
    torch.testing.assert_close(middle[0], view.principal_point)
    torch.testing.assert_close(depth, torch.tensor([2.0], dtype=F64))
    right, _ = view.project((view.position + 2 * z + x)[None])
    below, _ = view.project((view.position + 2 * z + y)[None])
    torch.testing.assert_close(right[0] - middle[0], torch.tensor([10.5, 0.0], dtype=F64))
    torch.testing.assert_close(below[0] - middle[0], torch.tensor([0.0, 12.0], dtype=F64))
    _, behind = view.project((view.position - z)[None])
    assert float(behind) < 0


def test_look_at_sees_its_target_with_up_upwards() -> None:
    view = camera()
    pixels, _ = view.project(torch.tensor([[0.1, 0.2, 0.0], [0.1, 0.2, 0.3]], dtype=F64))
    torch.testing.assert_close(pixels[0], view.principal_point)
    assert pixels[1, 1] < pixels[0, 1]


def test_world_to_cam_is_the_inverse() -> None:
    view = camera()
    torch.testing.assert_close(view.world_to_cam @ view.cam_to_world, torch.eye(4, dtype=F64))


def test_resizing_scales_pixels() -> None:
    view = camera()
    small = view.resized(8, 4)
    points = view.rays().at(torch.rand(len(view.rays()), dtype=F64) + 1)
    scale = torch.tensor([8 / 16, 4 / 12], dtype=F64)
    torch.testing.assert_close(small.project(points)[0], view.project(points)[0] * scale)
    back = small.resized(16, 12)
    torch.testing.assert_close(back.focal, view.focal)
    torch.testing.assert_close(back.principal_point, view.principal_point)


def test_footprints_are_as_wide_as_pixels() -> None:
    """mip-NeRF: the radius at distance 1 is the spacing of neighbouring rays times 2 / sqrt(12)."""
    lens = torch.full((2,), 200.0, dtype=F64)
    view = Camera(torch.eye(4, dtype=F64), lens, torch.tensor([8.0, 6.0], dtype=F64), 16, 12)
    rays = view.rays()
    spacing = (rays.directions[1] - rays.directions[0]).norm()
    torch.testing.assert_close(rays.radius[0], spacing * 2 / 12**0.5, rtol=1e-2, atol=0)


def test_gradients_reach_the_pose() -> None:
    view, points = camera(), torch.randn(5, 3, dtype=F64) * 0.2

    def seen(twist: torch.Tensor) -> tuple[torch.Tensor, ...]:
        moved = view.moved(se3_exp(twist) @ view.cam_to_world)
        rays = moved.rays(points[:, :2] + 5)
        return (*moved.project(points), rays.origins, rays.directions, moved.world_to_cam)

    assert torch.autograd.gradcheck(seen, (torch.zeros(6, dtype=F64, requires_grad=True),))
    assert torch.autograd.gradcheck(seen, ((torch.randn(6, dtype=F64) * 0.1).requires_grad_(),))
