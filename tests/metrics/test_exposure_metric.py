"""PSNR with exposure fitted on one half of a photograph: invariant to it, blind to nothing else, and only for photographs."""

import math
from dataclasses import replace

import pytest
import torch

from invgraphics.core import Bounds, Camera, Rendering, Scene, View
from invgraphics.metrics.base import Inapplicable, Pair, Skip
from invgraphics.metrics.exposure import psnr_exposed
from invgraphics.metrics.image import psnr
from invgraphics.metrics.protocols import protocol_named, score, summarise


def photograph() -> torch.Tensor:
    return torch.rand(20, 32, 3, generator=torch.Generator().manual_seed(0)).double() * 0.5 + 0.2


def pair(image: torch.Tensor, truth: torch.Tensor) -> Pair:
    return Pair(image, truth, torch.ones(truth.shape[:2]))


def test_a_gain_of_each_channel_costs_nothing_and_noise_costs_what_it_is() -> None:
    truth = photograph()
    image = truth * torch.tensor([0.6, 0.9, 1.1]).double()
    assert psnr(pair(image, truth)) < 20
    assert psnr_exposed(pair(image, truth)) == 100.0
    # What is no gain is left: an offset of 0.1 is fitted as far as a factor can, and the rest counts.
    gain = (truth[:, :16] * (truth[:, :16] + 0.1)).sum(dim=(0, 1)) / (truth[:, :16] + 0.1).square().sum(dim=(0, 1))
    rest = gain * (truth[:, 16:] + 0.1) - truth[:, 16:]
    expected = -10 * math.log10(float(rest.square().mean()))
    assert psnr_exposed(pair(truth + 0.1, truth)) == pytest.approx(expected, abs=1e-6)
    # Noise on the right half is not fitted away; on the left half it is not scored, but for what it does to the map.
    noise = 0.1 * torch.sign(torch.randn(20, 16, 3, generator=torch.Generator().manual_seed(1))).double()
    right = torch.cat([truth[:, :16], truth[:, 16:] + noise], dim=1)
    assert psnr_exposed(pair(right, truth)) == pytest.approx(20.0, abs=1e-6)
    left = torch.cat([truth[:, :16] + noise, truth[:, 16:]], dim=1)
    assert 22 < psnr_exposed(pair(left, truth)) < 40


def test_a_map_that_differs_between_the_halves_is_an_error() -> None:
    truth = photograph()
    image = torch.cat([truth[:, :16] * 0.5, truth[:, 16:]], dim=1)
    # The left half asks for a factor of 2, under which the right half is too bright by its own colour, up to white.
    expected = -10 * math.log10(float(((2 * truth[:, 16:]).clamp_max(1) - truth[:, 16:]).square().mean()))
    assert psnr_exposed(pair(image, truth)) == pytest.approx(expected, abs=1e-6)


def test_masked_pixels_neither_fit_nor_count_and_black_stays_black() -> None:
    truth = photograph()
    image = truth * 0.5
    mask = torch.ones(20, 32, dtype=torch.bool)
    mask[:, ::4] = False
    broken = torch.where(mask[..., None], image, torch.zeros(()).double())
    assert psnr_exposed(replace(pair(broken, truth), mask=mask)) == 100.0
    few = torch.zeros_like(mask)
    few[:3] = True
    with pytest.raises(Skip, match="fewer than 64 pixels"):
        psnr_exposed(replace(pair(image, truth), mask=few))
    expected = -10 * math.log10(float(truth[:, 16:].square().mean()))
    assert psnr_exposed(pair(torch.zeros_like(truth), truth)) == pytest.approx(expected, abs=1e-6)


def test_it_is_for_photographs_only() -> None:
    with pytest.raises(Inapplicable):
        psnr_exposed(replace(pair(photograph(), photograph()), true_depth=torch.ones(20, 32)))
    camera = Camera(torch.eye(4), torch.tensor([20.0, 20.0]), torch.tensor([16.0, 10.0]), 32, 20)
    photo = View(camera, photograph().float(), "photo")
    scene = Scene("s", (photo,), (photo,), torch.zeros(3), Bounds(-torch.ones(3), torch.ones(3), "contracted"))
    prediction = Rendering(photo.image * 0.5, torch.ones(20, 32), torch.ones(20, 32))
    rules = protocol_named("float")
    for view, known in ((photo, True), (replace(photo, alpha=torch.ones(20, 32)), False)):
        quality, skipped = summarise([score(prediction, view, scene, rules, only=("psnr", "psnr_exposed"))], rules)
        assert ("psnr_exposed" in quality) is known
        assert "psnr_exposed" not in skipped
