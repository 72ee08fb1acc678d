"""The 3D smoothing filter of Mip-Splatting (Yu et al. 2024, §4.1): no Gaussian is finer than what a photograph can show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Camera, Field, Renderer
from invgraphics.errors import InputError
from invgraphics.training.hooks import FitState, Hook


@dataclass(frozen=True)
class SmoothingConfig:
    """Sets a Gaussian field's ``smoothing`` from the training cameras; belongs behind the hooks that add or move Gaussians.

    Attributes:
        every: steps between two computations; there is one more after each change in number.
        variance: of the filter, in squares of the pixel distance at the Gaussian.
        margin: part of the image by which a Gaussian may lie outside it and still count as photographed.
        near: Gaussians nearer than this along the optical axis do not count, local units.
    """

    every: int = 100
    variance: float = 0.2
    margin: float = 0.15
    near: float = 0.2

    def __post_init__(self) -> None:
        if self.every < 1 or not self.variance > 0 or not self.near > 0:
            raise ValueError("'every' must be at least 1, 'variance' and 'near' must be positive.")

    def build(self) -> Hook:
        """The hook."""
        return _Smoothing(self)


class _Smoothed(Protocol):
    means: Float[Tensor, "n 3"]
    smoothing: Float[Tensor, " n"]


class _Smoothing(Hook):
    """Keeps nothing itself: the filter is saved with the field."""

    def __init__(self, config: SmoothingConfig) -> None:
        self._config = config

    @override
    def check(self, field: Field, renderer: Renderer) -> None:
        if not hasattr(field, "smoothing"):
            raise InputError(f"The hook 'smoothing' needs Gaussians, which {type(field).__name__} does not have.")

    @override
    def before_step(self, state: FitState) -> None:
        self._refresh(state, due=state.step % self._config.every == 0)

    @override
    def after_step(self, state: FitState) -> None:
        self._refresh(state, due=False)  # so that no fit ends between a change in number and its filter

    @torch.no_grad()
    def _refresh(self, state: FitState, due: bool) -> None:
        field, config = cast(_Smoothed, state.field), self._config
        # A filter is positive everywhere; zeros are what a change in number leaves behind.
        if due or not bool(field.smoothing.any()):
            cameras = [view.camera for view in state.scene.train]
            spacing = pixel_distances(field.means, cameras, config.margin, config.near)
            field.smoothing.copy_(config.variance**0.5 * spacing)


def pixel_distances(points: Float[Tensor, "n 3"], cameras: Sequence[Camera], margin: float, near: float) -> Float[Tensor, " n"]:
    """Distance between neighbouring pixels' rays at each point, in the camera that sees it most finely.

    Points that no camera sees get the largest distance of those that are seen; 0 if none is.
    """
    finest = torch.full_like(points[:, 0], torch.inf)
    for camera in cameras:
        here = camera.to(points.device)
        pixels, z = here.project(points)
        size = pixels.new_tensor([here.width, here.height])
        inside = ((pixels >= -margin * size) & (pixels <= (1 + margin) * size)).all(dim=1) & (z > near)
        finest = torch.where(inside, torch.minimum(finest, z / here.focal.max()), finest)
    seen = torch.isfinite(finest)
    largest = finest[seen].max() if bool(seen.any()) else finest.new_zeros(())
    return torch.where(seen, finest, largest)
