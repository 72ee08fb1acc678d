"""Depth, normals and silhouettes with known answers."""

import math

import pytest
import torch

from invgraphics.core.transforms import se3_exp
from invgraphics.metrics import geometry
from invgraphics.metrics.base import Pair, Skip


def pair_of(height: int = 6, width: int = 8, **maps) -> Pair:
    picture = torch.zeros(height, width, 3)
    return Pair(**({"image": picture, "truth": picture, "pred_alpha": torch.ones(height, width)} | maps))


def test_depth_errors_of_a_scaled_prediction() -> None:
    true = torch.linspace(1, 3, 48).reshape(6, 8)
    pair = pair_of(pred_depth=1.1 * true, true_depth=true)
    assert geometry.DEPTH_ABS_REL.compute(pair) == pytest.approx(0.1, abs=1e-6)
    assert geometry.DEPTH_RMSE.compute(pair) == pytest.approx(0.1 * math.sqrt(float(true.square().mean())), abs=1e-6)


def test_depth_is_scored_only_where_both_show_a_surface() -> None:
    true = torch.full((6, 8), 2.0)
    true[0] = torch.inf
    predicted = true.clone()
    predicted[0], predicted[1], predicted[2], predicted[3] = 7.0, torch.nan, 9.0, 2.5
    pred_alpha, true_alpha, mask = torch.ones(6, 8), torch.ones(6, 8), torch.ones(6, 8, dtype=torch.bool)
    pred_alpha[1], true_alpha[2] = 0.49, 0.49
    pair = pair_of(pred_depth=predicted, true_depth=true, pred_alpha=pred_alpha, true_alpha=true_alpha, mask=mask)
    assert geometry.DEPTH_ABS_REL.compute(pair) == pytest.approx(0.25 / 3)  # rows 3 (off by a quarter), 4 and 5
    mask[3] = False
    assert geometry.DEPTH_ABS_REL.compute(pair) == 0


def test_true_depths_of_zero_are_none() -> None:
    """Sensors write 0 where they see nothing."""
    true = torch.full((6, 8), 3.0)
    pair = pair_of(pred_depth=true.clone(), true_depth=true)
    true[:, :2] = 0.0
    for metric in (geometry.DEPTH_ABS_REL, geometry.DEPTH_RMSE):
        assert metric.compute(pair) == 0


def test_depth_says_why_it_is_missing() -> None:
    ones = torch.ones(6, 8)
    cases = {
        "no true depth": {"pred_depth": ones},
        "prediction has no depth": {"true_depth": ones},
        "no pixel shows a surface": {"pred_depth": ones, "true_depth": ones, "pred_alpha": ones * 0.2},
        "not finite at 48 of 48": {"pred_depth": ones * torch.inf, "true_depth": ones},
    }
    for reason, maps in cases.items():
        with pytest.raises(Skip, match=reason):
            geometry.DEPTH_RMSE.compute(pair_of(**maps))


def test_smooth_variants_leave_out_the_truths_discontinuities() -> None:
    true = torch.full((8, 12), 2.0)
    true[:, 6:] = 3.0
    true[0, 0] = torch.inf
    expected = torch.ones(8, 12, dtype=torch.bool)
    expected[:, 5:7] = False
    expected[:2, :2] = False
    true[5:, :4] = torch.inf  # wide enough for a pixel whose whole neighbourhood is missed
    expected[4:, :5] = False
    assert torch.equal(geometry.smooth_depth(true), expected)
    predicted = true.clone()
    predicted[:, 5:7] = 10.0
    pair = pair_of(8, 12, pred_depth=predicted, true_depth=true)
    assert geometry.DEPTH_ABS_REL.compute(pair) > 0.1
    assert geometry.DEPTH_ABS_REL_SMOOTH.compute(pair) == geometry.DEPTH_RMSE_SMOOTH.compute(pair) == 0


def test_a_slanted_plane_is_smooth() -> None:
    assert geometry.smooth_depth(torch.linspace(1.0, 1.2, 12).expand(5, 12)).all()


@pytest.mark.parametrize("degrees", [0.001, 1.0, 45.0, 90.0, 179.0])
def test_normals_turned_by_a_known_angle(degrees: float) -> None:
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    azimuth = torch.rand(6, 8, dtype=torch.float64) * 2 * torch.pi
    true = torch.stack([azimuth.cos(), azimuth.sin(), torch.zeros_like(azimuth)], dim=-1)  # in the plane that is turned
    turn = se3_exp(torch.cat([axis * math.radians(degrees), torch.zeros(3, dtype=torch.float64)]))[:3, :3]
    pair = pair_of(pred_normal=true @ turn.T, true_normal=true)
    assert geometry.NORMAL_DEG.compute(pair) == pytest.approx(degrees, rel=1e-6)


def test_missing_normals_count_as_a_right_angle_and_misses_not_at_all() -> None:
    true = torch.zeros(6, 8, 3)
    true[:4, :, 2] = 1.0
    predicted = true.clone()
    predicted[0] = 0.0
    assert geometry.NORMAL_DEG.compute(pair_of(pred_normal=predicted, true_normal=true)) == pytest.approx(90 / 4)
    for reason, maps in {
        "no true normals": {"pred_normal": true},
        "prediction has no normals": {"true_normal": true},
        "not finite at 32": {"true_normal": true, "pred_normal": true * torch.nan},
    }.items():
        with pytest.raises(Skip, match=reason):
            geometry.NORMAL_DEG.compute(pair_of(**maps))


def test_silhouette_overlap() -> None:
    true, predicted = torch.zeros(6, 8), torch.zeros(6, 8)
    true[:, 2:6], predicted[:, 4:8] = 1.0, 0.5
    assert geometry.ALPHA_IOU.compute(pair_of(pred_alpha=predicted, true_alpha=true)) == pytest.approx(2 / 6)
    with pytest.raises(Skip, match="no true alpha"):
        geometry.ALPHA_IOU.compute(pair_of(pred_alpha=predicted))
    with pytest.raises(Skip, match="neither"):
        geometry.ALPHA_IOU.compute(pair_of(pred_alpha=predicted * 0.9, true_alpha=true * 0.4))
