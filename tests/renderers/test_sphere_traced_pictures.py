"""Sphere-traced pictures by kernels, whose rays begin where a grid of distances says, against traces of whole rays."""

import pytest
import torch

from invgraphics.core import Camera, Model
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.kernels import using
from invgraphics.renderers.sphere_tracing import SphereTracingConfig
from invgraphics.testing import perturb, toy_scene

ENCODINGS = {"hash": HashConfig(levels=4, log2_size=10, base=4, finest=24), "octaves": FrequencyConfig(4)}


def dented_ball(encoding: str, sharpness: float) -> tuple[Model, Camera]:
    torch.manual_seed(3)
    scene = toy_scene(views=2, size=16)
    settings = {"layers": 1, "width": 16, "skip": -1, "geometry_features": 3, "colour_width": 8, "direction": "sh"}
    field = NeuralFieldConfig(ENCODINGS[encoding], "sdf", **settings).build(scene)
    # Octaves make more of a change: their distances would grow faster than the way.
    perturb(field, 0.01 if encoding == "hash" else 0.002)
    renderer = SphereTracingConfig(final_sharpness=sharpness, relaxation=1.2).build(scene)
    return Model(field, renderer, scene.bounds), scene.test[0].camera.resized(80, 60)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("sharpness", [60.0, 1600.0])
@pytest.mark.parametrize("normals", [False, True])
def test_pictures_are_those_of_whole_rays(encoding: str, sharpness: float, normals: bool) -> None:
    model, camera = dented_ball(encoding, sharpness)
    picture, rays = model.render(camera, normals=normals), camera.rays()
    ctx = model.context(normals=normals)
    whole, _ = model.renderer.render_rays(model.field, rays, ctx)  # type: ignore[attr-defined]
    assert picture.rgb.shape == (60, 80, 3)
    assert 500 < int((picture.alpha > 0.5).sum()) < 4000
    soft = (whole.alpha > 0.01) & (whole.alpha < 0.99)
    assert int(soft.sum()) > (300 if sharpness < 100 else 1)
    for name in ("rgb", "alpha", "depth", "normal"):
        ours, expected = getattr(picture, name), getattr(whole, name)
        assert (ours is None) == (expected is None)
        if ours is not None:
            error = torch.where(ours.flatten(0, 1) == expected, 0.0, (ours.flatten(0, 1) - expected.detach()).abs())
            assert float(error.quantile(0.99)) < 1e-3, name
            assert float(error.mean()) < 5e-4, name


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_pictures_take_fewer_look_ups_than_whole_rays(encoding: str) -> None:
    model, camera = dented_ball(encoding, 400.0)
    camera = camera.resized(160, 120)
    with torch.no_grad():
        _, picture = model.renderer.render_image(model.field, camera, model.context())
        _, whole = model.renderer.render_rays(model.field, camera.rays(), model.context())  # type: ignore[attr-defined]
    assert picture.surface is not None
    assert whole.surface is not None
    assert len(picture.surface.steps) == len(whole.surface.steps) == 160 * 120
    assert float(picture.surface.steps.float().mean()) < 0.75 * float(whole.surface.steps.float().mean())


def test_fits_and_fields_without_kernels_trace_whole_rays() -> None:
    model, camera = dented_ball("hash", 400.0)
    assert model.renderer.render_whole(model.field, camera, model.context()) is None  # type: ignore[attr-defined]
    rendering, _ = model.renderer.render_image(model.field, camera, model.context())
    assert rendering.rgb.requires_grad
    with torch.no_grad(), using("reference"):
        assert model.renderer.render_whole(model.field, camera, model.context()) is None  # type: ignore[attr-defined]
