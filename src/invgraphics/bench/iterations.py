"""Whole training steps, compared with the kernels or networks alone that bound them from below."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import cycle

import torch
from torch import Tensor
from typing_extensions import override

from invgraphics.bench.results import BOTH, Measurement
from invgraphics.bench.splat_cases import GATE as SPLAT_GATE
from invgraphics.bench.splat_cases import forward_backward, splat_pipeline
from invgraphics.bench.timing import TimingBudget, alternate
from invgraphics.bench.workload import activated, gaussian_field, leaves, scene
from invgraphics.core import Model, Scene, harmonics
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.gaussian import GaussianField
from invgraphics.fields.geometry import CPU_CHUNK
from invgraphics.fields.neural import NeuralField, NeuralFieldConfig
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.splatting import SplattingConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.training.batches import BatchConfig
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit, Plan
from invgraphics.training.hooks import FitState, Hook
from invgraphics.training.losses import Loss, PhotometricLoss, SsimLoss
from invgraphics.training.optimiser import GroupConfig, OptimiserConfig

VIEWS = 4
SPLAT_STEP, SPLAT_SHARE = "splat step", "splat step: rasteriser alone"
NERF_STEP, NERF_SHARE = "hash step", "hash step: networks alone"
ALL_STEPS = 10**9
"""A budget so long that schedules are constant while steps are timed."""

NERF_GATE = {"levels": 16, "log2_size": 15, "hidden": 64}
"""Instant-NGP's networks over a table that suits a CPU's cache."""
NERF_SMALL = {"levels": 8, "log2_size": 15, "hidden": 32}
"""The sizes of the laptop preset."""
SAMPLES = 1 << 16
"""Samples per step."""
WARM_STEPS, WARM_SAMPLES = 96, 1 << 13
"""Smaller warm-up steps before timing, in which the occupancy grid finds empty space."""
REFRESH = 16
"""Steps between updates of the occupancy grid; one timed call makes as many, so that each includes one update."""


def splat_step(n: int, width: int, budget: TimingBudget) -> list[Measurement]:
    """Training step of splatting (render, 0.8 L1 + 0.2 SSIM, fused Adam) against project, bin, rasterise on the same views."""
    field = gaussian_field(n)
    pictures = scene(field, VIEWS, width)
    primitives, fit = activated(field), splat_fit(field, pictures)
    draws = [
        forward_backward(lambda camera=view.camera: splat_pipeline(primitives, camera), leaves(primitives))
        for view in pictures.train
    ]
    views = cycle(draws)

    def draw_next() -> object:
        return next(views)()

    timings = alternate({SPLAT_SHARE: draw_next, SPLAT_STEP: fit.step}, budget)
    sizes, threads = {"gaussians": n, "width": width}, torch.get_num_threads()
    return [Measurement(name, "numba", BOTH, sizes, threads, timing, float(n), "Gaussians") for name, timing in timings.items()]


def splat_fit(field: GaussianField, pictures: Scene) -> Fit:
    """A fit that starts from the Gaussians of ``pictures``, with perturbed colours so that gradients are not zero."""
    with torch.no_grad():
        field.sh_dc += 0.1 * torch.randn(field.sh_dc.shape, generator=torch.Generator().manual_seed(1))
    losses = [PhotometricLoss(0.8, "l1"), SsimLoss(0.2)]
    return _fit(Model(field, SplattingConfig().build(pictures), pictures.bounds), pictures, losses, [], BatchConfig())


class _CountSamples(Hook):
    """Records the numbers of samples and rays of each step."""

    def __init__(self) -> None:
        self.samples: list[int] = []
        self.rays: list[int] = []

    @override
    def after_step(self, state: FitState) -> None:
        if state.trace is not None and state.trace.samples is not None:
            self.samples.append(len(state.trace.samples))
            self.rays.append(state.trace.rays)


@dataclass(frozen=True)
class NerfFit:
    """A warmed-up fit of a hash grid, and its sample counter."""

    fit: Fit
    field: NeuralField
    counter: _CountSamples

    def refresh_cycle(self) -> None:
        """The steps from one update of the occupancy grid to the next."""
        for _ in range(REFRESH):
            self.fit.step()


def nerf_scene() -> Scene:
    """Training scene of the synthetic object for a hash grid."""
    return scene(gaussian_field(20_000), VIEWS, 200)


def nerf_fit(pictures: Scene, levels: int, log2_size: int, hidden: int, warm_steps: int) -> NerfFit:
    """A fit of a hash grid to ``pictures``, after ``warm_steps`` small steps that warm up its occupancy grid."""
    config = NeuralFieldConfig(
        encoding=HashConfig(levels=levels, log2_size=log2_size),
        layers=1, width=hidden, skip=-1, geometry_features=15, colour_layers=2, colour_width=hidden,
        direction="sh", direction_degree=4, density_activation="exp",
    )  # fmt: skip
    sampler = OccupancyConfig(
        resolution=64, steps_per_diagonal=256, grace=REFRESH, warmup=WARM_STEPS, every=REFRESH, decay=0.5, stop="evaluation"
    )
    torch.manual_seed(0)
    field, counter = config.build(pictures), _CountSamples()
    model = Model(field, VolumetricConfig(sampler).build(pictures), pictures.bounds)
    losses: list[Loss] = [PhotometricLoss(distance="huber")]
    warmup_fit = _fit(model, pictures, losses, [], BatchConfig(rays=256, views=VIEWS, samples=WARM_SAMPLES), lr=1e-2)
    for _ in range(warm_steps):
        warmup_fit.step()
    batches = BatchConfig(rays=1024, views=VIEWS, samples=SAMPLES)
    return NerfFit(_fit(model, pictures, losses, [counter], batches, lr=1e-2), field, counter)


def nerf_step(sizes: dict[str, int], budget: TimingBudget) -> list[Measurement]:
    """Training step of a hash grid (march, encode, networks, composite, Adam) against its two networks alone."""
    running = nerf_fit(nerf_scene(), **sizes, warm_steps=WARM_STEPS)
    running.refresh_cycle()  # in which the number of rays adapts
    counted, rays = running.counter.samples, running.counter.rays
    counted.clear()
    rays.clear()
    timings = alternate({NERF_SHARE: networks_alone(running.field, SAMPLES), NERF_STEP: running.refresh_cycle}, budget)
    per_step = sum(counted) / len(counted)
    note = f"{per_step:.0f} samples on {sum(rays) / len(rays):.0f} rays per step"
    threads, step = torch.get_num_threads(), timings[NERF_STEP].per(REFRESH)
    return [
        Measurement(NERF_SHARE, "torch", BOTH, sizes, threads, timings[NERF_SHARE], float(SAMPLES), "samples"),
        Measurement(NERF_STEP, "numba", BOTH, sizes, threads, step, per_step, "samples", note=note),
    ]


def networks_alone(field: NeuralField, samples: int) -> Callable[[], object]:
    """Both networks forward and backward on precomputed features, in the chunks that the field uses on a CPU."""
    generator = torch.Generator().manual_seed(0)
    features = torch.rand(samples, field.geometry_net.inputs, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(samples, 3, generator=generator), dim=1)
    direction_sh = harmonics.basis(directions, field.config.direction_degree - 1)
    parameters = [*field.geometry_net.parameters(), *field.colour_net.parameters()]
    chunks = [
        (part.clone().requires_grad_(), sh)
        for part, sh in zip(features.split(CPU_CHUNK), direction_sh.split(CPU_CHUNK), strict=True)
    ]

    def run() -> list[tuple[Tensor, ...]]:
        gradients = []
        for part, sh in chunks:
            geometry = field.geometry_net(part)
            colour = field.colour_net(torch.cat([geometry[:, 1:], sh], dim=1))
            # The encoding needs the features' gradients too.
            gradients.append(torch.autograd.grad(geometry[:, 0].sum() + colour.sum(), [part, *parameters]))
        return gradients

    return run


def _fit(
    model: Model,
    pictures: Scene,
    losses: list[Loss],
    hooks: list[Hook],
    batches: BatchConfig,
    lr: float = 1e-4,
) -> Fit:
    optimiser = OptimiserConfig({"field": GroupConfig("field", lr)})
    return Fit(Plan(model, pictures, losses, hooks, optimiser, batches, Budget(steps=ALL_STEPS)))


def steps(quick: bool, budget: TimingBudget) -> list[Measurement]:
    """All training steps: the gated sizes, and in a full run smaller ones."""
    found = splat_step(SPLAT_GATE["gaussians"], SPLAT_GATE["width"], budget) + nerf_step(NERF_GATE, budget)
    if not quick:
        found += splat_step(10_000, 200, budget) + nerf_step(NERF_SMALL, budget)
    return found
