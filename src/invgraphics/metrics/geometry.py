"""Geometry metrics where the truth is known: depth, normals, silhouette."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

from invgraphics.metrics.base import OPAQUE, Metric, Pair, Skip

JUMP = 0.05
"""A depth step between neighbours of more than this part of the depth is a discontinuity."""


def shared_surface(pair: Pair) -> Bool[Tensor, "h w"]:
    """Mask of unmasked pixels where truth and prediction both show a surface (alpha >= 0.5)."""
    both = pair.pred_alpha >= OPAQUE
    if pair.true_alpha is not None:
        both = both & (pair.true_alpha >= OPAQUE)
    return both if pair.mask is None else both & pair.mask


def smooth_depth(depth: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Mask of pixels whose 3 x 3 neighbourhood has no depth discontinuity and no miss (inf)."""
    # Misses become a huge finite depth, so that the pooling below sees a jump and no inf - inf.
    finite = torch.where(depth.isfinite(), depth, torch.finfo(depth.dtype).max / 4)
    farthest = F.max_pool2d(finite[None, None], 3, stride=1, padding=1)[0, 0]
    nearest = -F.max_pool2d(-finite[None, None], 3, stride=1, padding=1)[0, 0]
    return depth.isfinite() & (farthest - nearest <= JUMP * finite)


def _scored_depths(pair: Pair, smooth: bool) -> tuple[Float[Tensor, " k"], Float[Tensor, " k"]]:
    """Predicted and true depths of the pixels that are scored."""
    if pair.true_depth is None:
        raise Skip("the scene has no true depth")
    if pair.pred_depth is None:
        raise Skip("the prediction has no depth")
    where = shared_surface(pair) & pair.true_depth.isfinite() & (pair.true_depth > 0)
    if smooth:
        where &= smooth_depth(pair.true_depth)
    if not where.any():
        raise Skip("no pixel shows a surface (alpha >= 0.5) in both truth and prediction")
    predicted, true = pair.pred_depth[where].double(), pair.true_depth[where].double()
    missing = int((~predicted.isfinite()).sum())
    if missing:
        raise Skip(f"the predicted depth is not finite at {missing} of {len(predicted)} surface pixels")
    return predicted, true


def _abs_rel(smooth: bool) -> Callable[[Pair], float]:
    def compute(pair: Pair) -> float:
        """Mean of |predicted - true| / true (Eigen et al. 2014)."""
        predicted, true = _scored_depths(pair, smooth)
        return float(((predicted - true).abs() / true).mean())

    return compute


def _rmse(smooth: bool) -> Callable[[Pair], float]:
    def compute(pair: Pair) -> float:
        """Root of the mean squared depth error, world units."""
        predicted, true = _scored_depths(pair, smooth)
        return float((predicted - true).square().mean().sqrt())

    return compute


def normal_angle(pair: Pair) -> float:
    """Mean angle between predicted and true normals, degrees; a missing prediction counts as 90 degrees."""
    if pair.true_normal is None:
        raise Skip("the scene has no true normals")
    if pair.pred_normal is None:
        raise Skip("the prediction has no normals")
    where = shared_surface(pair) & (pair.true_normal.norm(dim=-1) > OPAQUE)
    if not where.any():
        raise Skip("no pixel shows a surface (alpha >= 0.5) in both truth and prediction")
    predicted, true = pair.pred_normal[where].double(), pair.true_normal[where].double()
    if not predicted.isfinite().all():
        raise Skip(f"the predicted normal is not finite at {int((~predicted.isfinite()).any(dim=-1).sum())} surface pixels")
    # atan2 of |a x b| and a·b keeps its precision at small angles, where acos loses it; a zero normal gives atan2(0, 0) = 0.
    sine, cosine = torch.linalg.cross(predicted, true).norm(dim=-1), (predicted * true).sum(dim=-1)
    angle = torch.where(predicted.norm(dim=-1) > 0, torch.atan2(sine, cosine), torch.pi / 2)
    return float(torch.rad2deg(angle).mean())


def alpha_iou(pair: Pair) -> float:
    """Intersection over union of the silhouettes (alpha >= 0.5)."""
    if pair.true_alpha is None:
        raise Skip("the scene has no true alpha")
    counted = torch.ones_like(pair.pred_alpha, dtype=torch.bool) if pair.mask is None else pair.mask
    predicted, true = (pair.pred_alpha >= OPAQUE) & counted, (pair.true_alpha >= OPAQUE) & counted
    union = int((predicted | true).sum())
    if union == 0:
        raise Skip("neither truth nor prediction shows a surface (alpha >= 0.5)")
    return int((predicted & true).sum()) / union


_SCORED = "where both alphas are >= 0.5"
_FLAT = "the rendered truth's are of flat triangles"
_SMOOTH = f"{_SCORED}, away from steps of more than 5% in the true depth"
DEPTH_ABS_REL = Metric("depth_abs_rel", "", False, _abs_rel(smooth=False), f"mean |depth error| / true depth, {_SCORED}")
DEPTH_RMSE = Metric("depth_rmse", "world units", False, _rmse(smooth=False), f"root mean squared depth error, {_SCORED}")
DEPTH_ABS_REL_SMOOTH = Metric("depth_abs_rel_smooth", "", False, _abs_rel(smooth=True), f"as depth_abs_rel, {_SMOOTH}")
DEPTH_RMSE_SMOOTH = Metric("depth_rmse_smooth", "world units", False, _rmse(smooth=True), f"as depth_rmse, {_SMOOTH}")
NORMAL_DEG = Metric("normal_deg", "°", False, normal_angle, f"mean angle between normals, {_SCORED}; {_FLAT}")
ALPHA_IOU = Metric("alpha_iou", "", True, alpha_iou, "intersection over union of the silhouettes, alpha >= 0.5")
