"""Splatting: explicit primitives projected to the screen, sorted, and composited (Zwicker et al. 2001; Kerbl et al. 2023)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from invgraphics import kernels
from invgraphics.core import (
    Camera,
    Context,
    Contributions,
    Field,
    Gaussians,
    Quantity,
    Rays,
    Renderer,
    Rendering,
    Scene,
    Screen,
    Trace,
)
from invgraphics.core.transforms import quaternion_to_matrix
from invgraphics.kernels.reference.splat_raster import blending_weights, responses_at, visible_alphas
from invgraphics.kernels.types import Footprints
from invgraphics.renderers.base import MIN_SURFACE_ALPHA, normals_from_depth, to_rendering
from invgraphics.renderers.gaussians.profile import density_profile

FLATNESS = 1e-3
"""Third scale of a disc, which is not drawn, over the shorter of the others: where a fit begins, and in files."""


@dataclass(frozen=True)
class SplattingConfig:
    """Rasterised anisotropic Gaussians.

    Attributes:
        shape: ``ellipsoid`` projects to an ellipse, to first order (EWA); ``disc`` drops the third axis, which is the
            disc's normal, and meets each pixel's ray exactly (2DGS).
        dilation: variance in square pixels added to every footprint (low-pass filter); of the smallest one, for discs
            (2DGS: 0.5).
        antialiased: whether that keeps a footprint's integral rather than its peak (Mip-Splatting, with ``dilation`` 0.1).
        depth: ``expected`` averages the distances of a pixel's splats by weight; ``median`` takes that of the splat at which
            half of the light is gone. For evaluation: gradients pass through the expected one only.
        normals: ``shortest`` averages the splats' shortest axes (of discs the third); ``depth`` takes the depth map's slope.
        absolute_gradients: whether density control sees the sum of absolute gradients over pixels (AbsGS), in which opposite
            gradients do not cancel.
        max_grad_splats: how many splats of each pixel, from the front, receive its gradient; 0 for all (the paper's ablation of
            limited bandwidth uses 10).
        tile: edge of a tile in pixels (Numba takes 32 at most); ``None`` leaves it to the kernel.
    """

    title: ClassVar[str] = "splatting"

    shape: Literal["ellipsoid", "disc"] = "ellipsoid"
    dilation: float = 0.3
    antialiased: bool = False
    depth: Literal["expected", "median"] = "expected"
    normals: Literal["shortest", "depth"] = "shortest"
    absolute_gradients: bool = False
    max_grad_splats: int = 0
    tile: int | None = None

    def __post_init__(self) -> None:
        if self.dilation < 0 or self.max_grad_splats < 0:
            raise ValueError("dilation and max_grad_splats must not be negative")
        if self.tile is not None and self.tile < 1:
            raise ValueError(f"tile must be at least 1, not {self.tile}")
        if self.flat and (self.antialiased or self.absolute_gradients):
            raise ValueError("'antialiased' and 'absolute_gradients' are not supported for discs")

    @property
    def flat(self) -> bool:
        """Whether the third axis of each Gaussian is ignored."""
        return self.shape == "disc"

    def build(self, scene: Scene) -> Splatting:
        """The renderer; it needs nothing from the scene."""
        return Splatting(self)


class Splatting(Renderer):
    """Projects a field's Gaussians to footprints and composites them front to back."""

    requires: ClassVar[Quantity] = Quantity.GAUSSIANS

    def __init__(self, config: SplattingConfig) -> None:
        super().__init__()
        self.config = config
        self.depth_kind = "median" if config.depth == "median" else "mean"

    @override
    @torch.no_grad()
    def prepare(self, field: Field) -> None:
        """Flatten the Gaussians that are to be discs, with random normals, as in 2DGS's code.

        The third scale has no gradient. Left as long as the others, it would decide what density control splits and prunes, and
        put the parts off the disc.
        """
        scales, quaternions = getattr(field, "log_scales", None), getattr(field, "quaternions", None)
        if not self.config.flat or scales is None or quaternions is None:
            return
        quaternions.copy_(torch.nn.functional.normalize(torch.randn(len(quaternions), 4), dim=1))
        scales[:, 2] = scales[:, :2].amin(dim=1) + math.log(FLATNESS)

    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel. Depth is left at infinity in training, unless ``ctx.geometry`` is set."""
        gaussians: Gaussians = field.primitives(Quantity.GAUSSIANS, ctx)
        footprints, rgb = self.project(gaussians, camera)
        features = [rgb]
        if ctx.geometry or not ctx.training:
            features.append(_distance_coefficients(footprints))
        if ctx.geometry:
            features.append(_normals(gaussians, camera, self.config.flat))
        size = camera.width, camera.height
        sums, alpha = kernels.splat_rasterise(
            footprints, torch.cat(features, dim=1), *size, self.config.tile, self.config.max_grad_splats
        )
        rendering = self._rendering(sums, alpha, camera, footprints)
        screen = Screen(footprints.means2d, footprints.radii, *size, footprints.absgrad, gaussians.opacities, gaussians.scales)
        return rendering, Trace(screen=screen, rays=alpha.numel())

    def project(self, gaussians: Gaussians, camera: Camera) -> tuple[Footprints, Float[Tensor, "n 3"]]:
        """Project Gaussians; retains gradients of means2d in training. Returns footprints and colours."""
        config = self.config
        if config.flat:
            footprints, rgb = kernels.splat_project_discs(gaussians, camera, config.dilation)
        else:
            footprints, rgb = kernels.splat_project(gaussians, camera, config.dilation, config.antialiased)
        if footprints.means2d.requires_grad:
            footprints.means2d.retain_grad()
            if config.absolute_gradients:
                footprints = replace(footprints, absgrad=torch.zeros_like(footprints.means2d, requires_grad=True))
        return footprints, rgb

    @override
    def for_depth_fusion(self) -> Splatting:
        """Copy of the renderer with median depth and depth-map normals, which are sharper at edges than means."""
        return Splatting(replace(self.config, depth="median", normals="depth"))

    @override
    @torch.no_grad()
    def contributions(self, field: Field, camera: Camera, pixel: tuple[int, int], ctx: Context) -> Contributions:
        """List the splats whose footprints cover the pixel, by the depth of their centres; see `Renderer.contributions`."""
        gaussians: Gaussians = field.primitives(Quantity.GAUSSIANS, ctx)
        footprints, rgb = self.project(gaussians, camera)
        point = camera.focal.new_tensor([pixel]) + 0.5
        visible = (footprints.radii > 0).nonzero()[:, 0]
        order = visible[footprints.depths[visible].argsort(stable=True)]
        alpha = visible_alphas(responses_at(footprints, order, point))[0]
        order, alpha = order[alpha > 0], alpha[alpha > 0]
        weight = blending_weights(alpha[None])[0]
        drawn = int((weight > 0).sum())  # compositing stops when next to no light is left
        order, alpha, weight = order[:drawn], alpha[:drawn], weight[:drawn]
        planes = footprints.depth_planes[order]
        t = planes[:, 0] + ((point - footprints.means2d[order]) * planes[:, 1:]).sum(dim=1)
        rays = camera.ray(pixel)
        sigma = torch.zeros_like(t) if self.config.flat else _deviations(gaussians, order, rays)
        return Contributions(
            kind="splats",
            t=t,
            begin=t - sigma,
            end=t + sigma,
            alpha=alpha,
            transmittance=torch.cumprod(torch.nn.functional.pad(1 - alpha, (1, 0), value=1.0), dim=0)[:-1],
            weight=weight,
            rgb=rgb[order],
            counted=torch.ones_like(order, dtype=torch.bool),
            marched=density_profile(t, sigma, -torch.log1p(-alpha), rays),
        )

    def _rendering(
        self, sums: Float[Tensor, "h w c"], alpha: Float[Tensor, "h w"], camera: Camera, footprints: Footprints
    ) -> Rendering:
        """Convert pixel sums to a rendering; channels: colour, three distance coefficients and the normal, if present."""
        far = torch.full_like(alpha, torch.inf)
        if sums.shape[2] == 3:
            return Rendering(sums, alpha, far)
        x, y = (torch.arange(count, device=sums.device, dtype=sums.dtype) + 0.5 for count in (camera.width, camera.height))
        distance = sums[..., 3] * x + sums[..., 4] * y[:, None] + sums[..., 5]
        if self.config.depth == "median":
            median = kernels.splat_median(footprints, camera.width, camera.height, self.config.tile)
            distance = torch.where(torch.isfinite(median), median * alpha, distance)
        if sums.shape[2] == 6:
            return to_rendering(sums[..., :3], alpha, distance, None, far)
        normal, directions = sums[..., 6:], camera.rays().directions.view(*alpha.shape, 3)
        if self.config.normals == "depth":
            normal = normals_from_depth(distance / alpha.clamp_min(MIN_SURFACE_ALPHA), alpha >= MIN_SURFACE_ALPHA, directions)
        return to_rendering(sums[..., :3], alpha, distance, normal, far, directions)


def _deviations(gaussians: Gaussians, order: Int[Tensor, " k"], rays: Rays) -> Float[Tensor, " k"]:
    """Standard deviation along one ray of the Gaussians ``order``, 1 / |diag(1/s) Rᵀ d|."""
    axes = quaternion_to_matrix(gaussians.quaternions[order])
    return ((rays.directions[0] @ axes) / gaussians.scales[order]).norm(dim=1).reciprocal()


def _distance_coefficients(footprints: Footprints) -> Float[Tensor, "n 3"]:
    """Rewrite `Footprints.depth_planes` as t = k_x x + k_y y + k_1, whose coefficients can be summed over splats."""
    at_mean, slopes = footprints.depth_planes[:, :1], footprints.depth_planes[:, 1:]
    return torch.cat([slopes, at_mean - (slopes * footprints.means2d).sum(dim=1, keepdim=True)], dim=1)


def _normals(gaussians: Gaussians, camera: Camera, flat: bool) -> Float[Tensor, "n 3"]:
    """Normal of each Gaussian, turned towards the camera: its shortest axis, of a disc the third."""
    axes = quaternion_to_matrix(gaussians.quaternions)
    shortest = gaussians.scales.argmin(dim=1)[:, None, None].expand(-1, 3, 1)
    normal = axes[:, :, 2] if flat else axes.gather(2, shortest)[:, :, 0]
    away = (normal * (gaussians.means - camera.position)).sum(dim=1, keepdim=True) > 0
    return torch.where(away, -normal, normal)
