"""The packed emission-absorption sum, against a loop over rays and finite differences."""

import math

import pytest
import torch

from invgraphics.kernels import reference

F64 = torch.float64


def packed(rays: int = 7, most: int = 9) -> torch.Tensor:
    """Ray indices with some rays empty, among them the first and the last."""
    counts = torch.randint(0, most, (rays,))
    counts[0] = counts[-1] = 0
    return torch.repeat_interleave(torch.arange(rays), counts)


def test_equals_a_loop() -> None:
    ray = packed()
    tau, channels = torch.rand(len(ray), dtype=F64) * 2, torch.randn(len(ray), 3, dtype=F64)
    weights, sums, alpha = reference.composite(tau, channels, ray, 7)
    for r in range(7):
        light, colour, seen = 1.0, torch.zeros(3, dtype=F64), 0.0
        for i in torch.nonzero(ray == r)[:, 0].tolist():
            w = light * (1 - math.exp(-float(tau[i])))
            assert float(weights[i]) == pytest.approx(w, abs=1e-12)
            colour, seen, light = colour + w * channels[i], seen + w, light * math.exp(-float(tau[i]))
        torch.testing.assert_close(sums[r], colour)
        assert float(alpha[r]) == pytest.approx(seen, abs=1e-12)
        assert float(alpha[r]) == pytest.approx(1 - light, abs=1e-12)


def test_gradients() -> None:
    ray = packed()
    tau = torch.rand(len(ray), dtype=F64).requires_grad_()
    channels = torch.randn(len(ray), 2, dtype=F64).requires_grad_()
    assert torch.autograd.gradcheck(lambda t, c: reference.composite(t, c, ray, 7), (tau, channels))


def test_interval_ends_carry_gradients() -> None:
    ray = packed()
    t0 = torch.rand(len(ray), dtype=F64).requires_grad_()
    t1 = (t0.detach() + torch.rand(len(ray), dtype=F64)).requires_grad_()

    def depth(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return reference.composite(1.7 * (b - a), ((a + b) / 2)[:, None], ray, 7)[1]

    assert torch.autograd.gradcheck(depth, (t0, t1))


def test_late_rays_keep_their_digits() -> None:
    """A million samples of float32: the last ray must not suffer from the sum of all before it."""
    tau = torch.full((1_000_000,), 30.0)
    tau[-4:] = torch.tensor([0.1, 0.2, 0.3, 0.4])
    ray = torch.arange(1_000_000) // 4
    weights, _, _ = reference.composite(tau, tau[:, None], ray, 250_000)
    alone, _, _ = reference.composite(tau[-4:].double(), tau[-4:, None].double(), torch.zeros(4, dtype=torch.int64), 1)
    torch.testing.assert_close(weights[-4:].double(), alone, rtol=1e-6, atol=0)


def test_infinite_density_blocks_its_own_ray_only() -> None:
    tau = torch.tensor([0.5, torch.inf, 0.5, 0.5])
    weights, _, alpha = reference.composite(tau, tau[:, None].clamp_max(1), torch.tensor([0, 0, 0, 1]), 2)
    a = 1 - math.exp(-0.5)
    torch.testing.assert_close(weights, torch.tensor([a, 1 - a, 0.0, a]))
    torch.testing.assert_close(alpha, torch.tensor([1.0, a]))


def test_no_samples() -> None:
    weights, sums, alpha = reference.composite(torch.zeros(0), torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), 5)
    assert weights.shape == (0,)
    assert sums.shape == (5, 3)
    assert not alpha.any()
