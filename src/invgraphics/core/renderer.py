"""Renderers: pictures of a field from a camera; samplers, which place samples along rays; and the check of a pair."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Literal, Self, final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from invgraphics.core.camera import Camera
from invgraphics.core.contributions import Contributions, sampled_contributions
from invgraphics.core.field import Field, Quantity
from invgraphics.core.rays import Rays
from invgraphics.core.rendering import Context, Rendering, Trace
from invgraphics.core.samples import Samples
from invgraphics.errors import NotComposableError


class _StatefulModule(nn.Module):
    """Module whose learnt state may have a constant substitute."""

    def untrained(self) -> Self:
        """This module with constants in place of learnt state, for fields that it was not trained with; may be itself.

        Raises:
            NotComposableError: it has state without a constant substitute.
        """
        if self.state_dict():
            raise NotComposableError(
                f"{type(self).__name__} has learnt state without a constant substitute.", "It needs a fit of its own."
            )
        return self


class Sampler(_StatefulModule, ABC):
    """Places samples along rays. May own parameters (proposal networks) and buffers (occupancy grids)."""

    @property
    def requires(self) -> Quantity:
        """Quantities of the field needed in addition to density."""
        return Quantity.NONE

    @abstractmethod
    def sample(self, rays: Rays, field: Field, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        """Samples on ``rays``, whose near and far are set, and the traces of earlier passes (coarse or proposal)."""

    def update(self, field: Field, ctx: Context) -> None:
        """Refresh what is learnt without gradients (an occupancy grid); called once after each training step."""

    def composite_fused(
        self, rays: Rays, width: int, field: Field, ctx: Context, max_error: float
    ) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]] | None:
        """Sampling, query and compositing of a whole picture in one kernel, without gradients, where one supports the field.

        Args:
            rays: of all n pixels, row by row, whose near and far are set.
            width: of the picture, in pixels.
            field: what is rendered.
            ctx: of an evaluation.
            max_error: upper bound, per ray, of the summed weights of samples whose radiance is not evaluated, in [0, 1].

        Returns:
            Sums of weight * (radiance, distance), and of the weights, per ray; ``None`` where there is no such kernel.
        """
        return None


class Renderer(_StatefulModule, ABC):
    """Renders a field from a camera, differentiably in the field and in the camera's pose.

    Attributes:
        requires: the quantities that the field must provide.
        depth_kind: what `Rendering.depth` is: the weighted mean of the distances along a ray, or their median.
    """

    requires: ClassVar[Quantity]
    depth_kind: Literal["mean", "median"] = "mean"

    @property
    def required(self) -> Quantity:
        """Quantities of the field that this renderer (`requires`) and its parts (`Sampler.requires`) together need."""
        return self.requires

    @property
    def feature_width(self) -> int | None:
        """Number of features that its networks take from the field; ``None``: none, or any number."""
        return None

    @abstractmethod
    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel of ``camera``; the rendering has shape (height, width)."""

    def prepare(self, field: Field) -> None:
        """Adapt a field's initial values to this renderer; called once, before a fit."""

    def update(self, field: Field, ctx: Context) -> None:
        """Refresh what is learnt without gradients; called once after each training step."""

    def contributions(self, field: Field, camera: Camera, pixel: tuple[int, int], ctx: Context) -> Contributions:
        """Everything that is composited into one pixel.

        Args:
            field: what is rendered.
            camera: whose pixel.
            pixel: column and row, from 0.
            ctx: of an evaluation, without randomness.

        Raises:
            NotComposableError: this renderer has no per-ray contributions to list.
        """
        raise NotComposableError(f"{type(self).__name__} has no per-ray contributions to list.")

    def for_depth_fusion(self) -> Renderer:
        """The variant of this renderer whose depth maps are fused to a mesh; itself, where there is no sharper one."""
        return self


EXPECTED_SAMPLES_PER_RAY = 16
"""Samples per ray assumed for a picture's first chunk of rays, to keep it within `Context.chunk` samples."""
MAX_CHUNK_FACTOR = 16
"""Largest chunk over the first one, for rays that take fewer samples than expected."""


class RayRenderer(Renderer):
    """A renderer whose pixels are independent, so that it can train on any set of rays.

    Attributes:
        ends_in_samples: whether a ray ends in each sample of its trace with the probability of that sample's weight, so that
            losses can say where: volume rendering.
    """

    ends_in_samples: ClassVar[bool] = False

    @abstractmethod
    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        """Render n rays; the rendering has shape (n,)."""

    def render_whole(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace] | None:
        """Render a whole picture at once where that is faster than in chunks of rays; ``None`` where it is not."""
        return None

    @final
    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel: by `render_whole` where it returns a picture, else in chunks of rays.

        The chunks' size adapts to the samples per ray. The trace is the last chunk's.
        """
        whole = self.render_whole(field, camera, ctx)
        if whole is not None:
            return whole
        rays = camera.rays()
        least = max(1, ctx.chunk // EXPECTED_SAMPLES_PER_RAY)
        size = min(least, len(rays))
        rendering, trace = self.render_rays(field, rays[:size], ctx)
        parts, begin = [rendering], size
        while begin < len(rays):
            if trace.samples is not None:
                fitting = size * ctx.chunk // max(len(trace.samples), 1)
                size = min(max(fitting, least), 2 * size, MAX_CHUNK_FACTOR * least)
            rendering, trace = self.render_rays(field, rays[begin : begin + size], ctx)
            parts.append(rendering)
            begin += size
        return Rendering.cat(parts).reshape(camera.height, camera.width), trace

    @torch.no_grad()
    def contributions(self, field: Field, camera: Camera, pixel: tuple[int, int], ctx: Context) -> Contributions:
        """The samples of the pixel's ray, as `render_rays` traces them; see `Renderer.contributions`."""
        rays = camera.ray(pixel)
        _, trace = self.render_rays(field, rays, ctx)
        if trace.samples is None or trace.weights is None or trace.values is None:
            return super().contributions(field, camera, pixel, ctx)
        return sampled_contributions(field, trace, rays, ctx)


def check(field: Field, renderer: Renderer) -> None:
    """Refuse a pair that does not fit.

    Raises:
        NotComposableError: names what the renderer needs and the field lacks, or features of which it offers another number.
    """
    missing = renderer.required & ~field.provides
    if missing:
        raise NotComposableError(
            f"{type(renderer).__name__} needs {missing.words()}, which {type(field).__name__} does not provide.",
            f"It provides {field.provides.words()}.",
        )
    takes, offered = renderer.feature_width, field.feature_width
    if takes is not None and takes != offered:
        raise NotComposableError(
            f"{type(renderer).__name__} takes {takes} features, but {type(field).__name__} offers {offered}.",
            f"Set renderer.features to {offered}.",
        )
