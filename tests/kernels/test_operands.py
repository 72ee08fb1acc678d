"""Operands that compiled kernels cannot take: of another dtype the reference computes, shapes that do not fit are refused."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invgraphics import kernels
from invgraphics.core import Bounds, Camera, Gaussians, Rays
from invgraphics.core.ngp import HashGrid
from invgraphics.kernels import dispatch
from invgraphics.kernels.gaussians import gaussian_density
from invgraphics.kernels.near import near_points
from invgraphics.kernels.segments import segment_sums
from invgraphics.kernels.types import AdamStep, Fragments, MarchSteps

pytestmark = pytest.mark.skipif("numba" not in dispatch.cpu_implementations(), reason="Numba does not work here")
GRID = HashGrid(levels=3, features=2, log2_size=8, base=2, finest=20)
RAY = torch.tensor([0, 0, 1, 1, 2, 2])
CAMERA = Camera(torch.eye(4), torch.full((2,), 20.0), torch.full((2,), 8.0), 16, 16)


def rand(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(sum(shape)))


def adam(values: Tensor, gradient: Tensor) -> Tensor:
    moments = torch.zeros_like(values), torch.zeros_like(values)
    values = values.clone()
    kernels.adam_rows(values, gradient, moments, AdamStep(0.1, 0.9, 0.99, 1e-15, 1))
    return torch.cat([values, *moments])


def splats(n: int = 6) -> Gaussians:
    means = rand(n, 3) + torch.tensor([-0.5, -0.5, 2.0])
    return Gaussians(means, rand(n, 4) - 0.5, 0.1 * rand(n, 3) + 0.05, rand(n), rand(n, 4, 3))


def picture(means: Tensor, features: Tensor) -> Tensor:
    footprints, _ = kernels.splat_project(replace(splats(), means=means), CAMERA)
    return kernels.splat_rasterise(footprints, features, 16, 16)[0]


MIXED: dict[str, tuple[Callable[..., Tensor], list[Tensor]]] = {
    "ssim": (kernels.ssim, [rand(20, 20, 3), rand(20, 20, 3) ** 2]),
    "composite": (lambda tau, channels: kernels.composite(tau, channels, RAY, 3)[1], [rand(6), rand(6, 3)]),
    "segments": (lambda values, weights: segment_sums(values, weights, RAY, 3), [rand(6, 3), rand(6)]),
    "adam": (adam, [rand(5, 2), rand(5, 2) - 0.5]),
    "rasterise": (picture, [splats().means, rand(6, 3)]),
    "density": (lambda x, eye: gaussian_density(splats(), x, eye, 1e-3), [splats().means, rand(6, 3)]),
    "near": (lambda x, points: near_points(x, points, 2, 0.5)[1], [rand(5, 3), rand(9, 3) ** 2]),
}


REFUSED_DTYPES = {
    "rasterise": (torch.float64, torch.float16),
    "segments": (torch.float64,),
    "density": (torch.float64,),
    "composite": (torch.float16,),
}
"""Mixtures of which torch itself complains in the reference."""


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
@pytest.mark.parametrize("name", MIXED)
def test_a_second_operand_of_another_dtype_changes_no_result(name: str, dtype: torch.dtype) -> None:
    """Its bytes were read as float32. Where the reference has no rule for the mixture, torch's error about dtypes is right."""
    function, (first, second) = MIXED[name]
    second = second.to(dtype).float()  # the same numbers, as far as the dtype holds them
    expected = function(first, second)
    if dtype in REFUSED_DTYPES.get(name, ()):
        with pytest.raises(RuntimeError, match=r"dtype|scalar type|Float|Double|Half"):
            function(first, second.to(dtype))
        return
    found = function(first, second.to(dtype))
    torch.testing.assert_close(found.float(), expected.float(), atol=2e-3, rtol=2e-3, equal_nan=True)


def test_a_table_of_another_dtype_is_refused_or_read_right() -> None:
    unit, table = rand(7, 3), rand(GRID.entries, 2)
    expected = kernels.hash_encode(unit, table, GRID)[0]
    try:
        found = kernels.hash_encode(unit, table.double(), GRID)[0]
    except RuntimeError:
        return
    torch.testing.assert_close(found.float(), expected)


def test_registers_are_loaded_from_float32_alone() -> None:
    """Below the dispatcher, where nothing else looks at dtypes."""
    from invgraphics.kernels import numba
    from invgraphics.kernels.numba.runtime import compile_here

    compile_here()
    with pytest.raises(Exception, match="array of float32"):
        numba.ssim(rand(20, 20, 3), rand(20, 20, 3).double())


def boxed_rays(n: int) -> Rays:
    return Bounds(torch.zeros(3), torch.ones(3)).clip(Rays.make(rand(n, 3), torch.nn.functional.normalize(rand(n, 3), dim=1)))


def march(cells: tuple[int, int, int], start: int) -> None:
    rays, occupied = boxed_rays(5), torch.ones(cells, dtype=torch.bool)
    kernels.ray_march(rays, occupied, Bounds(torch.zeros(3), torch.ones(3)), MarchSteps(0.1), rand(start))


def fragments(weights: int) -> None:
    faces, face = torch.tensor([[0, 1, 2]]), torch.zeros(4, 4, dtype=torch.int64)
    kernels.mesh_interpolate(Fragments(face, rand(4, weights, 3), rand(4, 4)), faces, rand(3, 2))


def rows(count: int, number: int, rates: int = 9) -> None:
    values, moments, which = rand(9, 2), (rand(9, 2), rand(9, 2)), torch.tensor([0, number])
    kernels.adam_rows(values, rand(count, 2), moments, AdamStep(0.1, 0.9, 0.99, 1e-15, 1), rand(rates), which)


REFUSED: dict[str, Callable[[], object]] = {
    "fewer channels": lambda: kernels.composite(rand(6), rand(4, 3), RAY, 3),
    "fewer ray indices": lambda: kernels.composite(rand(6), rand(6, 3), RAY[:4], 3),
    "fewer weights": lambda: segment_sums(rand(6, 2), rand(4), RAY, 3),
    "a short table": lambda: kernels.hash_encode(rand(5, 3), rand(GRID.entries - 1, 2), GRID),
    "positions in a plane": lambda: kernels.hash_encode(rand(5, 2), rand(GRID.entries, 2), GRID),
    "a smaller target": lambda: kernels.ssim(rand(20, 20, 3), rand(10, 20, 3)),
    "fewer features": lambda: picture(splats().means, rand(4, 3)),
    "fewer quaternions": lambda: kernels.splat_project(replace(splats(), quaternions=rand(4, 4)), CAMERA),
    "fewer eyes": lambda: gaussian_density(splats(), rand(5, 3), rand(4, 3), 1e-3),
    "points in a plane": lambda: near_points(rand(5, 3), rand(5, 2), 1, 0.5),
    "a smaller gradient": lambda: adam(rand(5, 2), rand(4, 2)),
    "no gradient for a row": lambda: rows(1, 3),
    "a row that is not there": lambda: rows(2, 9),
    "fewer rates": lambda: rows(2, 3, rates=8),
    "cells that are no cube": lambda: march((8, 4, 4), 5),
    "fewer starts": lambda: march((8, 8, 8), 4),
    "fewer fragments' weights": lambda: fragments(3),
}


@pytest.mark.parametrize("name", REFUSED)
def test_shapes_that_do_not_fit_are_refused(name: str) -> None:
    with pytest.raises((ValueError, IndexError)):
        REFUSED[name]()


def test_shapes_that_fit_are_taken() -> None:
    march((8, 8, 8), 5)
    fragments(4)
    rows(2, 8)
