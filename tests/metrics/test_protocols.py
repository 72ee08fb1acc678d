"""Protocols: background, quantisation, crop, masks, colour space, and how views are joined."""

import math
from dataclasses import replace

import pytest
import torch

from invgraphics import plugins
from invgraphics.core import Bounds, Camera, Rendering, Scene, View
from invgraphics.core.colour import linear_to_srgb
from invgraphics.errors import InputError
from invgraphics.metrics import protocols
from invgraphics.metrics.base import Metric, Pair
from invgraphics.metrics.conventions import BLACK, PROTOCOLS, WHITE, Psnr, Ssim
from invgraphics.metrics.protocols import ViewScore, prepare, score, summarise
from invgraphics.runs.scores import Score

HEIGHT, WIDTH = 16, 20
PLAIN = PROTOCOLS["float"]


def camera() -> Camera:
    return Camera(torch.eye(4), torch.full((2,), 20.0), torch.tensor([WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT)


def scene_of(*views: View, **settings) -> Scene:
    bounds = Bounds(-torch.ones(3), torch.ones(3))
    return Scene(**({"name": "toy", "train": views, "test": views, "background": torch.ones(3), "bounds": bounds} | settings))


def rendering_of(rgb: float = 0.5, alpha: float = 1.0, depth: float = 2.0) -> Rendering:
    full = torch.ones(HEIGHT, WIDTH)
    return Rendering((full * rgb)[..., None].expand(HEIGHT, WIDTH, 3), full * alpha, full * depth)


def view_of(value: float = 0.5, **settings) -> View:
    return View(camera(), torch.full((HEIGHT, WIDTH, 3), value), "0000", **settings)


def test_background_belongs_to_the_protocol() -> None:
    view = view_of(0.0, alpha=torch.zeros(HEIGHT, WIDTH))
    scene = scene_of(view, background=torch.tensor([0.2, 0.4, 0.6]))
    for background, expected in {"scene": [0.2, 0.4, 0.6], WHITE: [1, 1, 1], BLACK: [0, 0, 0]}.items():
        pair = prepare(rendering_of(0.0, 0.0), view, scene, replace(PLAIN, background=background))
        for picture in (pair.image, pair.truth):
            torch.testing.assert_close(picture, torch.tensor(expected, dtype=torch.float32).expand(HEIGHT, WIDTH, 3))


def test_a_wrong_alpha_shows_on_white_and_hides_on_black() -> None:
    view = view_of(0.0, alpha=torch.zeros(HEIGHT, WIDTH))
    black_but_opaque = rendering_of(0.0, 1.0)
    scores = {
        background: score(black_but_opaque, view, scene_of(view), replace(PLAIN, background=background), ["psnr"]).values[
            "psnr"
        ]
        for background in (WHITE, BLACK)
    }
    assert scores == {WHITE: pytest.approx(0.0), BLACK: pytest.approx(100.0)}


def test_quantisation_rounds_to_bytes() -> None:
    view, wanted = view_of(100 / 255), 100.4 / 255
    rounded = prepare(rendering_of(wanted), view, scene_of(view), PROTOCOLS["default"])
    assert torch.equal(rounded.image, rounded.truth)
    exact = score(rendering_of(wanted), view, scene_of(view), PLAIN, ["psnr"]).values["psnr"]
    assert exact == pytest.approx(20 * math.log10(255 / 0.4), abs=1e-3)
    assert score(rendering_of(wanted), view, scene_of(view), PROTOCOLS["default"], ["psnr"]).values["psnr"] == 100


def test_predictions_are_clipped_before_they_are_scored() -> None:
    view = view_of(1.0)
    assert score(rendering_of(3.0), view, scene_of(view), PLAIN, ["psnr"]).values["psnr"] == 100


def test_linear_scenes_are_composited_linearly_and_scored_in_srgb() -> None:
    view = view_of(0.3, alpha=torch.full((HEIGHT, WIDTH), 0.5))
    pair = prepare(rendering_of(0.2, 0.5), view, scene_of(view, colour="linear"), PLAIN)
    torch.testing.assert_close(pair.image[0, 0], linear_to_srgb(torch.full((3,), 0.7)))
    torch.testing.assert_close(pair.truth[0, 0], linear_to_srgb(torch.full((3,), 0.65)))


def test_crop_leaves_the_border_out() -> None:
    view, rendering = view_of(0.5), rendering_of(0.5)
    rgb = rendering.rgb.clone()
    rgb[:2], rgb[-2:], rgb[:, :2], rgb[:, -2:] = 0, 0, 0, 0
    framed = replace(rendering, rgb=rgb)
    assert score(framed, view, scene_of(view), PLAIN, ["psnr"]).values["psnr"] < 20
    assert score(framed, view, scene_of(view), replace(PLAIN, crop=2), ["psnr"]).values["psnr"] == 100
    assert prepare(framed, view, scene_of(view), replace(PLAIN, crop=2)).pred_alpha.shape == (HEIGHT - 4, WIDTH - 4)
    with pytest.raises(InputError, match="crops 8 pixels"):
        prepare(framed, view, scene_of(view), replace(PLAIN, crop=8))


def test_masked_pixels_reach_no_metric() -> None:
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, :5] = False
    view, rendering = view_of(0.5, mask=mask), rendering_of(0.5)
    rgb = rendering.rgb.clone()
    rgb[:, :5] = 1.0
    values = score(replace(rendering, rgb=rgb), view, scene_of(view), PLAIN, ["psnr", "ssim", "flip"]).values
    assert values == {"psnr": 100.0, "ssim": pytest.approx(1.0), "flip": 0.0}


def test_depth_is_scored_in_world_units() -> None:
    view = view_of(depth=torch.full((HEIGHT, WIDTH), 2.5))
    scene = scene_of(view, world_from_local=torch.diag(torch.tensor([4.0, 4.0, 4.0, 1.0])))
    values = score(rendering_of(depth=2.0), view, scene, PLAIN, ["depth_rmse", "depth_abs_rel"]).values
    assert values == {"depth_rmse": pytest.approx(2.0), "depth_abs_rel": pytest.approx(0.2)}


def test_what_cannot_be_computed_says_why() -> None:
    view = view_of()
    result = score(rendering_of(), view, scene_of(view), PLAIN)
    assert set(result.values) == {"psnr", "psnr_exposed", "ssim", "flip"}
    assert set(result.values) | set(result.skipped) == set(plugins.names("metrics"))
    assert all(result.skipped.values())


@pytest.mark.parametrize("broken", [torch.nan, torch.inf])
def test_a_prediction_that_is_not_finite_gets_a_sentence_and_no_number(broken: float) -> None:
    view, rendering = view_of(), rendering_of()
    rgb = rendering.rgb.clone()
    rgb[0, 0, 1], rgb[3, 4] = broken, broken
    result = score(replace(rendering, rgb=rgb), view, scene_of(view), PLAIN)
    assert result.values == {}
    assert "not finite at 2 of 320 pixels" in result.skipped["psnr"]
    quality, skipped = summarise([score(rendering, view, scene_of(view), PLAIN), result])
    assert quality == {}
    assert skipped["psnr"].startswith("view 0000: the predicted colour")


def test_a_prediction_of_another_size_is_refused() -> None:
    view = View(camera(), torch.zeros(HEIGHT, WIDTH + 1, 3), "0003")
    with pytest.raises(InputError, match="'0003' is 20x16 pixels, the truth is 21x16"):
        score(rendering_of(), view, scene_of(view), PLAIN)


def test_summary_is_a_score_for_each_metric() -> None:
    scores = [ViewScore(f"000{i}", {"psnr": value}, {"lpips": "no weights"}) for i, value in enumerate([20.0, 30.0])]
    quality, skipped = summarise(scores)
    assert quality == {"psnr": Score(mean=25.0, unit="dB", higher_is_better=True, per_view=(20.0, 30.0))}
    assert skipped == {"lpips": "no weights"}


def test_mean_error_aggregation_joins_errors_rather_than_decibels() -> None:
    scores = [ViewScore(str(i), {"psnr": value, "ssim": value}, {}) for i, value in enumerate([20.0, 30.0])]
    quality, _ = summarise(scores, replace(PLAIN, measures={"psnr": Psnr(views="mean error"), "ssim": Ssim()}))
    assert quality["psnr"].mean == pytest.approx(-10 * math.log10((0.01 + 0.001) / 2))
    assert quality["ssim"].mean == 25.0


def test_names_are_checked() -> None:
    view = view_of()
    with pytest.raises(InputError, match="'pnsr' among the metrics"):
        score(rendering_of(), view, scene_of(view), PLAIN, ["pnsr"])
    with pytest.raises(InputError, match="no protocol 'defualt'"):
        protocols.protocol_named("defualt")
    assert protocols.protocol_named("default") is PROTOCOLS["default"]


def test_registered_names_are_the_metrics_own() -> None:
    for name in plugins.names("metrics"):
        metric = plugins.load("metrics", name)
        assert metric.name == name
        assert metric.summary


def mean_difference(pair: Pair) -> float:
    return float((pair.image - pair.truth).mean())


def stumble(pair: Pair) -> float:
    raise RuntimeError("no licence")


BIAS = Metric("bias", "", False, mean_difference, "mean signed error")
NOTHING = Metric("nothing", "", False, lambda pair: float("nan"), "no number")
FAULTY = Metric("faulty", "", False, stumble, "always fails")


class Point:
    """Stands in for an installed package's entry point."""

    dist = type("Distribution", (), {"name": "their-package"})
    group = "invgraphics.metrics"

    def __init__(self, name: str, target: str) -> None:
        self.name, self.value = name, f"{__name__}:{target}"


def test_a_third_party_metric_is_scored_and_cannot_spoil_the_others(monkeypatch) -> None:
    points = [Point("bias", "BIAS"), Point("faulty", "FAULTY"), Point("gone", "ABSENT"), Point("odd", "HEIGHT")]
    points.append(Point("nothing", "NOTHING"))
    monkeypatch.setattr("invgraphics.plugins.entry_points._entry_points", lambda path: points)
    view = view_of(0.25)
    result = score(rendering_of(0.5), view, scene_of(view), PLAIN)
    assert result.values["bias"] == pytest.approx(0.25)
    assert result.skipped["faulty"] == "their-package: RuntimeError: no licence"
    assert "cannot be imported" in result.skipped["gone"]
    assert result.skipped["nothing"] == "the value is not finite (nan)"
    assert "not an invgraphics Metric" in result.skipped["odd"]
    assert result.values["psnr"] == pytest.approx(20 * math.log10(4), abs=1e-4)
    assert summarise([result])[0]["bias"].mean == pytest.approx(0.25)
