"""The vectorised walk through an occupancy grid, against a plain loop."""

import math

import pytest
import torch

from invgraphics.core import Bounds, Rays
from invgraphics.kernels import reference
from invgraphics.kernels.types import March, MarchSteps

F64 = torch.float64


def setting(space: str) -> tuple[Rays, torch.Tensor, Bounds]:
    """Rays from inside and outside a box that is neither centred nor a cube, and a random grid."""
    bounds = Bounds(torch.tensor([-1.0, -0.5, 0.0], dtype=F64), torch.tensor([1.0, 1.0, 0.8], dtype=F64), space, near=0.1)
    origins = torch.randn(40, 3, dtype=F64)
    directions = torch.nn.functional.normalize(0.3 * torch.randn(40, 3, dtype=F64) - origins, dim=1)
    rays = bounds.clip(Rays.make(origins, directions))
    if space == "contracted":
        rays = rays.within(rays.near, rays.far.clamp_max(6.0))
    return rays, torch.rand(6, 6, 6) < 0.3, bounds


def walk(rays: Rays, occupied: torch.Tensor, bounds: Bounds, steps: MarchSteps) -> list[tuple[int, float, float]]:
    """Every kept interval, one ray and one step at a time."""
    kept = []
    for r in range(len(rays)):
        t, far = float(rays.near[r]), float(rays.far[r])
        while t < far:
            end = min(t + max(steps.step, steps.cone * t), far)
            unit = bounds.to_unit(rays.origins[r] + (t + end) / 2 * rays.directions[r]).tolist()
            cell = [math.floor(u * occupied.shape[0]) for u in unit]
            if all(0 <= u <= 1 for u in unit) and bool(occupied[tuple(min(c, occupied.shape[0] - 1) for c in cell)]):
                kept.append((r, t, end))
            t = end
    return kept


def listed(march: March) -> list[tuple[int, float, float]]:
    return list(zip(march.ray.tolist(), march.t0.tolist(), march.t1.tolist(), strict=True))


@pytest.mark.parametrize("space", ["box", "contracted"])
@pytest.mark.parametrize("cone", [0.0, 0.1])
def test_equals_a_loop(space: str, cone: float) -> None:
    rays, occupied, bounds = setting(space)
    steps = MarchSteps(0.03, cone, limit=10_000)
    march = reference.ray_march(rays, occupied, bounds, steps, rays.near)
    expected = walk(rays, occupied, bounds, steps)
    assert len(expected) > 50
    assert listed(march) == [(r, pytest.approx(a), pytest.approx(b)) for r, a, b in expected]
    assert bool((march.resume >= rays.far).all())


def test_pieces_join_to_the_whole() -> None:
    rays, occupied, bounds = setting("box")
    whole = listed(reference.ray_march(rays, occupied, bounds, MarchSteps(0.02, limit=10_000), rays.near))
    pieces, start = [], rays.near
    for _ in range(100):
        march = reference.ray_march(rays, occupied, bounds, MarchSteps(0.02, limit=3), start)
        assert int(torch.bincount(march.ray, minlength=len(rays)).max()) <= 3
        pieces += listed(march)
        start = march.resume
    assert bool((start >= rays.far).all())
    # Each piece counts its lattice from where it starts, so the last bits may differ.
    torch.testing.assert_close(torch.tensor(sorted(pieces)), torch.tensor(whole))


def test_a_full_box_is_tiled() -> None:
    rays, occupied, bounds = setting("box")
    march = reference.ray_march(rays, torch.ones_like(occupied), bounds, MarchSteps(0.05, limit=10_000), rays.near)
    length = torch.zeros(len(rays), dtype=F64).index_add(0, march.ray, march.t1 - march.t0)
    torch.testing.assert_close(length, rays.far - rays.near)


def test_nothing_to_march() -> None:
    rays, occupied, bounds = setting("box")
    march = reference.ray_march(rays, occupied, bounds, MarchSteps(0.05), rays.far)
    assert len(march.ray) == 0
    torch.testing.assert_close(march.resume, rays.far)
