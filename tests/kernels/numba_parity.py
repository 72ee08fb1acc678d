"""Parity of Numba's kernels with the reference for whatever processor NUMBA_CPU_NAME says; run by `test_instruction_sets`.

Arguments: ``samples``, ``hashing``, ``fields`` or ``pictures``; the widest vector registers that machine code may name: xmm,
ymm or zmm.
"""

import sys
from importlib import import_module

import torch
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.core.lattice import Lattice
from invgraphics.core.ngp import FusedNGP, HashGrid
from invgraphics.core.rays import Rays
from invgraphics.kernels import numba, reference
from invgraphics.kernels.numba.runtime import compile_here
from invgraphics.kernels.types import MarchSteps

WIDER = {"xmm": ("ymm", "zmm"), "ymm": ("zmm",), "zmm": ()}


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
    for number, true in zip(numbers, truth, strict=True):
        worst = (number - true).abs().max() / true.abs().max()
        assert worst <= tolerance, worst


GRID = HashGrid(levels=4, features=2, log2_size=8, base=4, finest=100)


def hashing() -> list[str]:
    """Hash encoding; returns the machine code."""
    unit = torch.rand(200, 3) * 1.2 - 0.1
    ours, theirs = (lambda t, k=k: k.hash_encode(unit.to(t.dtype), t, GRID) for k in (numba, reference))
    assert_equal(ours, theirs, [torch.randn(GRID.entries, 2)])
    return assembly("hash.encode.encode", "hash.encode.encode_backward")


def samples() -> list[str]:
    """Marching and compositing; returns the machine code."""
    (bounds, rays), occupied = box_of_rays(), torch.rand(24, 24, 24) < 0.05
    ours, theirs = (k.ray_march(rays, occupied, bounds, MarchSteps(0.01), rays.near) for k in (numba, reference))
    assert len(ours.ray) > 0
    assert all(torch.equal(getattr(ours, name), getattr(theirs, name)) for name in ("ray", "t0", "t1", "resume"))
    ray = torch.repeat_interleave(torch.arange(30), torch.randint(0, 40, (30,)))
    inputs = [torch.rand(len(ray)) ** 6 * 2, torch.randn(len(ray), 4)]
    assert_equal(lambda d, c: numba.composite(d, c, ray, 30), lambda d, c: reference.composite(d, c, ray, 30), inputs)
    return assembly("rays.march.traverse", "rays.composite.accumulate", "rays.composite.accumulate_backward")


def fields() -> list[str]:
    """Lattices, and pictures of hash grids; returns the machine code."""
    unit = torch.rand(200, 3) * 1.2 - 0.1
    plane, line = [torch.randn(5, 6, 21), torch.randn(7, 21)]
    ours, theirs = (
        lambda p, q, k=k: k.lattice_encode(unit.to(p.dtype), [Lattice(p, "xy"), Lattice(q, "z")], "vm")
        for k in (numba, reference)
    )
    assert_equal(ours, theirs, [plane, line])
    networks = [((torch.randn(16, 8), torch.randn(16)), (torch.randn(4, 16), torch.randn(4)))]
    networks += [((torch.randn(5, 7), torch.randn(5)), (torch.randn(3, 5), torch.randn(3)))]
    field = FusedNGP(torch.randn(GRID.entries, 2), GRID, *networks, "exp", -2.0, 2, "srgb")
    bounds, rays = box_of_rays()
    call = rays, torch.rand(8, 8, 8) < 0.5, bounds, MarchSteps(0.05), field
    for number, true in zip(numba.ngp_render(*call), reference.ngp_render(*call), strict=True):
        assert true.abs().max() > 0.1
        assert (number - true).abs().max() <= 1e-4 * true.abs().max()
    return assembly("lattice.encode.encode", "lattice.backward.feature_gradients", "ngp.render.render")


def box_of_rays() -> tuple[Bounds, Rays]:
    """Rays from all around into a box."""
    bounds, origins = Bounds(-torch.ones(3), torch.ones(3)), torch.nn.functional.normalize(torch.randn(60, 3), dim=1) * 3
    return bounds, bounds.clip(Rays.make(origins, torch.nn.functional.normalize(torch.randn(60, 3) * 0.4 - origins, dim=1)))


def pictures() -> list[str]:
    """Splatting and SSIM; returns the machine code."""
    pose = torch.eye(4)
    pose[2, 3] = -3.0
    camera = Camera(pose, torch.tensor([70.0, 75.0]), torch.tensor([35.0, 20.0]), 61, 45)
    n = 150
    leaves = [
        torch.randn(n, 3) * 0.6, torch.randn(n, 4), torch.exp(torch.randn(n, 3) * 0.5 - 2.5),
        torch.sigmoid(torch.randn(n) * 2), torch.randn(n, 9, 3) * 0.3,
    ]  # fmt: skip

    def render(kernels, *tensors: Tensor):
        eye = camera.to(tensors[0].dtype)
        footprints, rgb = kernels.splat_project(Gaussians(*tensors), eye)
        return kernels.splat_rasterise(footprints, rgb, 61, 45)

    assert_equal(lambda *x: render(numba, *x), lambda *x: render(reference, *x), leaves, 2e-4)
    target = torch.rand(37, 45, 3)
    assert_equal(lambda x: numba.ssim(x, target), lambda x: reference.ssim(x, target.double()), [torch.rand(37, 45, 3)])
    return assembly("splat.raster.rasterise", "splat.raster_backward.rasterise_backward")


def assembly(*names: str) -> list[str]:
    """Machine code of everything that kernels, named ``module.function``, were compiled to."""
    code = []
    for name in names:
        module, _, function = name.rpartition(".")
        # By path: the package's attributes of these names are its operations.
        kernel = getattr(import_module(f"invgraphics.kernels.numba.{module}"), function)
        code += kernel.inspect_asm().values()
    return code


if __name__ == "__main__":
    compile_here()  # cached kernels have no assembly to look at
    torch.manual_seed(0)
    part, widest = sys.argv[1:]
    code = {"samples": samples, "hashing": hashing, "fields": fields, "pictures": pictures}[part]()
    assert code, "nothing was compiled"
    for register in WIDER[widest]:
        assert not any(f"%{register}" in text for text in code), f"{register} registers are used"
    used = [text for text in code if f"%{widest}" in text]
    print(f"{part} {widest} {'vectorised' if used else 'scalar'}")
