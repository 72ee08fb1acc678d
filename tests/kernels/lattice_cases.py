"""Lattices for the tests, and derivatives of their encoding to second order."""

from dataclasses import replace

import torch
from torch import Tensor

from invgraphics.core.lattice import Combination, Lattice

VM_AXES = ("xy", "z", "xz", "y", "yz", "x")


def lattice(axes: str, channels: int, sizes: tuple[int, ...] = (5, 6, 7)) -> Lattice:
    """A random lattice; ``sizes`` are the vertices along x, y and z."""
    shape = [sizes["xyz".index(axis)] for axis in axes]
    return Lattice(torch.randn(*shape, channels), axes)


def linked(channels: int, rows: int = 40, sizes: tuple[int, ...] = (5, 6, 7)) -> Lattice:
    """A random sparse lattice: a third of the rows' vertices are chosen at random, all others are empty."""
    links = torch.full(sizes, -1, dtype=torch.int32).reshape(-1)
    links[torch.randperm(len(links))[:rows]] = torch.arange(rows, dtype=torch.int32)
    return Lattice(torch.randn(rows, channels), "xyz", links.reshape(sizes))


def derivatives(kernels, unit: Tensor, lattices: list[Lattice], combine: Combination, dtype: torch.dtype) -> list[Tensor]:
    """Features; gradients of their weighted sum; and gradients of the squared norm of those (an eikonal loss and more)."""
    unit = unit.to(dtype).clone().requires_grad_()
    features = [x.features.detach().to(dtype).clone().requires_grad_() for x in lattices]
    out = kernels.lattice_encode(unit, [replace(x, features=f) for x, f in zip(lattices, features, strict=True)], combine)
    generator = torch.Generator("cpu").manual_seed(2)
    weights = torch.randn(out.shape, generator=generator, device="cpu").to(out).requires_grad_()
    leaves = [unit, *features]
    first = torch.autograd.grad((out * weights).sum(), leaves, create_graph=True)
    squared = torch.stack([(x**2).sum() for x in first]).sum()
    second = torch.autograd.grad(squared, [*leaves, weights], allow_unused=True)
    return [x.detach() for x in (out, *first, *second) if x is not None]
