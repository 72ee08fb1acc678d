"""Pictures in front of a background, against the formula and finite differences."""

from __future__ import annotations

import pytest
import torch
from torch.autograd import gradcheck

from invgraphics.core.compositing import over, straight_over

SHAPES = [(5,), (3, 4), (0,), (2, 3, 4)]


@pytest.mark.parametrize("shape", SHAPES)
def test_premultiplied_colour(shape: tuple[int, ...]) -> None:
    rgb, alpha, background = torch.rand(*shape, 3), torch.rand(shape), torch.rand(3)
    expected = rgb + (1 - alpha[..., None]) * background
    torch.testing.assert_close(over(rgb, alpha, background), expected)
    each = torch.rand(*shape, 3)
    torch.testing.assert_close(over(rgb, alpha, each), rgb + (1 - alpha[..., None]) * each)
    turned = rgb.transpose(0, -1).contiguous().transpose(0, -1)
    torch.testing.assert_close(over(turned, alpha, background), expected)


def test_gradients() -> None:
    rgb, alpha = (torch.rand(shape, dtype=torch.float64, requires_grad=True) for shape in ((2, 3, 3), (2, 3)))
    background = torch.rand(3, dtype=torch.float64)
    assert gradcheck(lambda *x: over(*x, background), (rgb, alpha))
    assert gradcheck(over, (rgb, alpha, background.clone().requires_grad_()))


def test_a_background_of_another_precision() -> None:
    rgb, alpha, background = torch.rand(4, 3).double(), torch.rand(4).double(), torch.rand(3)
    assert over(rgb, alpha, background).dtype == torch.float64


@pytest.mark.parametrize("shape", SHAPES)
def test_straight_colour(shape: tuple[int, ...]) -> None:
    colour, alpha, background = torch.rand(*shape, 3), torch.rand(shape), torch.rand(3)
    before = colour.clone()
    expected = alpha[..., None] * colour + (1 - alpha[..., None]) * background
    torch.testing.assert_close(straight_over(colour, alpha, background), expected)
    assert torch.equal(colour, before)
    assert torch.equal(straight_over(colour, torch.ones(shape), background), colour)
    assert torch.equal(straight_over(colour, torch.zeros(shape), background), background.expand(*shape, 3))
