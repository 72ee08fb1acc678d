"""Pictures of hash grids for which there is one kernel: like those composed of many, and only where nothing more is wanted."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from invgraphics import kernels
from invgraphics.core import Camera, Context, Scene
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.neural import NeuralField, NeuralFieldConfig
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.volumetric import MAX_SKIPPED_WEIGHT, Volumetric

GRID = HashConfig(levels=4, log2_size=10, base=4, finest=64)
FIELD = NeuralFieldConfig(
    GRID, layers=1, width=16, skip=-1, geometry_features=7, colour_layers=2, colour_width=16, direction="sh",
    density_activation="exp", density_bias=0.5,
)  # fmt: skip
SAMPLER = OccupancyConfig(resolution=8, steps_per_diagonal=256, evaluation_steps=300, transmittance=1e-4)


def fitted(config: NeuralFieldConfig, scene: Scene) -> NeuralField:
    """A field with something in it."""
    field = config.build(scene)
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            parameter.copy_(torch.randn(parameter.shape) * (1.0 if "table" in name else 0.5))
    return field


@pytest.fixture
def setting(make_scene: Callable[..., Scene]) -> tuple[Scene, Volumetric, Camera]:
    scene = make_scene()
    renderer = Volumetric(SAMPLER.build(scene))
    renderer.sampler.occupied.copy_(torch.rand(8, 8, 8) < 0.4)  # type: ignore[union-attr]
    return scene, renderer, scene.train[0].camera


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[None]:
    """One entry for each picture made in one pass."""
    made: list[None] = []
    original = kernels.ngp_render
    monkeypatch.setattr(kernels, "ngp_render", lambda *args: (made.append(None), original(*args))[1])
    return made


@pytest.mark.parametrize("direction", ["sh", "none"])
def test_picture_is_the_composed_one(setting, calls, monkeypatch, direction: str) -> None:
    scene, renderer, camera = setting
    field, ctx = fitted(replace(FIELD, direction=direction), scene), Context(scene.bounds)
    with torch.no_grad():
        ours, _ = renderer.render_image(field, camera, ctx)
        monkeypatch.setattr(kernels, "compiled", lambda *args: False)
        theirs, _ = renderer.render_image(field, camera, ctx)
    assert len(calls) == 1
    assert 0.1 < float(theirs.alpha.mean()) < 0.95
    torch.testing.assert_close(ours.alpha, theirs.alpha, rtol=0, atol=2e-4)
    # Both leave out colours, not the same ones.
    torch.testing.assert_close(ours.rgb, theirs.rgb, rtol=0, atol=MAX_SKIPPED_WEIGHT + 2e-4)
    clear = (theirs.alpha - 0.5).abs() > 1e-3
    torch.testing.assert_close(ours.depth[clear], theirs.depth[clear], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("what", ["training", "geometry", "gradient", "never", "window", "frequency", "reference"])
def test_everything_else_is_composed(setting, calls, what: str) -> None:
    scene, renderer, camera = setting
    field = fitted(replace(FIELD, encoding=FrequencyConfig() if what == "frequency" else GRID), scene)
    ctx = Context(scene.bounds, training=what == "training", geometry=what == "geometry")
    if what == "never":
        renderer = Volumetric(replace(SAMPLER, stop="never").build(scene))
    if what == "window":
        field.encoding.add_window()  # type: ignore[union-attr]
    with torch.set_grad_enabled(what == "gradient"), kernels.using("reference" if what == "reference" else None):
        picture, _ = renderer.render_image(field, camera, ctx)
    assert calls == []
    assert bool(picture.rgb.isfinite().all())


def test_other_networks_are_not_fused(setting) -> None:
    scene, *_ = setting
    for change in (
        {"geometry": "sdf"},
        {"direction": "frequency"},
        {"layers": 2, "skip": 0},
        {"encoding": replace(GRID, features=4)},
    ):
        assert replace(FIELD, **change).build(scene).fused(scene.bounds) is None


def test_training_marches_in_one_pass_and_sees_the_same(setting, monkeypatch) -> None:
    """Loss and gradients are those of a march, looks, and another march; in boxes only, and with steps of one length."""
    scene, renderer, camera = setting
    field, rays, made = fitted(FIELD, scene), camera.rays(), []
    original = kernels.ngp_march
    monkeypatch.setattr(kernels, "ngp_march", lambda *args: (made.append(None), original(*args))[1])

    def gradient() -> torch.Tensor:
        ctx = Context(scene.bounds, training=True, generator=torch.Generator().manual_seed(5))
        field.zero_grad()
        renderer.render_rays(field, rays, ctx)[0].rgb.square().sum().backward()
        assert field.encoding.table.grad is not None
        return field.encoding.table.grad.clone()

    ours = gradient()
    assert len(made) == 1
    monkeypatch.setattr(kernels, "compiled", lambda *args: False)
    theirs = gradient()
    assert len(made) == 1
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-3 * float(theirs.abs().max()))


def test_growing_steps_are_marched_in_parts(setting, monkeypatch) -> None:
    scene, _, camera = setting
    monkeypatch.setattr(kernels, "ngp_march", lambda *args: pytest.fail("no such kernel for these steps"))
    renderer = Volumetric(replace(SAMPLER, cone=0.01).build(scene))
    picture, _ = renderer.render_rays(fitted(FIELD, scene), camera.rays(), Context(scene.bounds, training=True))
    assert bool(picture.rgb.isfinite().all())


def test_a_field_over_other_bounds_is_composed(setting, calls) -> None:
    """Its own bounds say where it is, whatever is looked at."""
    scene, renderer, camera = setting
    field = fitted(FIELD, scene)
    assert field.fused(scene.bounds) is not None
    half = replace(scene.bounds, lo=scene.bounds.lo / 2, hi=scene.bounds.hi / 2)
    with torch.no_grad():
        renderer.render_image(field, camera, Context(half))
    assert calls == []
