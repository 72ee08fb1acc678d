"""Exposure per photograph: finite differences, the gauge, coarse levels, recovery from photographs that differ, resuming."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invgraphics.config import fill
from invgraphics.core import Batch, Context, FieldValues, Model, Rays, Rendering, Samples, Scene, Trace
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_plan
from invgraphics.experiments.posed import exposure_note
from invgraphics.recipes.recipe import load_method
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import TwoBalls, toy_scene
from invgraphics.training.batches import BatchConfig
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit, Plan
from invgraphics.training.losses import CoarseLoss, PhotometricLoss
from invgraphics.training.optimiser import OptimiserConfig
from invgraphics.training.views.exposure import ExposureConfig, Exposures

F64 = torch.float64


def exposures(model: str) -> Exposures:
    """Three views whose maps are not the identity."""
    found = Exposures(fill(ExposureConfig, {"model": model}), 3).double()
    for index, raw in enumerate(found.raw):
        torch.nn.init.normal_(raw, std=0.2, generator=torch.Generator().manual_seed(index))
    return found


@pytest.mark.parametrize("model", ["affine", "gain"])
def test_colours_and_gradients_are_those_of_a_loop_over_pixels(model: str) -> None:
    """The mean map carries no gradient: finite differences hold it."""
    exposed, views = exposures(model), [0, 2, 2, -1, 1]
    raw = torch.stack(list(exposed.raw)).detach()
    mean = raw.mean(dim=0)

    def expected(rgb: Tensor, alpha: Tensor, last: Tensor) -> float:
        total = 0.0
        for pixel, view in enumerate(views):
            own = (last if view == 2 else raw[view]) - mean
            colour = rgb[pixel]
            if view >= 0 and model == "affine":
                colour = colour + own[:, :3] @ colour + alpha[pixel] * own[:, 3]
            elif view >= 0:
                colour = colour * own.exp()
            total += (pixel + 1) * float(colour.square().sum())
        return total

    inputs = [torch.rand(5, 3, dtype=F64), torch.rand(5, dtype=F64), raw[2]]
    rgb, alpha = (values.clone().requires_grad_() for values in inputs[:2])
    picture, _ = exposed.expose(Rendering(rgb, alpha, alpha), Trace(rays=5), torch.tensor(views))
    found = (picture.rgb.square() * torch.arange(1, 6)[:, None]).sum()
    assert float(found.detach()) == pytest.approx(expected(*inputs), rel=1e-12)
    gradients = torch.autograd.grad(found, [rgb, alpha, exposed.raw[2]], allow_unused=True)
    for index, gradient in enumerate(gradients):
        for at in range(inputs[index].numel()):
            ends = []
            for sign in (1, -1):
                moved = [values.clone() for values in inputs]
                moved[index].view(-1)[at] += sign * 1e-6
                ends.append(expected(*moved))
            known = 0.0 if gradient is None else float(gradient.flatten()[at])
            assert known == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6, abs=1e-7)


def test_the_mean_of_the_views_is_the_identity_whatever_moves_them_all() -> None:
    identity = torch.eye(3, 4, dtype=F64)
    for model in ("affine", "gain"):
        exposed = exposures(model)
        before = exposed().detach()
        with torch.no_grad():
            for parameter in exposed.raw:
                parameter.add_(0.7)
        torch.testing.assert_close(exposed().detach(), before)
        torch.testing.assert_close(before[-1], identity)
        maps = before[:-1]
        mean = maps.mean(dim=0) if model == "affine" else maps[..., :3].diagonal(dim1=1, dim2=2).log().mean(dim=0).exp().diag()
        torch.testing.assert_close(mean, identity[:, : mean.shape[1]])


def test_coarse_levels_are_compared_under_their_ray_s_exposure() -> None:
    """A level whose pixels are right under their own exposures costs nothing, and a whole picture takes one view's map."""
    exposed, view = exposures("affine"), torch.tensor([1, 0])
    rays = Rays.make(torch.zeros(2, 3, dtype=F64), torch.eye(3, dtype=F64)[:2], view=view)
    t0, t1 = torch.tensor([1.0, 2.0, 1.0], dtype=F64), torch.tensor([2.0, 3.0, 2.0], dtype=F64)
    samples = Samples.on(rays, torch.tensor([0, 0, 1]), t0, t1)
    radiance = torch.rand(3, 3, dtype=F64)
    level = Trace(samples, FieldValues(radiance=radiance), torch.tensor([0.25, 0.75, 1.0]).double(), rays=2)
    colour = torch.stack([0.25 * radiance[0] + 0.75 * radiance[1], radiance[2]])
    one = torch.ones(2, dtype=F64)
    picture, trace = exposed.expose(Rendering(colour, one, one), Trace(levels=(level,), rays=2), view)
    batch = Batch(picture.rgb.detach(), one, torch.zeros(3, dtype=F64))
    ctx = Context(None)  # pyright: ignore[reportArgumentType]
    assert float(CoarseLoss()(picture, trace, batch, ctx).detach()) < 1e-20
    assert float(CoarseLoss()(picture, replace(trace, levels=(level,)), batch, ctx)) > 1e-3
    whole, _ = exposed.expose(Rendering(colour, one, one), Trace(rays=2), 1)
    torch.testing.assert_close(whole.rgb[0], picture.rgb[0])
    assert not torch.equal(whole.rgb[1], picture.rgb[1])


FACTORS = torch.tensor([0.6, 0.9, 0.7, 1.0, 0.5, 0.8])


@pytest.fixture(scope="module")
def exposed_scene() -> Scene:
    """The toy scene on black, every training view darker or brighter by a factor; their geometric mean is 1."""
    scene, black = toy_scene(views=6, size=12), torch.zeros(3)
    train = [
        replace(view, image=view.over(black) * factor, alpha=None, depth=None)
        for view, factor in zip(scene.train, FACTORS / FACTORS.log().mean().exp(), strict=True)
    ]
    return replace(scene, train=tuple(train), background=black)


def gains(fit: Fit) -> Tensor:
    """Logarithms of the fitted factors of the training views."""
    assert fit.plan.exposures is not None
    return fit.plan.exposures()[:-1, :, :3].detach().diagonal(dim1=1, dim2=2).log().mean(dim=1)


def test_rays_of_several_views_recover_each_view_s_exposure(exposed_scene: Scene) -> None:
    """With the true scene held, which fog in front of a camera cannot darken instead."""
    config = ExposureConfig(model="gain", lr=0.02)
    plan = Plan(
        model=Model(TwoBalls(), VolumetricConfig(StratifiedConfig(count=32)).build(exposed_scene), exposed_scene.bounds),
        scene=exposed_scene,
        losses=[PhotometricLoss()],
        hooks=[],
        optimiser=config.optimiser(OptimiserConfig()),
        batches=BatchConfig(rays=256, views=3),
        budget=Budget(seconds=None, steps=150),
        exposures=Exposures(config, 6),
    )
    fit = Fit(plan)
    fit.run(lambda loss: False)
    torch.testing.assert_close(gains(fit), FACTORS.log() - FACTORS.log().mean(), atol=0.05, rtol=0)


def test_a_fit_of_gaussians_recovers_them_and_resumes_to_the_same_bits(exposed_scene: Scene) -> None:
    changes = [
        "field.max_init=100",
        "field.sh_degree=0",
        "hooks=[]",
        "training.exposure.model=gain",
        "training.exposure.lr=0.05",
    ]
    method = load_method("splatting/gaussians", overrides=changes)

    def fit() -> Fit:
        return Fit(build_plan(method, exposed_scene, Budget(seconds=None, steps=150), 0, torch.device("cpu")))

    whole, first, second = fit(), fit(), fit()
    whole.run(lambda loss: False)
    torch.testing.assert_close(gains(whole), FACTORS.log() - FACTORS.log().mean(), atol=0.15, rtol=0)
    first.run(lambda loss: first.steps == 75)
    second.load(first.state(), first.seconds)
    second.run(lambda loss: False)
    left, right = whole.state()["exposure"], second.state()["exposure"]
    assert left and all(torch.equal(left[key], right[key]) for key in left)


def test_methods_say_under_which_exposure_held_out_views_are_shown() -> None:
    scene = toy_scene()
    assert exposure_note(load_method("volumetric/hash"), scene) == ""
    assert exposure_note(load_method("volumetric/hash", overrides=["training.exposure.optimise=false"]), scene) == ""
    note = exposure_note(load_method("volumetric/hash", overrides=["training.exposure.model=affine"]), scene)
    assert note.startswith("mean of the training views")
    with pytest.raises(InputError, match="learning rates must be positive"):
        load_method("volumetric/hash", overrides=["training.exposure.lr=0"])
