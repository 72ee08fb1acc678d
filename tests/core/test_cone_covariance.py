"""Mean and covariance of a sample's cone frustum, against Monte Carlo."""

import torch

from invgraphics.core import Rays, Samples

F64 = torch.float64


def test_equals_that_of_random_points_in_the_frustum() -> None:
    direction = torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, 0.8]], dtype=F64), dim=1)
    rays = Rays.make(torch.zeros(1, 3, dtype=F64), direction, radius=0.2)
    index, t0, t1 = torch.zeros(1, dtype=torch.int64), torch.tensor([0.7], dtype=F64), torch.tensor([1.9], dtype=F64)
    samples = Samples.on(rays, index, t0, t1)
    # Volume grows with t², so t is the cube root of a uniform number; the disc at t has radius 0.2 t.
    count = 400_000
    t = (t0**3 + torch.rand(count, dtype=F64) * (t1**3 - t0**3)) ** (1 / 3)
    angle, r = 2 * torch.pi * torch.rand(count, dtype=F64), 0.2 * t * torch.rand(count, dtype=F64).sqrt()
    side = torch.nn.functional.normalize(torch.linalg.cross(direction[0], torch.tensor([1.0, 0, 0], dtype=F64)), dim=0)
    other = torch.linalg.cross(direction[0], side)
    points = t[:, None] * direction + (r * angle.cos())[:, None] * side + (r * angle.sin())[:, None] * other
    torch.testing.assert_close(torch.cov(points.T), samples.covariance[0], atol=1e-4, rtol=5e-3)
    torch.testing.assert_close(points.mean(dim=0), samples.cone_mean[0], atol=2e-3, rtol=0)
    # Which is not the middle of the interval: that is 0.13 nearer.
    assert float((samples.cone_mean - samples.position).norm()) > 0.1


def test_a_lone_point_has_none() -> None:
    lone = Samples.at(torch.randn(3, 3))
    assert not lone.covariance.any()
    assert torch.equal(lone.cone_mean, lone.position)
