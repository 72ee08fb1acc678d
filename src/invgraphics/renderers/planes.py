"""Multi-plane images, warped to the camera by homographies and composited (Szeliski and Golland 1999; Zhou et al. 2018)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from invgraphics.core import Camera, Context, Field, Planes, Quantity, Renderer, Rendering, Scene, Trace
from invgraphics.core.compositing import weights_from_alphas
from invgraphics.core.planes import warp
from invgraphics.renderers.base import MIN_SURFACE_ALPHA, normals_from_depth, to_rendering


@dataclass(frozen=True)
class PlanesConfig:
    """Planes composited through homographies; there is nothing to set."""

    title: ClassVar[str] = "planes"

    def build(self, scene: Scene) -> PlaneRenderer:
        """The renderer; it needs nothing from the scene."""
        return PlaneRenderer()


class PlaneRenderer(Renderer):
    """Samples each plane bilinearly at its homography of the pixel, and composites front to back.

    Planes at or behind the camera, and rays that run away from the planes, contribute nothing. Depth is the weighted mean of
    the distances at which the ray meets the planes; normals are the slope of the depth map.
    """

    requires: ClassVar[Quantity] = Quantity.PLANES

    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel. Depth is left at infinity in training, unless ``ctx.geometry`` is set."""
        planes: Planes = field.primitives(Quantity.PLANES, ctx)
        size = camera.width, camera.height
        maps = planes.homographies(camera)
        rgba, inside, z = warp(torch.cat([planes.rgb, planes.alpha[:, None]], dim=1), maps, size)
        ahead = (planes.depths > _depth_of(camera, planes)).to(inside.dtype)[:, None, None]
        weights = weights_from_alphas(rgba[:, 3] * inside * ahead)
        rgb = rgba[:, :3]
        if planes.coefficients is not None:
            offsets, _, _ = warp(view_dependence(planes, camera), maps, size, (planes.camera.width, planes.camera.height))
            rgb = (rgb + offsets).clamp_min(0)
        colour = torch.einsum("phw,pchw->hwc", weights, rgb)
        alpha = weights.sum(dim=0)
        far = torch.full_like(alpha, torch.inf)
        if ctx.training and not ctx.geometry:
            return Rendering(colour, alpha, far), Trace(rays=alpha.numel())
        directions = camera.rays().directions.view(camera.height, camera.width, 3)
        distance = (weights * _distances(planes, camera, z)).sum(dim=0)
        normal = None
        if ctx.geometry:
            seen = alpha >= MIN_SURFACE_ALPHA
            normal = normals_from_depth(distance / alpha.clamp_min(MIN_SURFACE_ALPHA), seen, directions)
        return to_rendering(colour, alpha, distance, normal, far, directions), Trace(rays=alpha.numel())


def view_dependence(planes: Planes, camera: Camera) -> Float[Tensor, "p 3 i j"]:
    """Colour added at the texels of the coefficients: Σ_k coefficient_k H_k(v) (NeX, Wizadwongsa et al. 2021, equation 2).

    ``v`` is the unit direction from ``camera`` to the texel, in the axes of the reference camera. NeX evaluates it at every
    pixel of every plane; here the sum is taken at the coefficients' own texels and interpolated.
    """
    assert planes.coefficients is not None
    assert planes.basis is not None
    reference, (rows, columns) = planes.camera, planes.coefficients.shape[3:]
    places = reference.resized(columns, rows)
    on_plane = (places.pixel_centres() - places.principal_point) / places.focal
    points = torch.cat([on_plane, torch.ones_like(on_plane[..., :1])], dim=-1) * planes.depths[:, None, None, None]
    centre = reference.cam_to_world[:3, :3].T @ (camera.position - reference.position)
    basis = planes.basis(normalize(points - centre, dim=-1).reshape(-1, 3)).view(len(planes), rows, columns, -1)
    return torch.einsum("pkcij,pijk->pcij", planes.coefficients, basis)


def _depth_of(camera: Camera, planes: Planes) -> Float[Tensor, ""]:
    """Position of a camera along the reference camera's optical axis."""
    return (camera.position - planes.camera.position) @ planes.camera.cam_to_world[:3, 2]


def _distances(planes: Planes, camera: Camera, z: Float[Tensor, "p h w"]) -> Float[Tensor, "p h w"]:
    """Distances along unit rays to the planes, from the homographies' third coordinate d r_z of rays with z = 1."""
    offsets = (planes.depths - _depth_of(camera, planes))[:, None, None]
    plane = (camera.pixel_centres() - camera.principal_point) / camera.focal
    length = (1 + plane.square().sum(dim=-1)).sqrt()
    return offsets * planes.depths[:, None, None] * length / torch.where(z > 0, z, 1.0)
