"""Cells that cameras see, against rays through their pictures."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import pytest
import torch

from invgraphics.core import Bounds, Camera, Context, Scene
from invgraphics.core.scene import Points
from invgraphics.fields.analytic import Sphere
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.visibility import cells_in_ball, cells_near_points, visible_cells


def cell_of(bounds: Bounds, position: torch.Tensor, resolution: int) -> tuple[torch.Tensor, ...]:
    return (bounds.to_unit(position) * resolution).long().clamp(0, resolution - 1).unbind(dim=-1)


def test_what_pixels_look_at_is_visible_and_what_is_behind_them_is_not(make_camera: Callable[..., Camera]) -> None:
    bounds = Bounds(torch.full((3,), -0.5), torch.full((3,), 0.5), "contracted", near=1.0)
    camera = make_camera().to(torch.float32)
    seen = visible_cells(bounds, 32, [camera])
    rays = camera.rays()
    for t in (1.5, 2.0, 3.0, 5.0, 50.0):
        assert bool(seen[cell_of(bounds, rays.at(torch.full((len(rays),), t)), 32)].all()), t
    for t in (-5.0, -50.0):
        assert not bool(seen[cell_of(bounds, rays.at(torch.full((len(rays),), t)), 32)].any()), t
    assert 0.05 < float(seen.float().mean()) < 0.5


def test_nothing_is_occupied_where_no_camera_looks(make_scene: Callable[..., Scene]) -> None:
    config = OccupancyConfig(resolution=16)
    endless, box = config.build(make_scene("contracted")), config.build(make_scene("box"))
    assert bool(box.occupied.all())
    assert 0.02 < float(endless.occupied.float().mean()) < 0.9
    assert set(endless.state_dict()) == set(box.state_dict())


@pytest.mark.parametrize("space", ["box", "contracted"])
def test_cells_near_points_are_those_a_search_of_all_pairs_finds(space: Literal["box", "contracted"]) -> None:
    bounds = Bounds(torch.full((3,), -0.5), torch.full((3,), 0.5), space)
    points = torch.cat([0.6 * torch.rand(6, 3) - 0.3, torch.tensor([[9.0, 0.0, 0.0]])])  # the last is outside the box
    near = cells_near_points(bounds, 12, points, 2)
    cells = (bounds.to_unit(points) * 12).floor()
    centres = torch.cartesian_prod(*[torch.arange(12.0)] * 3)
    inside = ((cells >= 0) & (cells < 12)).all(dim=1)
    expected = ((centres[:, None] - cells[inside]).abs().amax(dim=2) <= 2).any(dim=1)
    assert torch.equal(near.flatten(), expected)
    assert int(inside.sum()) == (7 if space == "contracted" else 6)


def test_only_cells_near_points_are_sampled_until_others_have_proved_dense(make_scene: Callable[..., Scene]) -> None:
    """A second look at a seeded grid: fog everywhere brings every cell back, but not before ``points_until``."""
    scene = replace(make_scene("box"), points=Points(torch.zeros(1, 3), torch.zeros(1, 3)))
    sampler = OccupancyConfig(resolution=8, points_until=0.1, point_cells=1).build(scene)
    near = cells_near_points(scene.bounds, 8, torch.zeros(1, 3), 1)
    assert torch.equal(sampler.occupied, near) and 0 < int(near.sum()) < 512
    field = Sphere(0.1, 100.0)  # fog
    sampler.update(field, Context(scene.bounds, progress=0.05, training=True))
    assert torch.equal(sampler.occupied, near)
    sampler.step.fill_(sampler.config.every)
    sampler.update(field, Context(scene.bounds, progress=0.2, training=True))
    assert bool(sampler.occupied.all())
    assert bool(OccupancyConfig(resolution=8, points_until=0.1).build(make_scene("box")).occupied.all())  # without points


def test_cells_of_the_ball_are_those_that_random_points_find() -> None:
    points = torch.randn(1_000_000, 3)
    points = 0.5 + 0.5 * torch.rand(len(points), 1) ** (1 / 3) * points / points.norm(dim=1, keepdim=True)
    found = torch.zeros(12, 12, 12, dtype=torch.bool)
    found[(points * 12).long().clamp(0, 11).unbind(dim=1)] = True
    within = cells_in_ball(12)
    assert bool((within | ~found).all())  # none that a point lies in is missing
    assert int((within & ~found).sum()) < 0.04 * int(found.sum())  # corners that it only touches
    assert float(within.float().mean()) < 0.75 and bool(within[6, 6, 6]) and not bool(within[0, 0, 0])


def test_a_refresh_looks_only_where_rays_can_go(make_scene: Callable[..., Scene]) -> None:
    scene, places = make_scene("contracted"), []

    class Noted(Sphere):
        def query(self, samples, want):
            places.append(samples.position)
            return super().query(samples, want)

    for warmup in (1, 10**6):
        sampler = OccupancyConfig(resolution=16, grace=0, warmup=warmup, every=1, cells=2000).build(scene)
        places.clear()
        for _ in range(3):
            sampler.update(Noted(40.0, 0.6), Context(scene.bounds, training=True))
        cell = (scene.bounds.to_unit(torch.cat(places)) * 16).long().clamp(0, 15)
        assert sampler.visible is not None and float(sampler.visible.float().mean()) < 0.7
        assert bool((cells_in_ball(16) | ~sampler.visible).all())
        near_visible = torch.nn.functional.max_pool3d(sampler.visible[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0
        assert bool(near_visible[cell.unbind(dim=1)].all())  # points beyond the rim are pulled onto it
