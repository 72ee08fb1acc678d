"""Eikonal terms on analytic distances, whose gradients have known lengths."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from typing_extensions import override

from invgraphics.core import Bounds, Context, Field, FieldValues, Quantity, Samples
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_plan
from invgraphics.fields.analytic import Box, GaussianBlob, Sphere
from invgraphics.recipes.recipe import load_method, resolve
from invgraphics.renderers.neus import NeuSConfig
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import toy_scene
from invgraphics.training.budget import Budget
from invgraphics.training.eikonal import CurvaturePenalty, EikonalLoss, EikonalPenalty, eikonal_mean, foot_points, laplacian
from invgraphics.training.fit import Fit


class Stretched(Field):
    """A ball whose distance is ``factor`` times too long; notes where it is asked."""

    provides = Quantity.SDF | Quantity.GRADIENT | Quantity.RADIANCE

    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = torch.nn.Parameter(torch.tensor(factor))
        self.asked: list[Tensor] = []

    @override
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        self.asked.append(samples.position.detach())
        radius = samples.position.norm(dim=1, keepdim=True)
        return FieldValues(
            sdf=self.factor * (radius[:, 0] - 0.5),
            gradient=self.factor * samples.position / radius,
            radiance=torch.ones_like(samples.position),
        )


def context() -> Context:
    return Context(toy_scene(views=2, size=4).bounds, training=True, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("factor", [1.0, 2.0, 0.5])
def test_penalty_and_its_derivative(factor: float) -> None:
    """(|∇f| - 1)² is (c - 1)² everywhere, its derivative in c is 2 (c - 1)."""
    field, renderer = Stretched(factor), NeuSConfig(StratifiedConfig(4)).build(toy_scene(views=2, size=4))
    value = EikonalPenalty(weight=3.0, points=64, near=32)(field, renderer, context())
    assert float(value.detach()) == pytest.approx(3 * (factor - 1) ** 2, abs=1e-6)
    value.backward()
    assert field.factor.grad is not None
    assert float(field.factor.grad) == pytest.approx(6 * (factor - 1), abs=1e-5)


def test_points_are_everywhere_and_near_the_surface() -> None:
    field, renderer = Stretched(1.5), NeuSConfig(StratifiedConfig(4)).build(toy_scene(views=2, size=4))
    EikonalPenalty(points=2000, near=500, spread=0.02)(field, renderer, context())
    anywhere, near = field.asked
    assert anywhere.shape == (2000, 3)
    assert near.shape == (500, 3)
    torch.testing.assert_close(anywhere.square().mean(dim=0), torch.full((3,), 1 / 3), rtol=0.1, atol=0)  # uniform in [-1, 1]
    away = near.norm(dim=1) - 0.5
    assert abs(float(away.mean())) < 0.005
    assert float(away.std()) == pytest.approx(0.02, rel=0.15)


def test_foot_points_lie_on_the_surface() -> None:
    ball, position = Sphere(1.0, 0.5), torch.randn(50, 3)
    values = ball.query(Samples.at(position), Quantity.SDF | Quantity.GRADIENT)
    assert values.sdf is not None
    assert values.gradient is not None
    foot = foot_points(position, 3 * values.sdf, 3 * values.gradient)
    torch.testing.assert_close(foot, 0.5 * torch.nn.functional.normalize(position, dim=1), rtol=1e-5, atol=1e-6)


def test_laplacian_is_the_sum_of_principal_curvatures() -> None:
    """2 / |x| around a ball; 0 beside a box's faces, 1 / (distance to the edge) beside an edge."""
    generator = torch.Generator().manual_seed(3)
    around = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator, dtype=torch.float64), dim=1)
    radius = 0.4 + 0.4 * torch.rand(50, generator=generator, dtype=torch.float64)
    curved = laplacian(Sphere(1.0, 0.5).double(), radius[:, None] * around, 1e-3)
    torch.testing.assert_close(curved, 2 / radius, rtol=1e-5, atol=0)
    beside = torch.tensor([[0.9, 0.1, 0.2], [0.3, 0.1, 0.2], [0.8, 0.9, 0.1]], dtype=torch.float64)
    curved = laplacian(Box(1.0, (0.5, 0.5, 0.5)).double(), beside, 1e-3)
    torch.testing.assert_close(curved, torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64), rtol=1e-5, atol=1e-8)


def test_curvature_penalty_of_a_ball() -> None:
    field, renderer = Stretched(1.5), NeuSConfig(StratifiedConfig(4)).build(toy_scene(views=2, size=4))
    penalty = CurvaturePenalty(weight=0.1, points=400, spread=0.0, step=0.005, warmup=0.0)
    value = penalty(field, renderer, context())
    assert float(value.detach()) == pytest.approx(0.1 * 1.5 * 2 / 0.5, rel=1e-2)
    value.backward()
    assert field.factor.grad is not None
    assert float(field.factor.grad) == pytest.approx(0.1 * 2 / 0.5, rel=1e-2)
    assert not CurvaturePenalty(warmup=0.5)(field, renderer, replace(context(), progress=0.0)).detach()


def test_loss_is_that_of_the_samples() -> None:
    scene = toy_scene(views=2, size=8)
    ctx, field = Context(scene.bounds, training=True), Stretched(2.0)
    rendering, trace = NeuSConfig(StratifiedConfig(16)).build(scene).render_image(field, scene.train[0].camera, ctx)
    assert float(EikonalLoss(weight=0.5)(rendering, trace, None, ctx).detach()) == pytest.approx(0.5)  # type: ignore[arg-type]
    dense, plain = (
        VolumetricConfig(StratifiedConfig(8)).build(scene).render_image(GaussianBlob(1.0, 0.1), scene.train[0].camera, ctx)
    )
    with pytest.raises(InputError, match="samples with gradients"):
        EikonalLoss()(dense, plain, None, ctx)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["eikonal", "curvature"])
def test_a_field_without_a_distance_is_refused_before_anything_is_built(name: str) -> None:
    """A neural field provides one or none: that is seen once it is built."""
    splats, hashed = (
        load_method(method).table | {"penalties": [{"type": name}]} for method in ("splatting/gaussians", "volumetric/hash")
    )
    with pytest.raises(InputError, match=f"The penalty '{name}' needs a signed distance, which GaussianField does not have"):
        resolve("splatting/gaussians", "", splats)
    plan = build_plan(resolve("mine", "", hashed), toy_scene(views=2, size=4), Budget(steps=1), 0, torch.device("cpu"))
    with pytest.raises(InputError, match=f"The penalty '{name}' needs a signed distance, which NeuralField does not have"):
        Fit(plan)


def test_in_contracted_space_points_of_the_unit_ball_count() -> None:
    """Beyond it a length is contracted: a slope of 1 there is none of the network's coordinates."""
    position = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, -0.9], [3.0, 0.0, 0.0], [0.0, -1.2, 0.0]])
    gradient = torch.tensor([[1.5, 0.0, 0.0], [0.0, 1.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 4.0]])
    lo, hi = -torch.ones(3), torch.ones(3)
    assert float(eikonal_mean(gradient, position, Bounds(lo, hi, "contracted"))) == pytest.approx(0.5**2 / 2)
    assert float(eikonal_mean(gradient, position, Bounds(lo, hi))) == pytest.approx((0.5**2 + 8.0**2 + 3.0**2) / 4)
    assert float(eikonal_mean(gradient[2:], position[2:], Bounds(lo, hi, "contracted"))) == 0
