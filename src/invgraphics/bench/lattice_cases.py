"""Benchmark cases of lattices: voxels, tri-planes and factors, each with the same work by torch's own grid sampler; steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from invgraphics import kernels
from invgraphics.bench import limits
from invgraphics.bench.case import LARGE, Case, KernelPass, Run
from invgraphics.bench.results import BOTH, FORWARD
from invgraphics.bench.sample_cases import ray_ordered
from invgraphics.bench.splat_cases import forward_backward, without_gradient
from invgraphics.core.lattice import Combination, Lattice
from invgraphics.training.optimisers.adam import MaskedAdam

POINTS, QUICK_POINTS = (1 << 14, 1 << 16, 1 << 18), (1 << 14, 1 << 16)
GATE_POINTS = 1 << 16
"""Points of the gates."""
TORCH = "torch grid_sample"
"""Name of torch's sampler in results."""
LINE = 64
"""Bytes in a cache line."""


@dataclass(frozen=True)
class Layout:
    """Lattices of a method.

    Attributes:
        axes: of each lattice.
        combine: their combination.
        vertices: along each axis.
        channels: of each lattice.
    """

    axes: tuple[str, ...]
    combine: Combination
    vertices: int
    channels: int

    def sizes(self, points: int) -> dict[str, int]:
        """Problem size, by `results.SIZE_KEYS`."""
        return {"vertices": self.vertices, "channels": self.channels, "points": points}

    def lattices(self) -> list[Lattice]:
        """Random features that require gradients."""
        generator = torch.Generator().manual_seed(0)
        shapes = [(*[self.vertices] * len(axes), self.channels) for axes in self.axes]
        values = [torch.rand(shape, generator=generator).requires_grad_() for shape in shapes]
        return [Lattice(features, axes) for features, axes in zip(values, self.axes, strict=True)]

    @property
    def lines(self) -> int:
        """Cache lines that one point reads at least: neighbours along a lattice's last axis lie side by side."""
        pairs = sum(2 ** (len(axes) - 1) for axes in self.axes)
        return pairs * math.ceil(2 * 4 * self.channels / LINE)


LAYOUTS = {
    "lattice_encode, voxels": Layout(("xyz",), "concat", 128, 28),
    "lattice_encode, tri-plane": Layout(("xy", "xz", "yz"), "sum", 256, 32),
    "lattice_encode, VM": Layout(("xy", "z", "xz", "y", "yz", "x"), "vm", 300, 16),
    "lattice_encode, CP": Layout(("x", "y", "z"), "cp", 300, 96),
}
"""By name: a density and spherical harmonics of degree 2 (Plenoxels), EG3D's planes, TensoRF's two densities."""
SPEED_UPS = {
    "lattice_encode, voxels": 10.0,
    "lattice_encode, tri-plane": 10.0,
    "lattice_encode, VM": 5.0,
    "lattice_encode, CP": 5.0,
}
"""Promised speed of forward and backward, as a multiple of torch's sampler; products do more work between look-ups."""


STEP = Layout(("xyz",), "concat", 192, 12)
"""Of a step's cases: DVGO's colours, finer than the paper's."""
STEP_POINTS = 1 << 14
WHOLE_STEP, SPARSE_STEP = "lattice step, whole gradient", "lattice step, sparse gradient"
"""Names of a step's cases: encoding, its gradient and Adam on the entries that have one."""
STEP_SPEED_UP = 5.0
"""Promised speed of a step with sparse gradients, as a multiple of one with whole ones."""


def lattice_encode(quick: bool) -> Iterator[Case]:
    """Every layout over points, and steps of an optimiser with either kind of gradients."""
    for name, layout in LAYOUTS.items():
        for points in QUICK_POINTS if quick else POINTS:
            yield Case(name, layout.sizes(points), lambda layout=layout, points=points: _passes(layout, points))
    for name, sparse in ((WHOLE_STEP, False), (SPARSE_STEP, True)):
        yield Case(name, STEP.sizes(STEP_POINTS), lambda sparse=sparse: {BOTH: KernelPass(_step(sparse))}, LARGE)


def _step(sparse: bool) -> Run:
    """A step that follows the sum of all features."""
    unit, parameter = ray_ordered(STEP_POINTS), nn.Parameter(STEP.lattices()[0].features.detach())
    adam = MaskedAdam([{"params": [parameter], "lr": 0.1}], (0.9, 0.99), 1e-15)

    def run() -> None:
        adam.zero_grad()
        kernels.lattice_encode(unit, [Lattice(parameter)], sparse_gradients=sparse).sum().backward()
        adam.step()

    return run


def _passes(layout: Layout, points: int) -> dict[str, KernelPass]:
    runs, amount = ours(layout, points), float(layout.lines * points)
    limit = limits.gather(sum(4 * layout.channels * layout.vertices ** len(axes) for axes in layout.axes))
    return {
        FORWARD: KernelPass(runs[FORWARD], amount, limit, "look-ups"),
        BOTH: KernelPass(runs[BOTH], 2 * amount, limit, "look-ups"),
    }


def ours(layout: Layout, points: int) -> dict[str, Run]:
    """Our encoding of a layout, by direction."""
    unit, lattices = ray_ordered(points), layout.lattices()
    encode = lambda: kernels.lattice_encode(unit, lattices, layout.combine)  # noqa: E731
    return _runs(encode, [lattice.features for lattice in lattices])


def torch_sampler(layout: Layout, points: int) -> dict[str, Run]:
    """The same work by `torch.nn.functional.grid_sample`, lattices of a dimension as one batch, by direction."""
    unit, lattices = ray_ordered(points), layout.lattices()
    groups = [lattices] if layout.combine != "vm" else [lattices[::2], lattices[1::2]]
    volumes = [_volume(group) for group in groups]
    places = [_places(unit, group) for group in groups]

    def sample() -> Tensor:
        found = [grid_sample(v, p, align_corners=True, padding_mode="border") for v, p in zip(volumes, places, strict=True)]
        if layout.combine == "cp":
            found = list(found[0].unbind(0))
        return found[0].sum(0) if layout.combine == "sum" else math.prod(found[1:], start=found[0])

    return _runs(sample, volumes)


def _volume(group: list[Lattice]) -> Tensor:
    """Features of lattices with as many axes in torch's layout: batch, channels, axes reversed; a line has width 1."""
    volume = torch.stack([x.features.detach().permute(*reversed(range(x.features.ndim))) for x in group]).contiguous()
    return (volume[..., None] if len(group[0].axes) == 1 else volume).requires_grad_()


def _places(unit: Float[Tensor, "m 3"], group: list[Lattice]) -> Tensor:
    """Positions in torch's layout and range [-1, 1]."""
    found = torch.stack([2 * unit[:, list(x.columns)] - 1 for x in group])
    if len(group[0].axes) == 1:
        found = torch.cat([torch.zeros_like(found), found], dim=-1)
    return found.reshape(len(group), *[1] * (found.shape[-1] - 1), *found.shape[1:])


def _runs(encode: Callable[[], Tensor], inputs: list[Tensor]) -> dict[str, Run]:
    return {FORWARD: without_gradient(encode), BOTH: forward_backward(encode, inputs)}
