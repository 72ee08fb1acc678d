"""Compiles every launch of Triton's kernels for a GPU, without one; `test_cuda_interpreted` runs this in its own process.

The interpreter accepts Python that the compiler does not. What the launches would write is never written, so that no number
here means anything.
"""

from typing import Any

import torch
from lattice_cases import lattice, linked
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile
from triton.runtime.jit import JITFunction
from triton_parity import cloud, view_of_cloud

from invgraphics.core.bounds import Bounds
from invgraphics.core.field import Gaussians
from invgraphics.core.ngp import HashGrid
from invgraphics.core.rays import Rays
from invgraphics.kernels import cuda
from invgraphics.kernels.types import MarchSteps

AMPERE = GPUTarget("cuda", 80, 32)
TYPES = {torch.float32: "*fp32", torch.int32: "*i32", torch.int64: "*i64", torch.uint8: "*u8", int: "i32", float: "fp32"}
compiled: dict[tuple[Any, ...], str] = {}


def compile_only(kernel: JITFunction, *args: Any, grid: Any, warmup: bool, **options: Any) -> None:
    """What a launch does instead of launching."""
    values = dict(zip(kernel.arg_names, args, strict=False)) | {k: v for k, v in options.items() if k in kernel.arg_names}
    fixed = {parameter.name for parameter in kernel.params if parameter.is_constexpr}
    of = {name: x.dtype if isinstance(x, torch.Tensor) else type(x) for name, x in values.items()}
    signature = {name: "constexpr" if name in fixed else TYPES[of[name]] for name in kernel.arg_names}
    constants = {(kernel.arg_names.index(name),): values[name] for name in fixed}
    key = (kernel.fn.__name__, *signature.values(), *sorted(constants.items()))
    if key not in compiled:
        settings = {"num_warps": options["num_warps"]} if "num_warps" in options else {}
        source = ASTSource(fn=kernel, signature=signature, constexprs=constants)
        compiled[key] = compile(source, target=AMPERE, options=settings).asm["ptx"]


def launch_everything() -> None:
    """Every kernel, forward and backward, in each of its variants."""
    unit, grid = torch.rand(300, 3, requires_grad=True), HashGrid(levels=4, log2_size=8, base=4, finest=100)
    cuda.hash_encode(unit, torch.randn(grid.entries, 2, requires_grad=True), grid)[0].sum().backward()
    ray = torch.arange(40).repeat_interleave(3)
    cuda.composite(torch.rand(120, requires_grad=True), torch.rand(120, 3), ray, 40)[1].sum().backward()
    several = [lattice(axes, 5) for axes in ("x", "zy", "xyz")] + [linked(5)]
    for needs_positions in (True, False):
        for one in several:
            one.features.requires_grad_()
        cuda.lattice_encode(unit.detach().requires_grad_(needs_positions), several).sum().backward()
    for space, steps in (
        ("box", MarchSteps(0.1)),
        ("box", MarchSteps(0.1, cone=0.1)),
        ("contracted", MarchSteps(0.1, cone=0.1)),
        ("contracted", MarchSteps(0.1, contracted=True)),
    ):
        bounds = Bounds(-torch.ones(3), torch.ones(3), space)
        rays = bounds.clip(Rays.make(torch.zeros(9, 3), torch.eye(3).repeat(3, 1)))
        cuda.ray_march(rays, torch.ones(4, 4, 4, dtype=torch.bool), bounds, steps, rays.near)
    footprints, rgb = cloud(20, 0.0)
    for absgrad in (None, torch.zeros(20, 2, requires_grad=True)):
        means2d = footprints.means2d.detach().requires_grad_()
        drawn = type(footprints)(**{**vars(footprints), "means2d": means2d, "absgrad": absgrad})
        cuda.splat_rasterise(drawn, rgb.detach(), 41, 27)[0].sum().backward()
    for degree in range(4):
        shapes = (20, 3), (20, 4), (20, 3), (20,), (20, (degree + 1) ** 2, 3)
        gaussians = Gaussians(*(torch.rand(shape, requires_grad=True) for shape in shapes))
        for antialiased in (False, True):
            cuda.splat_project(gaussians, view_of_cloud(), 0.3, antialiased)[0].conics.sum().backward()


if __name__ == "__main__":
    JITFunction.run = compile_only
    launch_everything()
    assert all(".target sm_80" in ptx for ptx in compiled.values())
    print(*sorted({key[0] for key in compiled}))
