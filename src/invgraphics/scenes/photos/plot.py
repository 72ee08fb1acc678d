"""Top view of a reconstruction: coloured points, and cameras with their viewing directions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

_QUANTILES = (0.02, 0.98)
_MOST_POINTS = 40_000


def top_view(model: Any, title: str, path: Path) -> None:
    """Draw cameras and points seen from above (against the cameras' mean up) and from the side, as a PNG.

    Far stray points are left out of the picture: the axes span the cameras and 96 % of the points.
    """
    import matplotlib.pyplot as plt
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    poses = [image.cam_from_world().inverse().matrix() for image in model.images.values() if image.has_pose]
    pose = np.array(poses)
    turn = _upright(pose)
    centre, forward = pose[:, :, 3] @ turn.T, pose[:, :, 2] @ turn.T
    points = list(model.points3D.values())
    chosen = np.random.default_rng(0).permutation(len(points))[:_MOST_POINTS]
    place = np.array([points[i].xyz for i in chosen]).reshape(-1, 3) @ turn.T
    colour = np.array([points[i].color for i in chosen]).reshape(-1, 3) / 255
    lo, hi = _limits(centre, place)
    figure = plt.Figure(figsize=(12, 6), layout="constrained")
    FigureCanvasAgg(figure)
    arrow = 0.08 * float(np.max(hi - lo))
    for axes, (right, up), name in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        axes.scatter(place[:, right], place[:, up], s=2, c=colour, linewidths=0)
        axes.quiver(
            centre[:, right], centre[:, up], arrow * forward[:, right], arrow * forward[:, up],
            angles="xy", scale_units="xy", scale=1, width=0.003, color="tab:red",
        )  # fmt: skip
        axes.scatter(centre[:, right], centre[:, up], s=10, color="tab:red")
        axes.set(xlim=(lo[right], hi[right]), ylim=(lo[up], hi[up]), title=name, xlabel="xyz"[right], ylabel="xyz"[up])
        axes.set_aspect("equal")
    figure.suptitle(title)
    figure.savefig(path, dpi=100)


def _upright(pose: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "3 3"]:
    """A rotation that turns the cameras' mean up to +z, and their widest horizontal spread to x."""
    up = -pose[:, :, 1].mean(axis=0)
    up /= np.linalg.norm(up) or 1.0
    flat = pose[:, :, 3] - pose[:, :, 3].mean(axis=0)
    flat = flat - np.outer(flat @ up, up)
    along = np.linalg.svd(np.concatenate([flat, 1e-9 * np.eye(3)]))[2][0]
    along = along - (along @ up) * up
    length = np.linalg.norm(along)
    along = along / length if length > 1e-6 else np.linalg.svd(up[None])[2][1]
    return np.stack([along, np.cross(up, along), up])


def _limits(
    centre: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, 3], Float[np.ndarray, 3]]:
    ends = [centre, np.quantile(place, _QUANTILES, axis=0)] if len(place) else [centre]
    both = np.concatenate(ends)
    lo, hi = both.min(axis=0), both.max(axis=0)
    margin = 0.1 * max(float(np.max(hi - lo)), 1e-6)
    return lo - margin, hi + margin
