"""Parity of Triton's kernels with the reference: in a process of its own (`test_cuda_interpreted`), or on a GPU."""

from dataclasses import replace
from functools import partial

import torch
from lattice_cases import VM_AXES, derivatives, lattice, linked
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.core.lattice import Lattice
from invgraphics.core.ngp import HashGrid
from invgraphics.core.rays import Rays
from invgraphics.kernels import cuda, reference
from invgraphics.kernels.types import Footprints, MarchSteps


def randn(*shape: int) -> Tensor:
    """Normal numbers that are the same on every device."""
    return torch.randn(shape, device="cpu").to(torch.get_default_device())


def rand(*shape: int) -> Tensor:
    """Numbers in [0, 1) that are the same on every device."""
    return torch.rand(shape, device="cpu").to(torch.get_default_device())


def differentiate(function, inputs: list[Tensor], dtype: torch.dtype) -> list[Tensor]:
    """Outputs of ``function``, and the gradients of their randomly weighted sum."""
    leaves = [x.detach().to(dtype).clone().requires_grad_() for x in inputs]
    outputs = function(*leaves)
    outputs = [x for x in (outputs if isinstance(outputs, tuple) else (outputs,)) if x is not None]
    generator = torch.Generator("cpu").manual_seed(2)
    sum((x * torch.randn(x.shape, generator=generator, device="cpu").to(x)).sum() for x in outputs).backward()
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
        unit, table = torch.cat([rand(300, 3) * 1.2 - 0.1, corners]), randn(grid.entries, grid.features)
        assert_equal(
            lambda u, t, grid=grid: cuda.hash_encode(u, t, grid),
            lambda u, t, grid=grid: reference.hash_encode(u, t, grid),
            [unit, table],
        )


def compositing() -> None:
    counts = torch.randint(0, 80, (40,), device="cpu").to(torch.get_default_device())
    counts[::7], counts[1::7], counts[-1] = 0, 1, 0
    ray = torch.repeat_interleave(torch.arange(40), counts)
    depth = rand(len(ray)) ** 6 * 2
    depth[7], depth[30:40] = 1e6, 0.0
    for channels in (1, 3, 5):
        inputs = [depth, randn(len(ray), channels)]
        assert_equal(lambda d, c: cuda.composite(d, c, ray, 40), lambda d, c: reference.composite(d, c, ray, 40), inputs)


def edges() -> None:
    grid = HashGrid(levels=2, log2_size=6, base=2, finest=32)
    table = randn(grid.entries, 2).requires_grad_()
    features, _ = cuda.hash_encode(torch.zeros(0, 3), table, grid)
    features.sum().backward()
    assert features.shape == (0, 4)
    assert table.grad is not None
    assert not table.grad.any()
    slopes = []
    for kernels, dtype in ((cuda, torch.float32), (reference, torch.float64)):
        places = torch.linspace(0.1, 0.9, 12).reshape(3, 4).T.to(dtype).requires_grad_()
        entries = table.detach().to(dtype).T.contiguous().T.requires_grad_()  # both column by column in memory
        (slope,) = torch.autograd.grad(kernels.hash_encode(places, entries, grid)[0].square().sum(), places, create_graph=True)
        slopes.append(torch.autograd.grad(slope.square().sum(), (entries, places)))
    for ours, theirs in zip(*slopes, strict=True):
        assert (ours - theirs).abs().max() <= 1e-5 * theirs.abs().max()
    points = rand(5, 3)
    ours, theirs = (kernels.hash_encode(points, table, grid, True) for kernels in (cuda, reference))
    assert torch.equal(ours[0], theirs[0])
    assert torch.equal(ours[1], theirs[1])
    weights, sums, alpha = cuda.composite(torch.zeros(0), torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), 4)
    assert (weights.shape, sums.shape, alpha.shape) == ((0,), (4, 3), (4,))
    assert not sums.any()
    ray, depth = torch.zeros(1000, dtype=torch.int64), torch.full((1000,), 1e-6)
    thin = cuda.composite(depth, torch.ones(1000, 1), ray, 1)[2].item()
    assert abs(thin / 9.995e-4 - 1) < 1e-4, "thin media lose their digits"


def odd_numbers() -> None:
    """NaN stays on its ray, a footprint without area has finite gradients, and no second derivative is silently zero."""
    depth, ray = torch.tensor([0.5, float("nan"), 0.3, 0.2, float("inf"), 0.1]), torch.tensor([0, 0, 0, 1, 1, 2])
    (ours, _, ends), (theirs, _, _) = (kernels.composite(depth, torch.ones(6, 1), ray, 3) for kernels in (cuda, reference))
    assert ours.isnan().nonzero().flatten().tolist() == [1, 2]  # the reference loses all rays behind
    torch.testing.assert_close(ours[0], theirs[0])
    assert ends.isnan().tolist() == [True, False, False]
    channels = rand(6, 1).requires_grad_()
    (gradient,) = torch.autograd.grad(cuda.composite(rand(6), channels, ray, 3)[1].sum(), channels, create_graph=True)
    assert gradient.requires_grad
    edge_on = [[0.0, 0.0, 2.0]], [[1.0, 0.0, 0.0, 0.0]], [[0.1, 0.0, 0.1]], [0.9], [[[0.0, 0.0, 0.0]]]
    leaves = [torch.tensor(values, requires_grad=True) for values in edge_on]
    view = Camera(torch.eye(4), torch.full((2,), 100.0), torch.full((2,), 32.0), 64, 64)
    footprints, _ = cuda.splat_project(Gaussians(*leaves), view, 0.3, True)
    (footprints.conics.sum() + footprints.opacities.sum()).backward()
    assert all(leaf.grad is not None and bool(leaf.grad.isfinite().all()) for leaf in leaves[:4])


def lattices() -> None:
    unit = torch.cat([rand(150, 3) * 1.2 - 0.1, torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 1.0, 0.0]])])
    sparse, one = linked(12), Lattice(randn(1, 4, 1, 3), "zyx")
    for combine, several in (
        ("concat", [lattice("xyz", 5), lattice("zx", 16), lattice("y", 1), sparse, one]),
        ("sum", [lattice(axes, 20) for axes in ("xy", "xz", "yz")]),
        ("vm", [lattice(axes, 3) for axes in VM_AXES]),
        ("cp", [lattice(axes, 8) for axes in "xyz"]),
    ):

        def encode(function, unit, *features, several=several, combine=combine):
            return function(unit, [replace(x, features=f) for x, f in zip(several, features, strict=True)], combine)

        inputs = [unit, *(x.features for x in several)]
        assert_equal(lambda *x: encode(cuda.lattice_encode, *x), lambda *x: encode(reference.lattice_encode, *x), inputs)
        ours, theirs = (
            derivatives(kernels, unit.T.contiguous().T, several, combine, dtype)  # positions column by column in memory
            for kernels, dtype in ((cuda, torch.float32), (reference, torch.float64))
        )
        assert len(ours) == len(theirs) > 2 + len(several)
        assert all((a - b).abs().max() <= 1e-5 * b.abs().max() for a, b in zip(ours, theirs, strict=True))
    odd = torch.tensor([[float("nan"), 0.2, 0.3], [0.4, 0.5, 0.6]])
    ours, theirs = (kernels.lattice_encode(odd, [one]) for kernels in (cuda, reference))
    torch.testing.assert_close(ours, theirs)
    assert cuda.lattice_encode(unit[:0], [sparse]).shape == (0, 12)


def marching() -> None:
    count = 70
    directions = torch.nn.functional.normalize(randn(count, 3), dim=1)
    origins = torch.tensor([0.3, -0.2, 0.1]) + rand(count, 3) * 0.5 - 1.5 * directions
    occupied = torch.nn.functional.interpolate((rand(1, 1, 4, 4, 4) < 0.4).float(), scale_factor=4)[0, 0] > 0
    for space, steps in (
        ("box", MarchSteps(0.03)),
        ("box", MarchSteps(0.03, limit=5)),
        ("box", MarchSteps(0.02, cone=1 / 64)),
        ("contracted", MarchSteps(0.1, cone=1 / 16)),
        ("contracted", MarchSteps(0.08, contracted=True)),
    ):
        bounds = Bounds(torch.tensor([-0.8, -1.0, -0.9]), torch.tensor([1.2, 0.7, 1.1]), space)
        rays = bounds.clip(Rays.make(origins, directions))
        start = rays.near + 0.01 * rand(count)
        ours, theirs = (kernels.ray_march(rays, occupied, bounds, steps, start) for kernels in (cuda, reference))
        assert len(ours.ray) > 100
        assert torch.equal(ours.ray, theirs.ray)
        # Far away a step that is even after contraction multiplies what was rounded before it.
        relative = 5e-3 if steps.contracted else 1e-5
        for name in ("t0", "t1", "resume"):
            torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=relative, atol=1e-5)
    none = cuda.ray_march(rays[:0], occupied, bounds, steps, start[:0])
    assert (len(none.ray), len(none.resume)) == (0, 0)
    empty = cuda.ray_march(rays, ~torch.ones_like(occupied), bounds, steps, start)
    assert len(empty.ray) == 0
    torch.testing.assert_close(empty.resume, rays.far)


def view_of_cloud() -> Camera:
    pose = torch.eye(4)
    pose[:3] = torch.tensor([[0.8, 0.0, 0.6, -1.5], [0.36, 0.8, -0.48, 1.2], [-0.48, 0.6, 0.64, -1.9]])
    return Camera(pose, torch.tensor([40.0, 44.0]), torch.tensor([22.0, 12.0]), 41, 27)


def project(function, settings, visible: Tensor, opacities: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Footprints and colours of the ``visible`` primitives, zeros for what is culled, whose numbers mean nothing."""
    means, quaternions, scales, sh, pose = tensors
    like, camera = means, view_of_cloud()
    eye = Camera(pose, camera.focal.to(like), camera.principal_point.to(like), camera.width, camera.height)
    f, rgb = function(Gaussians(means, quaternions, scales, opacities.to(like), sh), eye, *settings)
    parts = (f.means2d, f.conics, f.opacities[:, None], f.depths[:, None], f.depth_planes, rgb)
    return *(torch.where(visible[:, None], part, 0.0) for part in parts), f.radii.detach()


def projection() -> None:
    count = 150
    for degree, *settings in ((0, 0.3, False), (1, 0.1, True), (2, 0.0, False), (3, 0.3, True)):
        scales = torch.exp(randn(count, 3) * 0.6 - 2.0)
        scales[::9, 0] = 1e-5  # discs, some of which are seen edge-on
        opacities = torch.sigmoid(randn(count) * 2)
        inputs = [randn(count, 3) * 0.9, randn(count, 4) * 2, scales, randn(count, (degree + 1) ** 2, 3) * 0.7]
        camera = view_of_cloud()
        visible = reference.splat_project(Gaussians(*inputs[:3], opacities, inputs[3]), camera, *settings)[0].radii > 0
        assert 20 < int(visible.sum()) < count
        fast, plain = (partial(project, k.splat_project, settings, visible, opacities) for k in (cuda, reference))
        assert_equal(fast, plain, [*inputs, camera.cam_to_world])
    culled = cuda.splat_project(Gaussians(*inputs[:3], torch.zeros(count), inputs[3]), camera)[0]
    assert not culled.radii.any()
    nothing, rgb = cuda.splat_project(Gaussians(*(x[:0] for x in (*inputs[:3], opacities, inputs[3]))), camera)
    assert (len(nothing), rgb.shape) == (0, (0, 3))


def cloud(count: int, opaque: float) -> tuple[Footprints, Tensor]:
    """A cloud on a screen of 41 by 27 pixels, some of it culled, and its colours; ``opaque`` shifts the opacities' logits."""
    gaussians = Gaussians(
        randn(count, 3) * 0.7, randn(count, 4), torch.exp(randn(count, 3) * 0.4 - 1.7),
        torch.sigmoid(randn(count) + opaque), randn(count, 4, 3) * 0.3,
    )  # fmt: skip
    return reference.splat_project(gaussians, view_of_cloud())


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
        inputs = [footprints.means2d, footprints.conics, footprints.opacities, randn(80, channels)]
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


CHECKS = {
    "hash": hash_encoding,
    "composite": compositing,
    "edges": edges,
    "odd": odd_numbers,
    "march": marching,
    "lattices": lattices,
    "splats": splatting,
    "projection": projection,
}


def check(name: str) -> None:
    """Run one of `CHECKS`, on torch's default device."""
    torch.manual_seed(0)  # under which no response lies so near a threshold that its two sides are one in float32
    CHECKS[name]()


if __name__ == "__main__":
    for name in CHECKS:
        check(name)
        print(name)
