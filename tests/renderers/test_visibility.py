"""Cells that cameras see, against rays through their pictures."""

from collections.abc import Callable

import torch

from invgraphics.core import Bounds, Camera, Scene
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.visibility import visible_cells


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
