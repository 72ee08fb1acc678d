"""Ray tracing of Gaussians: composited in order, or integrated as overlapping densities."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from invgraphics import kernels
from invgraphics.core import Camera, Context, Contributions, Field, Quantity, RayRenderer, Rays, Rendering, Scene, Trace
from invgraphics.core.compositing import alphas_from_weights
from invgraphics.kernels.extinction import SMALLEST_DEPTH, Opacity
from invgraphics.kernels.gaussians import gaussian_composites, gaussian_integrals
from invgraphics.kernels.reference.gaussian_order import composite_in_order, depth_order
from invgraphics.kernels.reference.gaussian_quadrature import Weights, integrate_overlapping, weighted_sums
from invgraphics.kernels.reference.gaussian_rays import Intersections, Primitives, colours, intersect, precompute
from invgraphics.renderers.base import to_rendering
from invgraphics.renderers.gaussians.profile import density_profile, mean_distances, transmittance

TILE = 16
"""Edge in pixels of the square whose rays are searched for Gaussians together."""
PART = 1 << 13
"""Rays that are searched and integrated together where that is compiled."""

MAX_STEPS = 1024
"""Intervals of a ray, each of which is kept for each Gaussian on it; the error falls with their square."""


@dataclass(frozen=True)
class GaussianExactConfig:
    """The volume-rendering equation over overlapping Gaussian densities; the order of primitives does not matter.

    Optical depths are closed forms (differences of error functions), so alpha is exact for any number of steps; only which
    share of it each overlapping Gaussian has is found by quadrature, with an error of second order.

    Attributes:
        opacity: what opacity means, see `invgraphics.kernels.extinction.Opacity`.
        steps: intervals of each ray, placed where alpha and optical depth grow.
        smallest: optical depth below which a Gaussian is left out of a ray.
        self_attenuation: whether a Gaussian absorbs its own light too: one alone has the alpha ``1 - exp(-depth)``; without,
            its optical depth itself, up to 0.99 (see `invgraphics.kernels.extinction.without_self_attenuation`).
    """

    title: ClassVar[str] = "exact line integrals"

    opacity: Literal["peak", "physical", "extinction"] = "peak"
    steps: int = 32
    smallest: float = SMALLEST_DEPTH
    self_attenuation: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= MAX_STEPS:
            raise ValueError(f"steps must be from 1 to {MAX_STEPS}, not {self.steps}.")
        _check_smallest(self.smallest)

    def build(self, scene: Scene) -> GaussianExact:
        """The renderer; it needs nothing from the scene."""
        return GaussianExact(self)


@dataclass(frozen=True)
class GaussianSortedConfig:
    """Each Gaussian integrated along the ray by itself, then composited front to back as if none overlapped.

    Attributes:
        opacity: what opacity means, see `invgraphics.kernels.extinction.Opacity`.
        order: ``ray`` sorts by the distance of the largest response on each ray; ``centre`` by the depth of the centre along
            the optical axis, one order for all pixels as splatters have it (along the ray itself where there is no camera).
        smallest: optical depth below which a Gaussian is left out of a ray; ``splat`` leaves out alphas below 1/255.
        self_attenuation: as of `GaussianExactConfig`; not for ``splat``, whose alphas are not integrated.
    """

    title: ClassVar[str] = "line integrals in ray order"

    opacity: Opacity = "peak"
    order: Literal["ray", "centre"] = "ray"
    smallest: float = SMALLEST_DEPTH
    self_attenuation: bool = True

    def __post_init__(self) -> None:
        if self.opacity == "splat" and not self.self_attenuation:
            raise ValueError("opacity 'splat' is an alpha, not integrated: self_attenuation cannot be switched off there.")
        _check_smallest(self.smallest)

    def build(self, scene: Scene) -> GaussianSorted:
        """The renderer; it needs nothing from the scene."""
        return GaussianSorted(self)


class GaussianRays(RayRenderer):
    """Renders Gaussians along rays; a subclass decides how overlapping ones share the light."""

    requires: ClassVar[Quantity] = Quantity.GAUSSIANS

    def __init__(self, opacity: Opacity, smallest: float, self_attenuation: bool = True) -> None:
        super().__init__()
        self._opacity: Opacity = opacity
        self._smallest = smallest
        self._self_attenuation = self_attenuation

    @abstractmethod
    def blending_weights(
        self, intersections: Intersections, rays: Rays, axis: Float[Tensor, 3] | None, with_distances: bool
    ) -> Weights:
        """Weight of each intersection: its share of the ray's light.

        Args:
            intersections: Gaussians on rays.
            rays: with near and far.
            axis: along which centres are sorted; ``None`` for each ray's own direction.
            with_distances: whether weights times distance are returned too.
        """

    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        """Render n rays from any number of cameras."""
        primitives = self._precompute(field, None, ctx)
        return self._render(primitives, rays, None, ctx), Trace(rays=len(rays))

    @override
    def render_whole(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel, tile by tile. Depth is left at infinity in training, unless ``ctx.geometry`` is set."""
        primitives = self._precompute(field, camera.position, ctx)
        rays, order = camera.rays(), self._parts(camera)
        axis = camera.cam_to_world[:3, 2]
        parts = [self._render(primitives, rays[part], axis, ctx) for part in order]
        rendering, place = Rendering.cat(parts), torch.cat(order).argsort()
        normal = None if rendering.normal is None else rendering.normal[place]
        ordered = Rendering(rendering.rgb[place], rendering.alpha[place], rendering.depth[place], normal)
        return ordered.reshape(camera.height, camera.width), Trace(rays=len(rays))

    @override
    @torch.no_grad()
    def contributions(self, field: Field, camera: Camera, pixel: tuple[int, int], ctx: Context) -> Contributions:
        """List the Gaussians that the pixel's ray intersects; see `Renderer.contributions`."""
        primitives = self._precompute(field, camera.position, ctx)
        rays = _clip_near(camera.ray(pixel), ctx)
        return self._list_contributions(intersect(primitives, rays), primitives, rays, camera.cam_to_world[:3, 2])

    @abstractmethod
    def _list_contributions(
        self, intersections: Intersections, primitives: Primitives, rays: Rays, axis: Float[Tensor, 3]
    ) -> Contributions:
        """Contributions of one ray's intersections, in compositing order."""

    def _precompute(self, field: Field, origin: Float[Tensor, 3] | None, ctx: Context) -> Primitives:
        """Precompute the field's Gaussians for rays, all from ``origin`` where one is given."""
        gaussians = field.primitives(Quantity.GAUSSIANS, ctx)
        return precompute(gaussians, self._opacity, self._smallest, origin, self._self_attenuation)

    def _render(self, primitives: Primitives, rays: Rays, axis: Float[Tensor, 3] | None, ctx: Context) -> Rendering:
        rays = _clip_near(rays, ctx)
        geometry = ctx.geometry or not ctx.training
        sums = self._sums(primitives, rays, axis, 4 if ctx.geometry else int(geometry))
        if not geometry:
            return Rendering(sums[:, 1:4], sums[:, 0], rays.far)
        normal = sums[:, 5:] if ctx.geometry else None
        return to_rendering(sums[:, 1:4], sums[:, 0], sums[:, 4], normal, rays.far, rays.directions)

    def _sums(self, primitives: Primitives, rays: Rays, axis: Float[Tensor, 3] | None, extra: int) -> Float[Tensor, "n c"]:
        """Sums of weights times (1, colour), and ``extra`` columns as of `kernels.gaussians.gaussian_integrals`."""
        intersections = intersect(primitives, rays)
        weights, distances = self.blending_weights(intersections, rays, axis, extra > 0)
        return weighted_sums(primitives, rays, intersections, (weights, distances), extra)

    def _parts(self, camera: Camera) -> list[Tensor]:
        """Flat indices of the pixels that are rendered together."""
        return _by_tiles(camera)


class GaussianExact(GaussianRays):
    """Integrates overlapping Gaussian densities."""

    def __init__(self, config: GaussianExactConfig) -> None:
        super().__init__(config.opacity, config.smallest, config.self_attenuation)
        self.config = config

    def blending_weights(
        self, intersections: Intersections, rays: Rays, axis: Float[Tensor, 3] | None, with_distances: bool
    ) -> Weights:
        """Integrate overlapping densities to weights (see `integrate_overlapping`), independent of order."""
        return integrate_overlapping(intersections, rays, self.config.steps, with_distances)

    @override
    def _sums(self, primitives: Primitives, rays: Rays, axis: Float[Tensor, 3] | None, extra: int) -> Float[Tensor, "n c"]:
        return gaussian_integrals(primitives, rays, self.config.steps, extra)

    @override
    def _parts(self, camera: Camera) -> list[Tensor]:
        return _compiled_parts(camera) if kernels.compiled("gaussian_integrals", camera.focal) else super()._parts(camera)

    def _list_contributions(
        self, intersections: Intersections, primitives: Primitives, rays: Rays, axis: Float[Tensor, 3]
    ) -> Contributions:
        """Contributions by distance, with the transmittance of the whole mixture."""
        weight, moment = self.blending_weights(intersections, rays, axis, True)
        order = intersections.t.argsort(stable=True)
        order = order[intersections.optical_depth[order] > 0]
        t, sigma, optical_depth, weight = (
            x[order] for x in (intersections.t, intersections.sigma, intersections.optical_depth, weight)
        )
        return Contributions(
            kind="Gaussians",
            t=t,
            begin=t - sigma,
            end=t + sigma,
            alpha=-torch.expm1(-optical_depth),
            transmittance=transmittance(t, t, sigma, optical_depth, rays),
            weight=weight,
            rgb=colours(primitives, intersections)[order],
            counted=torch.ones_like(order, dtype=torch.bool),
            distance=mean_distances(moment, order, weight, t),
            profile=density_profile(t, sigma, optical_depth, rays),
        )


class GaussianSorted(GaussianRays):
    """Composites Gaussians one after the other."""

    def __init__(self, config: GaussianSortedConfig) -> None:
        super().__init__(config.opacity, config.smallest, config.self_attenuation)
        self.config = config

    def blending_weights(
        self, intersections: Intersections, rays: Rays, axis: Float[Tensor, 3] | None, with_distances: bool
    ) -> Weights:
        """Composite front to back: w_i = alpha_i times the product of (1 - alpha_j) before it, alpha_i = 1 - exp(-tau_i)."""
        order = self.order(intersections, rays, axis)
        return composite_in_order(intersections, rays, self.config.opacity == "splat", order, with_distances)

    @override
    def _sums(self, primitives: Primitives, rays: Rays, axis: Float[Tensor, 3] | None, extra: int) -> Float[Tensor, "n c"]:
        return gaussian_composites(primitives, rays, self._axes(rays, axis), extra)

    @override
    def _parts(self, camera: Camera) -> list[Tensor]:
        return _compiled_parts(camera) if kernels.compiled("gaussian_composites", camera.focal) else super()._parts(camera)

    def order(self, intersections: Intersections, rays: Rays, axis: Float[Tensor, 3] | None) -> Int[Tensor, " p"]:
        """Sort intersections by ray, then front to back."""
        return depth_order(intersections, self._axes(rays, axis))

    def _axes(self, rays: Rays, axis: Float[Tensor, 3] | None) -> Tensor | None:
        """Directions along which centres are sorted; ``None`` where the largest responses are."""
        if self.config.order == "ray":
            return None
        return rays.directions.detach() if axis is None else axis.detach()

    def _list_contributions(
        self, intersections: Intersections, primitives: Primitives, rays: Rays, axis: Float[Tensor, 3]
    ) -> Contributions:
        """Contributions in compositing order, with the profile of the same Gaussians as overlapping densities."""
        weight, moment = self.blending_weights(intersections, rays, axis, True)
        order = self.order(intersections, rays, axis)
        order = order[intersections.optical_depth[order] > 0]  # those below the splats' limit are on the ray all the same
        t, sigma, optical_depth, weight = (
            x[order] for x in (intersections.t, intersections.sigma, intersections.optical_depth, weight)
        )
        alpha, reached = alphas_from_weights(weight)
        return Contributions(
            kind="Gaussians",
            t=t,
            begin=t - sigma,
            end=t + sigma,
            alpha=alpha,
            transmittance=reached[:-1],
            weight=weight,
            rgb=colours(primitives, intersections)[order],
            counted=torch.ones_like(order, dtype=torch.bool),
            distance=mean_distances(moment, order, weight, t),
            marched=density_profile(t, sigma, optical_depth, rays),
        )


def _clip_near(rays: Rays, ctx: Context) -> Rays:
    """Clip rays to the near distance of the bounds."""
    return rays.within(rays.near.clamp_min(ctx.bounds.near), rays.far)


def _check_smallest(smallest: float) -> None:
    if not smallest > 0:
        raise ValueError(f"smallest must be positive, not {smallest}.")


def _by_tiles(camera: Camera) -> list[Tensor]:
    """Flat pixel indices of each screen tile."""
    pixels = torch.arange(camera.width * camera.height, device=camera.focal.device).view(camera.height, camera.width)
    return [tile.reshape(-1) for row in pixels.split(TILE, dim=0) for tile in row.split(TILE, dim=1)]


def _compiled_parts(camera: Camera) -> list[Tensor]:
    """Flat pixel indices of parts that bound the memory of the compiled search's pairs; it has cells of its own."""
    return list(torch.arange(camera.width * camera.height).split(PART))
