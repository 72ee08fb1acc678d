"""Parity of the Triton kernels with the reference; `test_cuda_interpreted` runs this in a process of its own."""

from dataclasses import replace

import torch
from torch import Tensor

from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.core.ngp import HashGrid
from invgraphics.kernels import cuda, reference
from invgraphics.kernels.types import Footprints


def differentiate(function, inputs: list[Tensor], dtype: torch.dtype) -> list[Tensor]:
    """Outputs of ``function``, and the gradients of their randomly weighted sum."""
    leaves = [x.detach().to(dtype).clone().requires_grad_() for x in inputs]
    outputs = function(*leaves)
    outputs = [x for x in (outputs if isinstance(outputs, tuple) else (outputs,)) if x is not None]
    generator = torch.Generator().manual_seed(2)
    sum((x * torch.randn(x.shape, generator=generator).to(dtype)).sum() for x in outputs).backward()
    return [x.detach() for x in outputs] + [leaf.grad for leaf in leaves if leaf.grad is not None]


def assert_equal(fast, plain, inputs: list[Tensor], tolerance: float = 1e-5) -> None:
    """Within fp32 rounding of the truth, relative to the largest entry."""
    numbers, truth = differentiate(fast, inputs, torch.float32), differentiate(plain, inputs, torch.float64)
    assert len(numbers) == len(truth) > len(inputs)
    for number, true in zip(numbers, truth, strict=True):
        assert number.shape == true.shape
        worst = (number - true).abs().max() / true.abs().max()
        assert worst <= tolerance, worst


def hash_encoding() -> None:
    corners = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 1.0, 0.0], [-3.0, 0.5, 2.0]])
    for grid in (
        HashGrid(levels=4, features=2, log2_size=8, base=4, finest=100),
        HashGrid(levels=3, features=1, log2_size=8, base=1, finest=64),
        HashGrid(levels=2, features=5, log2_size=10, base=3, finest=50),
    ):
        unit, table = torch.cat([torch.rand(300, 3) * 1.2 - 0.1, corners]), torch.randn(grid.entries, grid.features)
        assert_equal(
            lambda u, t, grid=grid: cuda.hash_encode(u, t, grid),
            lambda u, t, grid=grid: reference.hash_encode(u, t, grid),
            [unit, table],
        )


def compositing() -> None:
    counts = torch.randint(0, 80, (40,))
    counts[::7], counts[1::7], counts[-1] = 0, 1, 0
    ray = torch.repeat_interleave(torch.arange(40), counts)
    depth = torch.rand(len(ray)) ** 6 * 2
    depth[7], depth[30:40] = 1e6, 0.0
    for channels in (1, 3, 5):
        inputs = [depth, torch.randn(len(ray), channels)]
        assert_equal(lambda d, c: cuda.composite(d, c, ray, 40), lambda d, c: reference.composite(d, c, ray, 40), inputs)


def edges() -> None:
    grid = HashGrid(levels=2, log2_size=6, base=2, finest=32)
    table = torch.randn(grid.entries, 2, requires_grad=True)
    features, _ = cuda.hash_encode(torch.zeros(0, 3), table, grid)
    features.sum().backward()
    assert features.shape == (0, 4)
    assert table.grad is not None
    assert not table.grad.any()
    points = torch.rand(5, 3)
    ours, theirs = (kernels.hash_encode(points, table, grid, True) for kernels in (cuda, reference))
    assert torch.equal(ours[0], theirs[0])
    assert torch.equal(ours[1], theirs[1])
    weights, sums, alpha = cuda.composite(torch.zeros(0), torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), 4)
    assert (weights.shape, sums.shape, alpha.shape) == ((0,), (4, 3), (4,))
    assert not sums.any()
    ray, depth = torch.zeros(1000, dtype=torch.int64), torch.full((1000,), 1e-6)
    thin = cuda.composite(depth, torch.ones(1000, 1), ray, 1)[2].item()
    assert abs(thin / 9.995e-4 - 1) < 1e-4, "thin media lose their digits"


def cloud(count: int, opaque: float) -> tuple[Footprints, Tensor]:
    """A cloud on a screen of 41 by 27 pixels, some of it culled, and its colours; ``opaque`` shifts the opacities' logits."""
    pose = torch.eye(4)
    pose[2, 3] = -3.0
    camera = Camera(pose, torch.tensor([40.0, 44.0]), torch.tensor([22.0, 12.0]), 41, 27)
    gaussians = Gaussians(
        torch.randn(count, 3) * 0.7, torch.randn(count, 4), torch.exp(torch.randn(count, 3) * 0.4 - 1.7),
        torch.sigmoid(torch.randn(count) + opaque), torch.randn(count, 4, 3) * 0.3,
    )  # fmt: skip
    return reference.splat_project(gaussians, camera)


def draw(rasterise, footprints: Footprints, tile: int | None = None):
    """``rasterise`` of means, conics, opacities, features and absolute gradients, whatever their number type."""

    def function(means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, absgrad: Tensor | None = None):
        rest = {name: getattr(footprints, name).to(means2d) for name in ("depths", "depth_planes", "radii")}
        return rasterise(Footprints(means2d, conics, opacities, absgrad=absgrad, **rest), features, 41, 27, tile)

    return function


def splatting() -> None:
    # Opaque clouds end many pixels early and clamp alpha; that of 80 splats has tiles of more than one chunk.
    for opaque, channels, tile in ((0.0, 3, None), (6.0, 3, 8), (1.0, 1, 16), (1.0, 7, 32)):
        footprints, _ = cloud(80, opaque)
        assert 0 < int((footprints.radii > 0).sum()) < 80
        inputs = [footprints.means2d, footprints.conics, footprints.opacities, torch.randn(80, channels)]
        fast, plain = draw(cuda.splat_rasterise, footprints, tile), draw(reference.splat_rasterise, footprints, tile)
        assert_equal(fast, plain, inputs)
        if channels == 3:
            assert_equal(fast, plain, [*inputs, torch.zeros(80, 2)])
    left = [{"absgrad": torch.zeros(80, 2)}, {"homography": torch.eye(3).repeat(80, 1, 1)}]
    for other in (replace(footprints, **extra) for extra in left):
        ours, theirs = (kernels.splat_rasterise(other, torch.ones(80, 4), 41, 27) for kernels in (cuda, reference))
        assert torch.equal(ours[0], theirs[0])
    nothing = Footprints(*(value[:0] for value in vars(footprints).values() if value is not None))
    image, alpha = cuda.splat_rasterise(nothing, torch.zeros(0, 3), 41, 27)
    assert (image.shape, alpha.shape) == ((27, 41, 3), (27, 41))
    assert not image.any()
    assert not alpha.any()


if __name__ == "__main__":
    for check, name in ((hash_encoding, "hash"), (compositing, "composite"), (edges, "edges"), (splatting, "splats")):
        torch.manual_seed(0)  # under which no response lies so near a threshold that its two sides are one in float32
        check()
        print(name)
