"""The table field x renderer: every registered pair composes and renders, or refuses with a sentence that says why."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import pytest
import torch

from invgraphics import plugins
from invgraphics.core import Context, Quantity, Scene, check
from invgraphics.errors import NotComposableError
from invgraphics.testing import perturb, toy_scene

ENCODINGS = sorted(plugins.names("encodings"))
FIELDS, RENDERERS, SAMPLERS = (sorted(plugins.names(registry)) for registry in ("fields", "renderers", "samplers"))

FEW = {
    "stratified": {"count": 24},
    "hierarchical": {"coarse": 12, "fine": 12},
    "occupancy": {"steps_per_diagonal": 64, "cone": 0.1, "resolution": 32},
    "proposals": {"counts": (12,), "count": 12},
    "up_sampling": {"coarse": 12, "fine": 12, "rounds": 2},
    "error_bounded": {"coarse": 12, "fine": 12, "extra": 4, "rounds": 2, "bisections": 4},
}
"""Settings of samplers that keep these pictures quick."""


@pytest.fixture(params=["box", "contracted"])
def scene(request: pytest.FixtureRequest) -> Scene:
    return toy_scene(views=2, size=8, space=request.param, facing="forward")  # planes need views from one side


def build(registry: str, name: str, scene: Scene, **settings: Any) -> Any:
    return replace(plugins.load(registry, name)(), **settings).build(scene)


def registered(scene: Scene) -> Iterator[tuple[str, Any, str, Any]]:
    """Every registered field with every registered renderer, as their defaults are."""
    for field in FIELDS:
        for renderer in RENDERERS:
            built = build("fields", field, scene)
            yield field, built, renderer, build("renderers", renderer, scene, **matching(renderer, built))


def matching(renderer: str, field: Any) -> dict[str, int]:
    """Settings of a renderer that takes features: as many as the field has."""
    takes = "features" in vars(plugins.load("renderers", renderer)())
    return {"features": field.feature_width} if takes and field.feature_width else {}


def in_turn(encoding: str) -> list[str]:
    """Two samplers for an encoding: a sampler asks a field for density or distance, whatever its encoding is."""
    place = ENCODINGS.index(encoding)
    return [SAMPLERS[(place + step) % len(SAMPLERS)] for step in (0, len(SAMPLERS) // 2)]


def variants(scene: Scene) -> Iterator[tuple[str, Any, str, Any]]:
    """A small neural field of every encoding and geometry, with every renderer of densities or distances; samplers in turn."""
    small = {"layers": 1, "width": 16, "skip": -1, "colour_layers": 1, "colour_width": 16, "geometry_features": 7}
    for encoding, geometry in product(ENCODINGS, ("density", "sdf")):
        name = f"neural/{encoding}/{geometry}"
        field = build("fields", "neural", scene, encoding=plugins.load("encodings", encoding)(), geometry=geometry, **small)
        perturb(field)
        yield name, field, "sphere_tracing", build("renderers", "sphere_tracing", scene)
        for sampler, renderer in product(in_turn(encoding), ("volumetric", "volsdf", "neus")):
            look = replace(plugins.load("samplers", sampler)(), **FEW.get(sampler, {}))
            yield name, field, f"{renderer}/{sampler}", build("renderers", renderer, scene, sampler=look)


def assert_draws(field: Any, renderer: Any, scene: Scene, learns: bool = True) -> None:
    """An 8x8 picture with finite numbers, and a gradient for something in the field."""
    ctx = Context(scene.bounds, training=True, geometry=True, generator=torch.Generator().manual_seed(0))
    rendering, _ = renderer.render_image(field, scene.train[0].camera, ctx)
    assert rendering.rgb.shape == (8, 8, 3)
    assert bool(torch.isfinite(rendering.rgb).all())
    assert bool(((rendering.alpha >= 0) & (rendering.alpha <= 1 + 1e-5)).all())
    assert bool((rendering.depth > 0).all())
    assert rendering.normal is not None
    norm = rendering.normal.norm(dim=-1)
    assert bool((((norm - 1).abs() < 1e-4) == (rendering.alpha >= 0.5)).all())
    if not list(field.parameters()):
        return  # nothing to fit
    field.zero_grad()
    rendering.over(scene.background).sum().backward()
    gradients = [parameter.grad for parameter in field.parameters() if parameter.grad is not None]
    assert any(bool(gradient.any()) for gradient in gradients) or not learns
    assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)


def test_every_pair_draws_or_refuses_with_a_sentence(scene: Scene) -> None:
    drawn, refused = set(), set()
    for field_name, field, renderer_name, renderer in (*registered(scene), *variants(scene)):
        missing = renderer.required & ~field.provides
        if missing:
            with pytest.raises(NotComposableError) as refusal:
                check(field, renderer)
            words = (missing.words(), type(field).__name__, type(renderer).__name__)
            assert all(word in refusal.value.sentence for word in words)
            refused.add((field_name, renderer_name))
        else:
            check(field, renderer)
            # The one point of an untrained march may be near no point of a cloud.
            assert_draws(field, renderer, scene, learns=(field_name, renderer_name) != ("points", "srn"))
            drawn.add((field_name, renderer_name))
    # A density alone has no colour: it is for samplers.
    assert {name for name, _ in drawn} >= set(FIELDS) - {"density"}
    # With their defaults, renderers of distances meet no field of distances.
    assert {name.partition("/")[0] for _, name in drawn} >= set(RENDERERS)
    assert {("gaussians", "splatting"), ("gaussians", "volumetric")} <= drawn
    assert ("neural", "splatting") in refused
    for renderer, wanted, other in (("volumetric", "density", "sdf"), ("volsdf", "sdf", "density"), ("neus", "sdf", "density")):
        pairs = {(encoding, f"{renderer}/{sampler}") for encoding in ENCODINGS for sampler in in_turn(encoding)}
        assert {name.partition("/")[2] for _, name in pairs} == set(SAMPLERS)
        of_distances = {"volumetric/up_sampling", "volumetric/error_bounded"}
        assert {(f"neural/{encoding}/{wanted}", name) for encoding, name in pairs if name not in of_distances} <= drawn
        assert {(f"neural/{encoding}/{other}", name) for encoding, name in pairs} <= refused
    for renderer in ("volsdf", "neus"):
        assert {("neural", renderer), ("gaussians", renderer)} <= refused
    assert {(f"neural/{encoding}/sdf", "sphere_tracing") for encoding in ENCODINGS} <= drawn
    assert {("neural", "sphere_tracing"), ("gaussians", "sphere_tracing"), ("neural/hash/density", "sphere_tracing")} <= refused


def test_the_sentence() -> None:
    scene = toy_scene(views=2, size=8)
    field, renderer = build("fields", "neural", scene), build("renderers", "splatting", scene)
    with pytest.raises(NotComposableError, match=r"Splatting needs gaussians, which NeuralField does not provide\."):
        check(field, renderer)
    with pytest.raises(NotComposableError, match="gaussians"):
        field.primitives(Quantity.GAUSSIANS, Context(scene.bounds))
