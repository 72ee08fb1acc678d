"""Rasterised triangle meshes: the nearest surface at every pixel, in the interpolated colours of its vertices."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize
from typing_extensions import override

from invgraphics import kernels
from invgraphics.core import (
    Bounds,
    Camera,
    Context,
    Contributions,
    Field,
    Mesh,
    Quantity,
    Rays,
    Renderer,
    Rendering,
    Samples,
    Scene,
    Trace,
    harmonics,
)
from invgraphics.core.compositing import alphas_from_weights
from invgraphics.core.mesh import face_normals
from invgraphics.errors import NotComposableError
from invgraphics.kernels.reference.mesh import hit
from invgraphics.kernels.types import Fragments
from invgraphics.renderers.base import to_rendering
from invgraphics.renderers.volumetric import query

STRIP = 1 << 20
"""Rays of a strip of rows that is rasterised at once, at most."""


@dataclass(frozen=True)
class SurfaceConfig:
    """Rasterisation of a mesh.

    Attributes:
        supersampling: rays along either axis of a pixel, whose mean it is: without, silhouettes are as hard as stairs.
        normals: ``vertices`` interpolates the vertices' normals; ``faces`` takes the triangles' own.
        resolution: where a fitted density or distance is shown as a mesh (``--render-with``): voxels along the longest edge of
            the box from which it is extracted.
        level: its density, or signed distance; ``None`` for the usual one.
    """

    title: ClassVar[str] = "rasterised surface"

    supersampling: int = 3
    normals: Literal["vertices", "faces"] = "vertices"
    resolution: int = 192
    level: float | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.supersampling <= 8:
            raise ValueError(f"supersampling must be from 1 to 8, not {self.supersampling}.")
        if not 8 <= self.resolution <= 512:
            raise ValueError(f"resolution must be from 8 to 512 voxels, not {self.resolution}.")

    def build(self, scene: Scene) -> Surface:
        """The renderer; it needs nothing from the scene."""
        return Surface(self)


class Surface(Renderer):
    """Opaque triangles by z-buffer, seen from both sides.

    Colours are differentiable in the vertices' harmonics, exactly: pictures are linear in them. The camera's pose and the
    vertices have gradients through interpolation within triangles; silhouettes are hard and have none.
    """

    requires: ClassVar[Quantity] = Quantity.MESH

    def __init__(self, config: SurfaceConfig) -> None:
        super().__init__()
        self.config = config

    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel; with normals if ``ctx.geometry`` is set."""
        mesh: Mesh = field.primitives(Quantity.MESH, ctx)
        scale = self.config.supersampling
        fine = camera.resized(scale * camera.width, scale * camera.height)
        rows = max(1, STRIP // (fine.width * scale)) * scale
        strips = [self._strip(field, mesh, _rows(fine, top, rows), ctx) for top in range(0, fine.height, rows)]
        return _joined(strips, camera), Trace(rays=fine.width * fine.height)

    @override
    @torch.no_grad()
    def contributions(self, field: Field, camera: Camera, pixel: tuple[int, int], ctx: Context) -> Contributions:
        """The hits of the pixel's rays, nearest first, equal shares of its light; see `Renderer.contributions`."""
        patch = _pixel(camera, pixel, self.config.supersampling)
        mesh, fragments = _hits(field.primitives(Quantity.MESH, ctx), patch, patch.rays(), ctx.bounds)
        colours = kernels.mesh_interpolate(fragments, mesh.faces, self._colours(field, mesh, patch, ctx)).reshape(-1, 3)
        depth = fragments.depth.reshape(-1)
        order = depth.argsort(stable=True)[: int(depth.isfinite().sum())]
        t = depth[order]
        weight = torch.full_like(t, 1 / len(depth))
        alpha, reached = alphas_from_weights(weight)
        counted = torch.ones_like(order, dtype=torch.bool)
        return Contributions("surface points", t, t, t, alpha, reached[:-1], weight, colours[order], counted)

    def _strip(self, field: Field, mesh: Mesh, camera: Camera, ctx: Context) -> Rendering:
        """Render some rows, averaged over each pixel's rays."""
        rays = camera.rays()
        mesh, fragments = _hits(mesh, camera, rays, ctx.bounds)
        if torch.is_grad_enabled() and (mesh.vertices.requires_grad or rays.directions.requires_grad):
            fragments = differentiable(fragments, mesh, rays)
        features = [self._colours(field, mesh, camera, ctx)]
        if ctx.geometry and self.config.normals == "vertices":
            features.append(mesh.outwards())
        image = kernels.mesh_interpolate(fragments, mesh.faces, torch.cat(features, dim=1))
        seen = fragments.face >= 0
        normal = None
        if ctx.geometry:
            normal = _facing(mesh, fragments, rays)
            if self.config.normals == "vertices":
                normal = _aligned(image[..., 3:], normal)
        distance = torch.where(seen, fragments.depth, 0.0)
        return self._averaged(Rendering(image[..., :3], seen.to(image), distance, normal), rays)

    def _colours(self, field: Field, mesh: Mesh, camera: Camera, ctx: Context) -> Float[Tensor, "v 3"]:
        """Colours of vertices towards the camera: from their harmonics, else the field's radiance there."""
        directions = normalize(mesh.vertices - camera.position, dim=1)
        if mesh.sh is not None:
            return harmonics.colour(mesh.sh, directions)
        if Quantity.RADIANCE not in field.provides:
            raise NotComposableError(f"The mesh of {type(field).__name__} has no colours, and the field no radiance.")
        radiance = query(field, Samples.at(mesh.vertices, directions), Quantity.RADIANCE, ctx.chunk).radiance
        assert radiance is not None
        return radiance

    def _averaged(self, fine: Rendering, rays: Rays) -> Rendering:
        """Means over each pixel's rays, which make its colour, alpha, depth and normal."""
        scale = self.config.supersampling
        height, width = fine.alpha.shape

        def mean(values: Float[Tensor, "h w c"]) -> Float[Tensor, "h2 w2 c"]:
            if scale == 1:
                return values
            return values.view(height // scale, scale, width // scale, scale, -1).mean(dim=(1, 3))

        directions = mean(rays.directions.view(height, width, 3))
        alpha, distance = mean(fine.alpha[..., None])[..., 0], mean(fine.depth[..., None])[..., 0]
        normal = None if fine.normal is None else mean(fine.normal)
        if normal is not None:  # of two sides of an edge, or of no area
            normal = torch.where(normal.norm(dim=-1, keepdim=True) > 1e-6, normal, -directions)
        far = torch.full_like(alpha, torch.inf)
        return to_rendering(mean(fine.rgb), alpha, distance, normal, far, directions)


def _hits(mesh: Mesh, camera: Camera, rays: Rays, bounds: Bounds) -> tuple[Mesh, Fragments]:
    """The triangles that the camera sees within the bounds, and where its rays meet them."""
    interval = _interval(rays, bounds, camera)
    return visible_part(mesh, kernels.mesh_rasterise(mesh.vertices.detach(), mesh.faces, _detached(camera), interval))


def visible_part(mesh: Mesh, fragments: Fragments) -> tuple[Mesh, Fragments]:
    """The triangles that some fragment shows, with their vertices, and the fragments in their numbering."""
    shown = torch.zeros(len(mesh.faces), dtype=torch.bool, device=mesh.faces.device)
    shown[fragments.face[fragments.face >= 0]] = True
    faces = mesh.faces[shown]
    used = torch.zeros(len(mesh.vertices), dtype=torch.bool, device=faces.device)
    used[faces.reshape(-1)] = True
    number, own = _numbering(shown), _numbering(used)
    kept = {name: None if getattr(mesh, name) is None else getattr(mesh, name)[used] for name in ("vertices", "normals", "sh")}
    face = torch.where(fragments.face >= 0, number[fragments.face], -1) if len(number) else fragments.face
    return replace(mesh, faces=own[faces], **kept), replace(fragments, face=face)


def differentiable(fragments: Fragments, mesh: Mesh, rays: Rays) -> Fragments:
    """The same fragments, with gradients in vertices and rays: each ray meets its triangle's plane again."""
    pixel = (fragments.face.reshape(-1) >= 0).nonzero()[:, 0]
    corners = mesh.vertices[mesh.faces[fragments.face.reshape(-1)[pixel]]]
    barycentric, depth = hit(rays.origins[pixel], rays.directions[pixel], corners)
    flat = fragments.barycentric.reshape(-1, 3).index_copy(0, pixel, barycentric)
    t = fragments.depth.reshape(-1).index_copy(0, pixel, depth)
    return replace(fragments, barycentric=flat.view(fragments.barycentric.shape), depth=t.view(fragments.depth.shape))


def _numbering(kept: Bool[Tensor, " n"]) -> Int[Tensor, " n"]:
    """New indices of the kept ones among ``kept``."""
    return kept.cumsum(0) - 1


def _facing(mesh: Mesh, fragments: Fragments, rays: Rays) -> Float[Tensor, "h w 3"]:
    """Unit normals of the triangles that were hit, turned against the rays: they are seen from both sides. 0 without a hit."""
    own = normalize(face_normals(mesh.vertices, mesh.faces), dim=1)
    normals = torch.cat([own, own.new_zeros(1, 3)])[fragments.face]  # -1, where nothing is hit, is the last row
    return _aligned(normals, -rays.directions.view(normals.shape))


def _aligned(normals: Float[Tensor, "h w 3"], sides: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Normals turned to the sides that others point to.

    Interpolated normals follow their triangle, not the ray, beside which they may lie on either side along a silhouette.
    """
    return torch.where((normals * sides).sum(dim=2, keepdim=True) < 0, -normals, normals)


def _interval(rays: Rays, bounds: Bounds, camera: Camera) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Distances between which surfaces are seen: beyond the bounds' near, within their crop. The box itself cuts nothing."""
    rays = rays.within(rays.near.clamp_min(bounds.near), rays.far)
    if bounds.crop is not None:
        rays = replace(bounds, lo=bounds.crop[0], hi=bounds.crop[1], space="box", crop=None).clip(rays)
    shape = camera.height, camera.width
    return rays.near.detach().view(shape), rays.far.detach().view(shape)


def _rows(camera: Camera, top: int, count: int) -> Camera:
    """The camera of some rows of a picture."""
    above = camera.principal_point.new_tensor([0, top])
    return replace(camera, principal_point=camera.principal_point - above, height=min(count, camera.height - top))


def _pixel(camera: Camera, pixel: tuple[int, int], supersampling: int) -> Camera:
    """The camera of one pixel's rays."""
    fine = camera.resized(supersampling * camera.width, supersampling * camera.height)
    corner = fine.principal_point.new_tensor(pixel) * supersampling
    return replace(fine, principal_point=fine.principal_point - corner, width=supersampling, height=supersampling)


def _detached(camera: Camera) -> Camera:
    tensors = {name: getattr(camera, name).detach() for name in ("cam_to_world", "focal", "principal_point")}
    return replace(camera, **tensors)


def _joined(strips: list[Rendering], camera: Camera) -> Rendering:
    """Strips of rows, one below the other."""
    flat = [strip.reshape(strip.alpha.numel()) for strip in strips]
    return Rendering.cat(flat).reshape(camera.height, camera.width)
