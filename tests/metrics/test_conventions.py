"""Each tool's convention against an independent implementation of it, from straight pixels to the mean over views."""

import math
import sys
import types

import numpy as np
import pytest
import pytorch_msssim
import torch
import torchmetrics
from scipy.ndimage import gaussian_filter
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch.nn.functional import pad

from invgraphics.core import Bounds, Camera, Rendering, Scene, View
from invgraphics.core.colour import linear_to_srgb
from invgraphics.metrics import perceptual, protocols
from invgraphics.metrics.base import Pair, Skip
from invgraphics.metrics.conventions import NGP_KERNEL, PROTOCOLS, VISER_GREY, Lpips, Measure, Psnr, Ssim
from invgraphics.metrics.protocols import prepare, score, summarise

HEIGHT, WIDTH, VIEWS = 40, 52, 3

OTHERS = {name: protocol for name, protocol in PROTOCOLS.items() if protocol.source}
SCENE_GREY = (0.3, 0.5, 0.9)
"""The toy data set's own background: neither of those that tools assume."""


def smooth(rng: np.random.Generator, channels: int) -> np.ndarray:
    values = gaussian_filter(rng.random((HEIGHT, WIDTH, channels)), (2, 2, 0))
    return (values - values.min()) / (values.max() - values.min())


def pictures() -> list[tuple[np.ndarray, ...]]:
    """Per view: premultiplied prediction, its alpha, true bytes, true alpha bytes. Colours span less than the whole range."""
    rng, views = np.random.default_rng(11), []
    for _ in range(VIEWS):
        truth = (0.15 + 0.6 * smooth(rng, 3)) * [1, 0.8, 0.5]
        alpha = np.clip(1.6 * smooth(rng, 1) - 0.2, 0, 1)[..., 0]
        image = np.clip(truth + 0.12 * rng.standard_normal(truth.shape) * [1, 0.6, 0.2], 0, 1)
        coverage = np.clip(alpha + 0.05 * rng.standard_normal(alpha.shape), 0, 1)
        bytes_of = [(values * 255).round().astype(np.uint8) for values in (truth, alpha)]
        views.append((image * coverage[..., None], coverage, *bytes_of))
    return views


SET = pictures()


def scene(colour: str = "srgb", background: tuple = SCENE_GREY) -> Scene:
    return Scene("toy", (), (), torch.tensor(background), Bounds(-torch.ones(3), torch.ones(3)), colour=colour)


def view_of(index: int, **more) -> tuple[Rendering, View]:
    rgb, coverage, truth, alpha = (torch.from_numpy(values) for values in SET[index])
    camera = Camera(torch.eye(4), torch.ones(2), torch.ones(2), WIDTH, HEIGHT)
    rendering = Rendering(rgb.float(), coverage.float(), torch.full_like(coverage, torch.inf).float())
    return rendering, View(camera, truth, str(index), **{"alpha": alpha} | more)


def shown(*case) -> tuple[torch.Tensor, torch.Tensor]:
    """Prediction and truth as a tool compares them."""
    pair = prepare(*case)
    return pair.image, pair.truth


def measure(how: Measure, image: torch.Tensor, truth: torch.Tensor) -> float:
    return protocols.measure(how, Pair(image, truth, torch.ones(truth.shape[:2])))


def scored(name: str) -> dict[str, float]:
    scores = [score(*view_of(index), scene(), PROTOCOLS[name]) for index in range(VIEWS)]
    quality, _ = summarise(scores, PROTOCOLS[name])
    return {metric: entry.mean for metric, entry in quality.items()}


def composited(background: tuple, dtype: type = np.float64, opaque: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
    """Unrounded prediction and truth over a colour, the truth with the tool's precision; or, ``opaque``, without its alpha."""
    result = []
    for rgb, coverage, truth, alpha in SET:
        behind, opacity = np.asarray(background, dtype), alpha[..., None].astype(dtype) / dtype(255)
        true_colour = truth.astype(dtype) / dtype(255) * opacity + (1 - opacity) * behind
        true_colour = truth / 255 if opaque else true_colour
        result.append((rgb + (1 - coverage[..., None]) * np.asarray(background), true_colour))
    return result


def near(values: np.ndarray) -> np.ndarray:
    return np.clip(values * 255, 0, 255).round() / 255


def down(values: np.ndarray) -> np.ndarray:
    return (values * values.dtype.type(255)).clip(0, 255).astype(np.uint8) / 255


def planes(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.transpose(2, 0, 1)[None].copy())


def skimage_psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return peak_signal_noise_ratio(truth, image, data_range=1)


def skimage_ssim(image: np.ndarray, truth: np.ndarray) -> float:
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1, "channel_axis": -1}
    return structural_similarity(truth, image, **settings)


def msssim_ssim(image: np.ndarray, truth: np.ndarray) -> float:
    return float(pytorch_msssim.SSIM(data_range=1.0, size_average=True, channel=3)(planes(image), planes(truth)))


def zero_padded_ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Windows everywhere, zeros beyond the edge: those inside of a picture with a black frame of the window's radius."""
    framed = [pad(planes(values), (5, 5, 5, 5)) for values in (image, truth)]
    return float(pytorch_msssim.ssim(*framed, data_range=1.0))


def torchmetrics_psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(torchmetrics.image.PeakSignalNoiseRatio(data_range=1.0)(planes(image), planes(truth)))


def torchmetrics_ssim(image: np.ndarray, truth: np.ndarray) -> float:
    return float(torchmetrics.image.StructuralSimilarityIndexMeasure(data_range=1.0)(planes(image), planes(truth)))


def torchmetrics_rangeless_ssim(image: np.ndarray, truth: np.ndarray) -> float:
    return float(torchmetrics.functional.structural_similarity_index_measure(planes(truth), planes(image)))


def apart_psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(np.mean([skimage_psnr(image[..., c], truth[..., c]) for c in range(3)]))


def luma_ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Every 5 x 5 window of the mirrored luma pictures, one by one."""
    window = np.outer(NGP_KERNEL, NGP_KERNEL)
    sums = []
    x, y = (
        np.lib.stride_tricks.sliding_window_view(np.pad(np.dot(values, (0.2126, 0.7152, 0.0722)), 2, "symmetric"), (5, 5))
        for values in (image, truth)
    )
    for a, b in ((x, 1), (y, 1), (x, x), (y, y), (x, y)):
        sums.append((a * b * window).sum(axis=(2, 3)))
    mx, my, xx, yy, xy = sums
    structure = (2 * (xy - mx * my) + 0.03**2) / (xx - mx**2 + yy - my**2 + 0.03**2)
    return float(((2 * mx * my + 0.01**2) / (mx**2 + my**2 + 0.01**2) * structure).mean())


ROUTES = {
    "nerfbaselines": (SCENE_GREY, down, down, {"psnr": skimage_psnr, "ssim": skimage_ssim}),
    "3dgs-metrics": ((0, 0, 0), near, down, {"psnr": torchmetrics_psnr, "ssim": zero_padded_ssim}),
    "3dgs-metrics-white": ((1, 1, 1), near, down, {"psnr": torchmetrics_psnr, "ssim": zero_padded_ssim}),
    "3dgs-train": ((0, 0, 0), None, down, {"psnr": apart_psnr}),
    "multinerf": ((1, 1, 1), near, None, {"psnr": skimage_psnr, "ssim": skimage_ssim}),
    "nerf-pytorch": ((1, 1, 1), None, None, {"psnr": torchmetrics_psnr}),
    "nerfstudio-nerf": (SCENE_GREY, None, None, {"psnr": torchmetrics_psnr, "ssim": torchmetrics_rangeless_ssim}),
    "nerfstudio-splatfacto": (VISER_GREY, None, None, {"psnr": torchmetrics_psnr, "ssim": msssim_ssim}),
    "instant-ngp": ((0, 0, 0), None, None, {"psnr": skimage_psnr, "ssim": luma_ssim}),
    "gsplat": ((0, 0, 0), None, None, {"psnr": torchmetrics_psnr, "ssim": torchmetrics_ssim}),
}


@pytest.mark.parametrize("name", ROUTES)
def test_a_convention_is_that_of_an_independent_implementation(name: str) -> None:
    background, of_image, of_truth, metrics = ROUTES[name]
    pairs = [
        (of_image(image) if of_image else image, of_truth(truth) if of_truth else truth)
        for image, truth in composited(background, np.float32 if name == "nerfbaselines" else np.float64, name == "gsplat")
    ]
    got = scored(name)
    for metric, function in metrics.items():
        assert got[metric] == pytest.approx(np.mean([function(*pair) for pair in pairs]), abs=1e-4), metric


def test_every_convention_has_an_independent_route_and_a_source() -> None:
    assert set(ROUTES) == set(OTHERS)
    for name, convention in OTHERS.items():
        assert "@" in convention.source and ".py" in convention.source, name
        assert set(convention.measures) - {"lpips", "lpips_vgg", "psnr_of_mean_mse"} == set(ROUTES[name][3]), name


def test_conventions_alone_spread_the_scores_of_one_set_of_pictures() -> None:
    tables = {name: scored(name) for name in OTHERS}
    psnr = [table["psnr"] for table in tables.values()]
    ssim = [table["ssim"] for table in tables.values() if "ssim" in table]
    assert max(psnr) - min(psnr) > 0.5
    assert max(ssim) - min(ssim) > 0.02


def test_psnr_of_the_mean_error_is_below_the_mean_psnr() -> None:
    table = scored("instant-ngp")
    errors = [np.mean((image - truth) ** 2) for image, truth in composited((0, 0, 0))]
    assert table["psnr_of_mean_mse"] == pytest.approx(-10 * math.log10(np.mean(errors)), abs=1e-4)
    assert table["psnr_of_mean_mse"] < table["psnr"]


def test_photographs_keep_the_scenes_background() -> None:
    """Where the truth is opaque there is no background to choose, and the model was fitted in front of the scene's."""
    rendering, view = view_of(0, alpha=None)
    for convention in OTHERS.values():
        image, _ = shown(rendering, view, scene(), convention)
        expected = rendering.over(torch.tensor(SCENE_GREY)).clamp(0, 1)
        torch.testing.assert_close(image, expected, atol=1.01 / 255, rtol=0)


def test_linear_scenes_are_composited_linearly_and_compared_in_srgb() -> None:
    rendering, view = view_of(0)
    linear = View(view.camera, view.image.float() / 255, "0", alpha=view.alpha)
    image, truth = shown(rendering, linear, scene("linear"), PROTOCOLS["nerf-pytorch"])
    torch.testing.assert_close(image, linear_to_srgb(rendering.over(torch.ones(3))))
    torch.testing.assert_close(truth, linear_to_srgb(linear.over(torch.ones(3))))
    clear = Rendering(torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH), torch.zeros(HEIGHT, WIDTH))
    image, _ = shown(clear, linear, scene("linear"), PROTOCOLS["nerfstudio-splatfacto"])
    torch.testing.assert_close(image, torch.tensor(VISER_GREY).expand_as(image))  # as the viewer displays it


def test_masks_are_those_of_the_tool() -> None:
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:10] = False
    rendering, view = view_of(0, mask=mask)
    image, truth = shown(rendering, view, scene(), PROTOCOLS["nerfbaselines"])
    assert bool((image[:10] == 0).all()) and bool((truth[:10] == 0).all()) and float(image[10:].sum()) > 0
    result = score(rendering, view, scene(), PROTOCOLS["gsplat"])
    assert result.values == {} and "gsplat does not support masks" in result.skipped["psnr"]


def test_predictions_that_are_not_finite_are_skipped() -> None:
    rendering, view = view_of(0)
    rendering.rgb[3, 4, 0] = torch.nan
    result = score(rendering, view, scene(), PROTOCOLS["gsplat"])
    assert result.values == {} and "not finite at 1 of" in result.skipped["ssim"]
    assert summarise([result], PROTOCOLS["gsplat"])[1]["psnr"] == result.skipped["psnr"]


def test_equal_pictures_are_perfect_and_flat_ones_have_a_value() -> None:
    flat = torch.full((HEIGHT, WIDTH, 3), 0.25)
    for convention in OTHERS.values():
        for how in convention.measures.values():
            if isinstance(how, Psnr):
                assert measure(how, flat, flat) == pytest.approx(100)
            elif isinstance(how, Ssim):
                inner = 1.0 if how.edges != "zero" else measure(how, flat, flat)
                assert measure(how, flat, flat) == pytest.approx(inner) == pytest.approx(1, abs=1e-9)


def test_ssim_needs_a_whole_window() -> None:
    tiny = torch.zeros(10, 30, 3)
    with pytest.raises(Skip, match="30x10 are smaller than SSIM's 11 x 11 window"):
        measure(Ssim(), tiny, tiny)
    assert measure(Ssim(kernel=NGP_KERNEL, edges="reflect"), tiny, tiny) == 1


def test_lpips_gets_the_net_and_the_range_of_the_convention(monkeypatch, tmp_path) -> None:
    """A stand-in network, since the real weights may not be fetched: it records how it is called."""
    asked = []

    class Network(torch.nn.Module):
        def __init__(self, net: str, **settings) -> None:
            super().__init__()
            self.net = net

        def forward(self, a, b, normalize):
            asked.append((self.net, normalize, tuple(a.shape)))
            return (a - b).abs().mean()

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(perceptual.importlib.util, "find_spec", lambda name: object())
    image, truth = torch.zeros(HEIGHT, WIDTH, 3), torch.full((HEIGHT, WIDTH, 3), 0.5)
    with pytest.raises(Skip, match=r"VGG-16 weights .*vgg16-397923af\.pth are missing"):
        measure(Lpips("vgg", scaled=False), image, truth)
    (tmp_path / "checkpoints").mkdir()
    for _, file in perceptual.BACKBONES.values():
        (tmp_path / "checkpoints" / file).write_bytes(b"weights")
    monkeypatch.setitem(sys.modules, "lpips", types.SimpleNamespace(LPIPS=Network))
    perceptual._lpips_network.cache_clear()
    try:
        rendering, view = view_of(0)
        names = ("nerfbaselines", "3dgs-metrics", "gsplat")
        results = [score(rendering, view, scene(), PROTOCOLS[name]) for name in names]
    finally:
        perceptual._lpips_network.cache_clear()
    assert [(net, scaled) for net, scaled, _ in asked] == [("alex", True), ("vgg", True), ("vgg", False), ("alex", True)]
    assert asked[0][2] == (1, 3, HEIGHT, WIDTH)
    assert set(results[1].values) == {"psnr", "ssim", "lpips_vgg"}
