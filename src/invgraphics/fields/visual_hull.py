"""Visual hull of the training views' silhouettes, carved from a grid of voxels, with colours from the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from invgraphics import kernels
from invgraphics.core.camera import Camera
from invgraphics.core.mesh import Mesh
from invgraphics.core.scene import Scene, View
from invgraphics.errors import InputError
from invgraphics.fields.isosurface import Extracted, VoxelGrid, marching_cubes, without_specks

CARVED = 0.02
"""Coverage below which a voxel is empty for good, and is not tested against further views."""
UNSEEN_GREY = 0.5
"""Colour of vertices that no photograph shows."""
CHUNK = 1 << 20
"""Voxels that are projected together."""


@torch.no_grad()
def visual_hull(scene: Scene, resolution: int) -> Extracted:
    """Carve the visual hull (Laurentini 1994): what lies inside every training view's silhouette.

    A voxel's coverage is the least alpha at its centre's image in any view, bilinear between pixels; the surface is where it is
    1/2. Views outside whose picture it falls do not count; where no view sees it, it is empty. Concavities that no silhouette
    shows are filled.

    Args:
        scene: with alpha in its training views.
        resolution: voxels along the longest edge of its bounds' box.

    Raises:
        InputError: the photographs are opaque, or their silhouettes leave nothing.
    """
    if not scene.has_alpha:
        raise InputError(
            f"The photographs of scene '{scene.name}' are opaque: they show no silhouettes from which a mesh could be carved.",
            "Use --set field.source=RUN, the folder of a run with a density or a signed distance, or a mesh file.",
        )
    grid = VoxelGrid.across(scene.bounds, resolution)
    coverage = torch.ones(len(grid))
    seen = torch.zeros(len(grid), dtype=torch.bool)
    for view in scene.train:
        layers = _silhouette(view)
        alive = (coverage > CARVED).nonzero()[:, 0]
        for part in alive.split(CHUNK):
            alpha, inside = _silhouette_at(grid.at(part), view, layers)
            coverage[part] = torch.where(inside, torch.minimum(coverage[part], alpha), coverage[part])
            seen[part] |= inside
    volume = pad(torch.where(seen, coverage, 0.0).view(grid.shape), (1,) * 6)
    remedy = "Check the photographs' transparency and poses, or use --set field.source=RUN."
    vertices, faces = marching_cubes(volume, 0.5, "The visual hull of the training views", remedy)
    return without_specks(Mesh(grid.origin + grid.step * (vertices - 1), faces))


def _silhouette(view: View) -> Float[Tensor, "c h w"]:
    """A view's alpha, and its mask where it has one."""
    return torch.stack([view.opacity()] if view.mask is None else [view.opacity(), view.mask.float()])


def _silhouette_at(
    points: Float[Tensor, "n 3"], view: View, layers: Float[Tensor, "c h w"]
) -> tuple[Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Alpha at the images of points, bilinear between pixel centres, and whether the view says anything about each."""
    camera = view.camera
    place, z = camera.project(points)
    size = torch.tensor([camera.width, camera.height], dtype=place.dtype)
    inside = (z > 0) & (place >= 0).all(dim=1) & (place <= size).all(dim=1)
    at = torch.where(inside[:, None], 2 * place / size - 1, 0.0).float()
    values = grid_sample(layers[None], at[None, None], padding_mode="border", align_corners=False)[0, :, 0]
    return values[0], inside if view.mask is None else inside & (values[1] > 0.5)


def photograph_colours(mesh: Mesh, views: Sequence[View], near: float) -> Float[Tensor, "v 3"]:
    """Mean colour of each vertex in the photographs that see it, weighted by its share of every pixel and the pixel's alpha.

    Args:
        mesh: its colours are not looked at.
        views: the photographs.
        near: distance from a camera within which nothing is seen.

    Returns:
        Straight colours in the views' colour space; grey where no photograph shows the vertex.
    """
    sums = torch.zeros(len(mesh.vertices), 4)
    for view in views:
        fragments = kernels.mesh_rasterise(mesh.vertices, mesh.faces, view.camera, constant_interval(view.camera, near))
        weight = view.opacity() * view.valid()
        light = torch.cat([view.colour() * weight[..., None], weight[..., None]], dim=2)
        # The transpose of interpolation is its gradient.
        with torch.enable_grad():
            shares = torch.zeros(len(mesh.vertices), 4, requires_grad=True)
            kernels.mesh_interpolate(fragments, mesh.faces, shares).backward(light)
        assert shares.grad is not None
        sums += shares.grad
    return torch.where(sums[:, 3:] > 0, sums[:, :3] / sums[:, 3:].clamp_min(1e-6), UNSEEN_GREY)


def constant_interval(camera: Camera, near: float) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """The same nearest distance for every pixel, and no farthest one."""
    lo = camera.focal.new_full((camera.height, camera.width), near)
    return lo, torch.full_like(lo, torch.inf)


def with_photograph_colours(mesh: Mesh, scene: Scene) -> Mesh:
    """The mesh in its mean colours in the training photographs (see `photograph_colours`)."""
    rgb = photograph_colours(mesh, scene.train, scene.bounds.near)
    return replace(mesh, sh=Mesh.coloured(mesh.vertices, mesh.faces, rgb).sh)
