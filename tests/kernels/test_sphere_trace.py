"""Sphere tracing in one pass against the plain loop, and against the field's own distances."""

from dataclasses import replace
from types import ModuleType

import pytest
import torch

from invgraphics.core import Bounds, Rays, Samples
from invgraphics.core.field import Quantity
from invgraphics.core.ngp import FusedSDF
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.neural import NeuralField, NeuralFieldConfig
from invgraphics.kernels import numba, reference
from invgraphics.kernels.types import TracingLimits
from invgraphics.testing import perturb, toy_scene

LIMITS = TracingLimits(steps=100, relaxation=1.3, refinements=8, least=1e-3, tolerance=1e-5, depth=0.05)
ENCODINGS = {"hash": HashConfig(levels=4, log2_size=10, base=4, finest=24), "octaves": FrequencyConfig(4)}


def case(encoding: str, layers: int = 2) -> tuple[NeuralField, FusedSDF, Bounds, Rays]:
    """A dented ball in a box of unequal edges, and rays around it."""
    torch.manual_seed(3)
    scene = toy_scene(views=2, size=16)
    scene = replace(scene, bounds=Bounds(torch.tensor([-1.0, -0.9, -1.2]), torch.tensor([1.0, 1.1, 1.0])))
    settings = {"layers": layers, "width": 19, "skip": -1, "geometry_features": 3, "colour_width": 8, "colour_layers": 1}
    field = NeuralFieldConfig(ENCODINGS[encoding], "sdf", **settings).build(scene)
    perturb(field, 0.01)
    fused = field.fused_sdf(scene.bounds)
    assert fused is not None
    return field, fused, scene.bounds, scene.bounds.clip(scene.test[0].camera.resized(30, 30).rays())


def exact(field: FusedSDF) -> FusedSDF:
    net = tuple((weight.double(), bias.double()) for weight, bias in field.net)
    return replace(field, table=field.table.double(), net=net, coordinate_scale=field.coordinate_scale.double())


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("layers", [1, 3])
def test_equals_the_plain_loop_in_float64(encoding: str, layers: int) -> None:
    _, fused, bounds, rays = case(encoding, layers)
    ours = numba.sdf_trace(rays, bounds, fused, LIMITS)
    true = reference.sdf_trace(rays.to(torch.float64), bounds.to(torch.float64), exact(fused), LIMITS)
    assert 100 < int(true.hit.sum()) < 800
    assert float((ours.hit != true.hit).double().mean()) < 0.01
    both = ours.hit & true.hit
    assert float((ours.hit_t - true.hit_t)[both].abs().quantile(0.98)) < 1e-4
    met = true.low.isfinite()
    assert torch.equal(met, ours.low.isfinite())
    assert int(met.sum()) < len(rays), "no ray misses the box"
    error = (ours.low - true.low)[met].abs()
    assert float(error.quantile(0.95)) < 1e-5
    assert float((ours.steps != true.steps).double().mean()) < 0.05
    assert float((ours.converged != true.converged).double().mean()) < 0.02
    torch.testing.assert_close(ours.hit_t[~ours.hit], rays.far[~ours.hit])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_field_is_zero_at_hits_and_has_the_distances_said(encoding: str) -> None:
    field, fused, bounds, rays = case(encoding)
    found = numba.sdf_trace(rays, bounds, fused, LIMITS)

    def distance(index: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        # In the graph, where no fused kernel is used.
        sdf = field.query(Samples.on(rays, index, t, t), Quantity.SDF).sdf
        assert sdf is not None
        return sdf.detach()

    solved = torch.nonzero(found.hit & found.converged)[:, 0]
    assert len(solved) > 100
    assert float(distance(solved, found.hit_t[solved]).abs().max()) < 2e-5
    met = torch.nonzero(found.low.isfinite())[:, 0]
    torch.testing.assert_close(distance(met, found.low_t[met]), found.low[met], atol=2e-5, rtol=0)
    # No place on a ray that just misses the surface is closer to it; dents have several such places.
    passing = torch.nonzero(found.converged & ~found.hit & (found.low < LIMITS.depth))[:, 0]
    assert len(passing) > 10
    share = torch.linspace(0, 1, 400)
    every = torch.lerp(rays.near[passing, None], rays.far[passing, None], share)
    along = distance(passing.repeat_interleave(400), every.flatten()).unflatten(0, (-1, 400))
    assert float((found.low[passing] - along.amin(dim=1)).quantile(0.8)) < 1e-3


def test_rays_do_not_depend_on_their_neighbours() -> None:
    _, fused, bounds, rays = case("hash")
    whole, some = numba.sdf_trace(rays, bounds, fused, LIMITS), torch.tensor([333, 7, 512, 450])
    part = numba.sdf_trace(rays[some], bounds, fused, LIMITS)
    for name in ("hit", "hit_t", "low_t", "low", "steps", "converged"):
        assert torch.equal(getattr(part, name), getattr(whole, name)[some]), name


@pytest.mark.parametrize("kernels", [reference, numba], ids=["reference", "numba"])
@pytest.mark.parametrize("relaxation", [1.0, 1.2, 1.6])
def test_an_over_relaxed_step_out_of_the_box_does_not_jump_over_a_surface(kernels: ModuleType, relaxation: float) -> None:
    # The half-space z < floor: the distance is z - floor, by a softplus so sharp that it is linear above 0.
    first, last = (torch.zeros(8, 6), torch.zeros(8)), (torch.zeros(1, 8), torch.zeros(1))
    first[0][0, 2], first[1][0], last[0][0, 0] = 1.0, 10.0, 1.0
    bounds = Bounds(torch.full((3,), -1.0), torch.full((3,), 1.0))
    rays = bounds.clip(Rays.make(torch.tensor([[0.0, 0.0, 3.0]]), torch.tensor([[0.0, 0.0, -1.0]])))
    limits = replace(LIMITS, relaxation=relaxation)
    for floor in (0.5, -0.4, -0.7, -0.85, -0.99):
        last[1][0] = -10 - floor
        field = FusedSDF(torch.zeros(0, 2), None, 0, (first, last), 100.0, torch.ones(3), 1.0)
        found = kernels.sdf_trace(rays, bounds, field, limits)
        assert bool(found.hit), f"the floor at {floor}"
        assert abs(float(found.hit_t) - (3 - floor)) < 1e-4


def test_fields_without_a_kernel_have_no_parts() -> None:
    field, _, bounds, _ = case("hash")
    assert field.fused_sdf(replace(bounds, lo=bounds.lo - 1)) is None
    scene = toy_scene(views=2, size=8)
    for other in (NeuralFieldConfig(HashConfig(), layers=1, skip=-1), NeuralFieldConfig(geometry="sdf", layers=6, width=8)):
        assert other.build(scene).fused_sdf(scene.bounds) is None
