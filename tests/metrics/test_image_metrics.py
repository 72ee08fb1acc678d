"""PSNR, SSIM, MS-SSIM, FLIP and LPIPS against formulas written independently of the libraries used."""

import math
import sys
import types

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from invgraphics.metrics import image, perceptual
from invgraphics.metrics.base import Pair, Skip


def pair_of(predicted: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> Pair:
    height, width = truth.shape[:2]
    return Pair(
        image=torch.as_tensor(predicted, dtype=torch.float32),
        truth=torch.as_tensor(truth, dtype=torch.float32),
        pred_alpha=torch.ones(height, width),
        mask=None if mask is None else torch.as_tensor(mask),
    )


@pytest.fixture
def noisy() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    truth = gaussian_filter(rng.random((48, 40, 3)), (2, 2, 0))
    truth = (truth - truth.min()) / (truth.max() - truth.min())
    return np.clip(truth + 0.1 * rng.standard_normal(truth.shape), 0, 1), truth


def ssim_by_hand(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Wang et al. 2004, equation 13, with windows wholly inside the image; one map per channel."""
    maps = []
    for channel in range(3):
        x, y = a[..., channel], b[..., channel]

        def blur(values: np.ndarray) -> np.ndarray:
            return gaussian_filter(values, 1.5, radius=5)

        mu_x, mu_y = blur(x), blur(y)
        var_x, var_y, cov = blur(x * x) - mu_x**2, blur(y * y) - mu_y**2, blur(x * y) - mu_x * mu_y
        top = (2 * mu_x * mu_y + 0.01**2) * (2 * cov + 0.03**2)
        maps.append(top / ((mu_x**2 + mu_y**2 + 0.01**2) * (var_x + var_y + 0.03**2)))
    return np.stack(maps, axis=-1)[5:-5, 5:-5]


def test_psnr_of_a_constant_error() -> None:
    truth = np.full((12, 9, 3), 0.5)
    assert image.psnr(pair_of(truth + 0.1, truth)) == pytest.approx(20.0, abs=1e-5)


def test_psnr_is_that_of_the_squared_differences(noisy) -> None:
    predicted, truth = noisy
    expected = 20 * math.log10(1 / math.sqrt(np.mean((predicted - truth) ** 2)))
    assert image.psnr(pair_of(predicted, truth)) == pytest.approx(expected, abs=1e-4)


def test_psnr_of_identical_images_is_finite(noisy) -> None:
    assert image.psnr(pair_of(noisy[1], noisy[1])) == image.PSNR_CAP == 100


def test_psnr_ignores_masked_pixels(noisy) -> None:
    predicted, truth = (values.copy() for values in noisy)
    mask = np.zeros(truth.shape[:2], bool)
    mask[10:30, 5:20] = True
    expected = -10 * math.log10(np.mean((predicted[mask] - truth[mask]) ** 2))
    assert image.psnr(pair_of(predicted, truth, mask)) == pytest.approx(expected, abs=1e-4)
    with pytest.raises(Skip, match="mask leaves no pixel"):
        image.psnr(pair_of(predicted, truth, np.zeros_like(mask)))


def test_ssim_by_an_independent_formula(noisy) -> None:
    predicted, truth = noisy
    assert image.ssim(pair_of(predicted, truth)) == pytest.approx(ssim_by_hand(predicted, truth).mean(), abs=1e-6)
    assert image.ssim(pair_of(truth, truth)) == pytest.approx(1.0, abs=1e-9)


def test_ssim_within_a_mask(noisy) -> None:
    predicted, truth = noisy
    mask = np.zeros(truth.shape[:2], bool)
    mask[:20, 12:] = True
    expected = ssim_by_hand(predicted, truth)[mask[5:-5, 5:-5]].mean()
    assert image.ssim(pair_of(predicted, truth, mask)) == pytest.approx(expected, abs=1e-6)


def test_ssim_needs_a_whole_window() -> None:
    with pytest.raises(Skip, match="11 x 11"):
        image.ssim(pair_of(np.zeros((10, 30, 3)), np.zeros((10, 30, 3))))


def test_ms_ssim_is_skipped_below_its_five_scales() -> None:
    with pytest.raises(Skip, match="161 pixels along the shorter side, the images are 200x160"):
        image.ms_ssim(pair_of(np.zeros((160, 200, 3)), np.zeros((160, 200, 3))))


def test_ms_ssim_of_a_flat_brightness_error_is_its_luminance_term() -> None:
    # Contrast and structure are perfect, so that only the coarsest scale's luminance term is left (Wang et al. 2003, eq. 7).
    # Sides divisible by 16, because average pooling pads odd ones with zeros.
    truth, predicted = np.full((176, 192, 3), 0.4), np.full((176, 192, 3), 0.6)
    luminance = (2 * 0.4 * 0.6 + 0.01**2) / (0.4**2 + 0.6**2 + 0.01**2)
    assert image.ms_ssim(pair_of(predicted, truth)) == pytest.approx(luminance**0.1333, abs=1e-5)


def test_ms_ssim_refuses_masks() -> None:
    mask = np.ones((161, 161), bool)
    flat = np.full((161, 161, 3), 0.5)
    assert image.ms_ssim(pair_of(flat, flat, mask)) == pytest.approx(1.0)
    mask[0, 0] = False
    with pytest.raises(Skip, match="mask"):
        image.ms_ssim(pair_of(flat, flat, mask))


def test_flip_spans_its_range(noisy) -> None:
    black, white = np.zeros((20, 24, 3)), np.ones((20, 24, 3))
    assert perceptual.flip(pair_of(noisy[1], noisy[1])) == 0
    assert perceptual.flip(pair_of(black, white)) > 0.9
    errors = perceptual.flip_map(torch.as_tensor(noisy[0]), torch.as_tensor(noisy[1]))
    assert errors.shape == noisy[1].shape[:2]
    assert 0 < perceptual.flip(pair_of(*noisy)) == pytest.approx(float(errors.mean()), abs=1e-6)


def test_flip_within_a_mask() -> None:
    truth = np.zeros((60, 60, 3))
    predicted = truth.copy()
    predicted[:, 30:] = 1.0
    mask = np.zeros((60, 60), bool)
    mask[:, :10] = True
    assert perceptual.flip(pair_of(predicted, truth, mask)) < 0.01
    assert perceptual.flip(pair_of(predicted, truth, ~mask)) > 0.5


def test_lpips_says_what_is_missing(monkeypatch, tmp_path) -> None:
    pair = pair_of(np.zeros((40, 40, 3)), np.zeros((40, 40, 3)))
    monkeypatch.setattr(perceptual.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(Skip, match=r"package lpips is not installed \(pip install"):
        perceptual.lpips(pair)
    monkeypatch.setattr(perceptual.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(Skip, match="never downloads"):
        perceptual.lpips(pair)


def test_lpips_is_asked_the_right_question(monkeypatch, tmp_path) -> None:
    """A stand-in network, since the real weights may not be fetched: it records how it is called."""
    asked = {}

    class Network(torch.nn.Module):
        def __init__(self, **settings) -> None:
            super().__init__()
            asked["settings"] = settings

        def forward(self, a, b, normalize):
            asked["call"] = (tuple(a.shape), normalize)
            return (a - b).abs().mean()

    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / perceptual.ALEXNET_FILE).write_bytes(b"weights")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(perceptual.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "lpips", types.SimpleNamespace(LPIPS=Network))
    perceptual._lpips_network.cache_clear()
    try:
        value = perceptual.lpips(pair_of(np.full((40, 50, 3), 0.75), np.full((40, 50, 3), 0.25)))
    finally:
        perceptual._lpips_network.cache_clear()
    assert value == pytest.approx(0.5)
    assert asked == {"settings": {"net": "alex", "version": "0.1", "verbose": False}, "call": ((1, 3, 40, 50), True)}
