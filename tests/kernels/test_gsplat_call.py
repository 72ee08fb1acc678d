"""How gsplat is called: a stand-in with its signatures (1.5 and 1.6), in plain torch, must give the reference's picture.

Whether gsplat's own kernels agree can only be seen on a GPU (`test_cuda_device`).
"""

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType

import pytest
import torch
from torch import Tensor

from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.kernels import reference
from invgraphics.kernels.types import Footprints

WIDTH, HEIGHT = 41, 27


def isect_tiles(means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int):
    """Tiles per Gaussian, keys (tile, depth) and Gaussians of all intersections, sorted."""
    assert means2d.shape[0] == 1
    assert radii.shape == means2d.shape
    assert radii.dtype == torch.int32
    assert depths.shape == means2d.shape[:2]
    found = []
    for i, (mean, radius, depth) in enumerate(zip(means2d[0], radii[0], depths[0].tolist(), strict=True)):
        if radius.min() <= 0:
            continue
        low = ((mean - radius) / tile_size).floor().clamp_min(0)
        high = ((mean + radius) / tile_size).ceil()
        for row in range(int(low[1]), min(int(high[1]), tile_height)):
            found += [(row * tile_width + column, depth, i) for column in range(int(low[0]), min(int(high[0]), tile_width))]
    found.sort()
    counts = torch.bincount(torch.tensor([i for _, _, i in found], dtype=torch.int64), minlength=means2d.shape[1])
    keys = torch.tensor([tile << 32 for tile, _, _ in found], dtype=torch.int64)
    return counts.int()[None], keys, torch.tensor([i for _, _, i in found], dtype=torch.int32)


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """First intersection of each tile."""
    assert n_images == 1
    tiles = torch.arange(tile_width * tile_height)
    return torch.searchsorted(isect_ids >> 32, tiles).int().view(1, tile_height, tile_width)


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, image_width: int, image_height: int, tile_size: int,
    isect_offsets: Tensor, flatten_ids: Tensor, backgrounds=None, masks=None, packed=False, absgrad=False,
):  # fmt: skip
    """Blend each pixel's tile."""
    n = means2d.shape[1]
    assert means2d.shape == (1, n, 2)
    assert conics.shape == (1, n, 3)
    assert colors.shape[:2] == (1, n)
    assert opacities.shape == (1, n)
    columns = isect_offsets.shape[2]
    ends = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    rows = []
    for y in range(image_height):
        for x in range(image_width):
            tile = y // tile_size * columns + x // tile_size
            ids = flatten_ids[ends[tile] : ends[tile + 1]].long()
            d = torch.tensor([x + 0.5, y + 0.5]) - means2d[0, ids]
            a, b, c = conics[0, ids].unbind(1)
            q = a * d[:, 0] ** 2 + 2 * b * d[:, 0] * d[:, 1] + c * d[:, 1] ** 2
            alpha = (opacities[0, ids] * torch.exp(-q / 2)).clamp_max(0.999)
            alpha = torch.where(alpha < 1 / 255, 0.0, alpha)
            after = torch.cumprod(1 - alpha, 0)
            weight = torch.where(after <= 1e-4, 0.0, alpha * torch.cat([torch.ones(1), after])[:-1])
            rows.append(torch.cat([weight @ colors[0, ids], weight.sum()[None]]))
    if absgrad:
        means2d.register_hook(lambda gradient: setattr(means2d, "absgrad", gradient.abs()))
    image = torch.stack(rows).view(1, image_height, image_width, -1)
    return image[..., :-1], image[..., -1:]


@pytest.fixture
def splat_rasterise() -> Iterator:
    """The function that calls gsplat, over the stand-in."""
    name = "invgraphics.kernels.cuda.splats"
    pytest.importorskip("triton")
    importlib.import_module("invgraphics.kernels.cuda")  # before the stand-in is there, which it would look into
    stand_in = ModuleType("gsplat")
    for function in (isect_tiles, isect_offset_encode, rasterize_to_pixels):
        setattr(stand_in, function.__name__, function)
    parts = {part: sys.modules.get(part) for part in ("gsplat", name)}
    sys.modules["gsplat"] = stand_in
    sys.modules.pop(name, None)
    yield importlib.import_module(name).splat_rasterise
    for part, module in parts.items():
        sys.modules.pop(part, None)
        if module is not None:
            sys.modules[part] = module


@pytest.fixture
def footprints() -> tuple[Footprints, Tensor]:
    """A cloud on the screen, some of it culled, none of it so opaque that the two clamps of alpha differ."""
    pose = torch.eye(4)
    pose[2, 3] = -3.0
    camera = Camera(pose, torch.tensor([40.0, 44.0]), torch.tensor([22.0, 12.0]), WIDTH, HEIGHT)
    n = 60
    gaussians = Gaussians(
        torch.randn(n, 3) * 0.7, torch.randn(n, 4), torch.exp(torch.randn(n, 3) * 0.4 - 2.0),
        torch.sigmoid(torch.randn(n)) * 0.9, torch.randn(n, 4, 3) * 0.3,
    )  # fmt: skip
    projected, rgb = reference.splat_project(gaussians, camera)
    assert 0 < int((projected.radii > 0).sum()) < n
    return projected, rgb


def test_same_picture_and_gradients(splat_rasterise, footprints) -> None:
    projected, rgb = footprints
    results = []
    for rasterise in (splat_rasterise, reference.splat_rasterise):
        names = ("means2d", "conics", "opacities")
        leaves = [getattr(projected, name).clone().requires_grad_() for name in names] + [rgb.clone().requires_grad_()]
        mine = replace(projected, **dict(zip(names, leaves[:3], strict=True)))
        image, alpha = rasterise(mine, leaves[3], WIDTH, HEIGHT)
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert alpha.shape == (HEIGHT, WIDTH)
        (image.square().sum() + alpha.sum()).backward()
        results.append([image.detach(), alpha.detach(), *(leaf.grad for leaf in leaves)])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, atol=2e-4, rtol=1e-3)


def test_absolute_gradients_are_handed_over(splat_rasterise, footprints) -> None:
    projected, rgb = footprints
    means = projected.means2d.clone().requires_grad_()
    absgrad = torch.zeros_like(means).requires_grad_()
    image, _ = splat_rasterise(replace(projected, means2d=means, absgrad=absgrad), rgb, WIDTH, HEIGHT)
    image.sum().backward()
    assert means.grad is not None
    assert absgrad.grad is not None
    torch.testing.assert_close(absgrad.grad, means.grad.abs())


def test_what_gsplat_does_not_cover_goes_to_the_reference(splat_rasterise, footprints) -> None:
    projected, rgb = footprints
    image, _ = splat_rasterise(projected, rgb, WIDTH, HEIGHT, max_grad_splats=2)
    assert torch.equal(image, reference.splat_rasterise(projected, rgb, WIDTH, HEIGHT, 16, 2)[0])
    none = replace(projected, **{name: getattr(projected, name)[:0] for name in ("means2d", "conics", "opacities", "radii")})
    none = replace(none, depths=projected.depths[:0], depth_planes=projected.depth_planes[:0])
    assert not splat_rasterise(none, rgb[:0], WIDTH, HEIGHT)[1].any()
