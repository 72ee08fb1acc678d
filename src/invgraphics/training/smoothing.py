"""The 3D smoothing filter of Mip-Splatting (Yu et al. 2024, §5.1): a low-pass filter at the training views' sampling rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Camera
from invgraphics.training.checks import Requirement
from invgraphics.training.hooks import FitState, Hook

CHUNK = 4096
"""Points that are projected into all cameras at once: few enough for the cache."""


@dataclass(frozen=True)
class SmoothingConfig:
    """Sets a Gaussian field's ``smoothing`` from the training cameras; belongs behind the hooks that add or move Gaussians.

    Attributes:
        every: steps between two computations; there is one more after each change in number.
        variance: of the filter, in squares of the pixel distance at the Gaussian.
        margin: part of the image by which a Gaussian may lie outside it and still be in view.
        near: cameras nearer to a Gaussian than this along their axis, or than the scene's near plane where that is less, do not
            count for it; local units.
    """

    every: int = 100
    variance: float = 0.2
    margin: float = 0.15
    near: float = 0.2

    def __post_init__(self) -> None:
        if self.every < 1 or not self.variance > 0 or not self.near > 0:
            raise ValueError("'every' must be at least 1, 'variance' and 'near' must be positive.")

    def build(self) -> Smoothing:
        """The hook."""
        return Smoothing(self)


class SmoothedGaussians(Protocol):
    """The part of a field of n Gaussians that `Smoothing` reads and sets."""

    means: Float[Tensor, "n 3"]
    smoothing: Float[Tensor, " n"]


class Smoothing(Hook):
    """Sets the field's ``smoothing``, which is saved with the field."""

    name = "smoothing"
    requires = Requirement("Gaussians", SmoothedGaussians)

    def __init__(self, config: SmoothingConfig) -> None:
        self._config = config

    @override
    def before_step(self, state: FitState) -> None:
        self._refresh(state, due=state.step % self._config.every == 0)

    @override
    def after_step(self, state: FitState) -> None:
        self._refresh(state, due=False)  # so that no fit ends between a change in number and its filter

    @torch.no_grad()
    def _refresh(self, state: FitState, due: bool) -> None:
        field, config = cast(SmoothedGaussians, state.field), self._config
        # A filter is positive everywhere; zeros are what a change in number leaves behind.
        if due or not bool(field.smoothing.any()):
            near = min(config.near, state.scene.bounds.near)
            spacing = pixel_distances(field.means, state.cameras(), config.margin, near)
            field.smoothing.copy_(config.variance**0.5 * spacing)


def pixel_distances(points: Float[Tensor, "n 3"], cameras: Sequence[Camera], margin: float, near: float) -> Float[Tensor, " n"]:
    """Sampling interval at each point: depth over focal length in the camera with the highest sampling rate there.

    Points in no camera's view get the largest interval of those in view; 0 if none is.
    """
    cameras = [camera.to(points.device) for camera in cameras]
    world_to_cam = torch.stack([camera.world_to_cam[:3] for camera in cameras]).to(points)
    focal = torch.stack([camera.focal for camera in cameras]).to(points)
    centre = torch.stack([camera.principal_point for camera in cameras]).to(points)
    size = points.new_tensor([[camera.width, camera.height] for camera in cameras])
    # In units of depth: the tangents of the margins' edges.
    lowest, highest = (-margin * size - centre) / focal, ((1 + margin) * size - centre) / focal
    parts = []
    for part in points.split(CHUNK):
        x, y, z = (part @ row[:, :3].T + row[:, 3] for row in world_to_cam.unbind(dim=1))
        inside = (x >= lowest[:, 0] * z) & (x <= highest[:, 0] * z) & (y >= lowest[:, 1] * z) & (y <= highest[:, 1] * z)
        parts.append(torch.where(inside & (z > near), z / focal.amax(dim=1), torch.inf).amin(dim=1))
    finest = torch.cat(parts) if parts else points[:, 0]
    seen = torch.isfinite(finest)
    largest = finest[seen].max() if bool(seen.any()) else finest.new_zeros(())
    return torch.where(seen, finest, largest)
