"""No colour where a sample weighs little: the dense computation with those radiances set to zero, gradients included."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invgraphics.config import fill
from invgraphics.core import Bounds, Camera, Context, Quantity, Scene
from invgraphics.errors import InputError
from invgraphics.fields.encodings.factors import VmConfig
from invgraphics.fields.encodings.frequency import FrequencyConfig
from invgraphics.fields.neural import NeuralField, NeuralFieldConfig
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig

THRESHOLD = 0.03
NETWORKS = NeuralFieldConfig(
    FrequencyConfig(2), layers=1, width=8, skip=-1, geometry_features=5, colour_width=8, direction_degree=1, density_bias=0.5
)
FIELDS = {
    "features handed on": NETWORKS,
    "colour of its own": replace(NETWORKS, encoding=VmConfig(4, 3), geometry_head="none", appearance=VmConfig(4, 4)),
}


def built(kind: str, scene: Scene) -> NeuralField:
    torch.manual_seed(0)
    field = FIELDS[kind].build(scene).double()
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    return field


def composited(density: Tensor, radiance: Tensor, delta: Tensor, rays: int) -> tuple[Tensor, Tensor]:
    """Weights (rays, k), and their sums of radiance, written out."""
    depth = (density * delta).view(rays, -1)
    passed = torch.exp(-torch.nn.functional.pad(depth.cumsum(dim=1), (1, 0)))
    weights = passed[:, :-1] - passed[:, 1:]
    return weights, (weights[..., None] * radiance.view(rays, -1, 3)).sum(dim=1)


@pytest.mark.parametrize("kind", FIELDS)
def test_gradients_are_those_of_black_samples(
    make_scene: Callable[..., Scene], make_camera: Callable[..., Camera], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, camera = make_scene(), make_camera(4, 3, 5.0)
    field, rays = built(kind, scene), camera.rays()
    renderer = VolumetricConfig(StratifiedConfig(24), colour_threshold=THRESHOLD).build(scene)
    box = Bounds(torch.full((3,), -1.5).double(), torch.full((3,), 1.5).double())
    ctx = Context(box, training=True, generator=torch.Generator().manual_seed(0))
    asked, query = [], field.query
    with monkeypatch.context() as patched:
        patched.setattr(field, "query", lambda s, want: asked.append(len(s) * (Quantity.RADIANCE in want)) or query(s, want))
        rendering, trace = renderer.render_rays(field, rays, ctx)
    samples = trace.samples
    assert samples is not None
    values = field.query(samples, Quantity.DENSITY | Quantity.RADIANCE)
    assert values.density is not None and values.radiance is not None
    weights, _ = composited(values.density.detach(), values.radiance.detach(), samples.delta, len(rays))
    seen = (weights > THRESHOLD).reshape(-1)
    assert 0.1 < float(seen.double().mean()) < 0.6
    assert sum(asked) == int(seen.sum())
    _, expected = composited(values.density, values.radiance * seen[:, None], samples.delta, len(rays))
    torch.testing.assert_close(rendering.rgb, expected)
    cotangent = torch.randn_like(expected)
    parameters = list(field.parameters())
    found, wanted = (torch.autograd.grad((rgb * cotangent).sum(), parameters) for rgb in (rendering.rgb, expected))
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, atol=1e-9, rtol=1e-7)


def test_evaluation_and_the_default_ask_every_sample(
    make_scene: Callable[..., Scene], make_camera: Callable[..., Camera]
) -> None:
    scene, rays = make_scene(), make_camera(4, 3, 5.0).rays()
    field = built("colour of its own", scene)
    box = Bounds(torch.full((3,), -1.5).double(), torch.full((3,), 1.5).double())
    pictures = [
        VolumetricConfig(StratifiedConfig(24), colour_threshold=threshold)
        .build(scene)
        .render_rays(field, rays, Context(box, training, generator=torch.Generator().manual_seed(0)))[0]
        for training in (False, True)
        for threshold in (0.0, 0.5)
    ]
    assert torch.equal(pictures[0].rgb, pictures[1].rgb)
    assert not torch.equal(pictures[2].rgb, pictures[3].rgb)
    assert torch.equal(pictures[2].alpha, pictures[3].alpha)
    # No sample of this fog weighs half of a ray: nothing is asked, and densities have gradients of black alone.
    assert not pictures[3].rgb.any()
    pictures[3].rgb.sum().backward()


def test_nonsense_is_refused() -> None:
    with pytest.raises(InputError, match="colour_threshold"):
        fill(VolumetricConfig, {"colour_threshold": 1.0})
