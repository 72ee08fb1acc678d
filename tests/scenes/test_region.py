"""The region that known points suggest, against points and cameras whose distances are known."""

import math

import pytest
import torch

from invgraphics.core import Points
from invgraphics.core.transforms import look_at
from invgraphics.scenes.open import space_note
from invgraphics.scenes.region import CLEARANCE, MARGIN, NEAR, contracted_frame, near_plane, subject_half
from invgraphics.testing import toy_scene

F64 = torch.float64


def ball(radius: float, count: int = 400) -> torch.Tensor:
    return radius * torch.nn.functional.normalize(torch.randn(count, 3, dtype=F64), dim=1)


def ring(distance: float, count: int = 8) -> torch.Tensor:
    """Cameras around the origin that look at it."""
    angles = [2 * math.pi * k / count for k in range(count)]
    eyes = [torch.tensor([distance * math.cos(a), distance * math.sin(a), 0.0], dtype=F64) for a in angles]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    return torch.stack([look_at(eye, torch.zeros(3, dtype=F64), up) for eye in eyes])


def test_box_holds_the_subject_but_not_its_surroundings() -> None:
    points = torch.cat([ball(0.2), ball(5.0, 80)])
    assert subject_half(points) == pytest.approx(MARGIN * 0.2)
    assert subject_half(ball(5.0)) == 1.0
    assert subject_half(points[:3]) == 1.0


def test_dense_scans_have_a_frame_too() -> None:
    """More points than torch's quantile takes, 2^24."""
    points = torch.randn(2**24 + 1, 3)
    assert subject_half(0.1 * points) == pytest.approx(
        MARGIN * 0.1 * math.sqrt(4.108), rel=1e-3
    )  # chi-squared of 3, quantile 3/4
    assert near_plane(ring(9.0, 1).float(), 1e-3 * points) == pytest.approx(CLEARANCE * 9.0, rel=1e-3)


def test_near_plane_is_half_way_to_the_nearest_points() -> None:
    points = torch.cat([ball(0.2, 4000), torch.tensor([[2.99, 0.0, 0.0]], dtype=F64)])
    near = near_plane(ring(3.0), points)
    assert near == pytest.approx(CLEARANCE * 2.8, rel=0.02)  # one wrong point right in front of a camera changes nothing
    assert near_plane(ring(3.0), points[:2]) is None


def test_frame_measures_in_its_own_units() -> None:
    points = Points(ball(0.5, 2000).float(), torch.zeros(2000, 3))
    bounds = contracted_frame(ring(4.0), points).bounds
    torch.testing.assert_close(bounds.hi, torch.full((3,), MARGIN * 0.5 / 4))
    assert bounds.near == pytest.approx(CLEARANCE * 3.5 / 4, rel=0.02)
    plain = contracted_frame(ring(4.0)).bounds
    assert (plain.near, float(plain.hi[0])) == (NEAR, 1.0)


def test_a_tripod_may_stand_anywhere() -> None:
    """The mean of equal positions differs from them by rounding, which is no distance between cameras."""
    poses = ring(1.0, count=7)
    poses[:, :3, 3] = torch.tensor([0.1, 1.7, 2.3], dtype=F64)
    assert bool((poses[:, :3, 3] != poses[:, :3, 3].mean(dim=0)).any())
    frame = contracted_frame(poses)
    assert frame.scale == pytest.approx(1.0)


def test_the_choice_of_bounds_is_described() -> None:
    assert space_note(toy_scene(views=2, size=4)) == ""
    note = space_note(toy_scene(views=2, size=4, space="contracted"))
    assert "half-edge 1 (from three quarters of 400 known points)" in note
    assert "nearer than 0.05 to a camera" in note
