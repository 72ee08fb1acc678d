"""Learned aggregation: the LSTM's march and the transformer against their formulas, gradients, normals, and refusals."""

import math

import pytest
import torch
from torch import Tensor

from invgraphics.core import Bounds, Context, Field, Rays, Samples, check
from invgraphics.core.field import Quantity
from invgraphics.core.samples import FieldValues
from invgraphics.errors import NotComposableError
from invgraphics.fields.features import FeatureFieldConfig
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.renderers.ray_attention import AttentionBlock, RayAttentionConfig
from invgraphics.renderers.ray_normals import normals_from_distances
from invgraphics.renderers.srn import SRNConfig, within
from invgraphics.testing import check_field, check_renderer, toy_scene

F64 = torch.float64
BOX = Bounds(torch.full((3,), -1.0, dtype=F64), torch.full((3,), 1.0, dtype=F64))
SMALL = {"srn": SRNConfig(features=8, width=16, layers=1), "attention": RayAttentionConfig(features=8, width=16, samples=12)}


class Waves(Field):
    """Eight features, sines of position: a field whose features are known."""

    provides = Quantity.FEATURES

    @property
    def feature_width(self) -> int:
        return 8

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        phases = samples.position @ torch.linspace(-2, 2, 24, dtype=samples.position.dtype).view(3, 8)
        return FieldValues(features=phases.sin())


def rays(count: int = 5) -> Rays:
    torch.manual_seed(1)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, dtype=F64), dim=1) * 3
    directions = torch.nn.functional.normalize(0.4 * torch.randn(count, 3, dtype=F64) - origins, dim=1)
    return Rays.make(origins, directions, radius=1e-3)


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("space", ["box", "contracted"])
def test_renderers_keep_the_contract(name: str, space: str) -> None:
    scene = toy_scene(views=2, size=8, space=space)  # pyright: ignore[reportArgumentType]
    field = FeatureFieldConfig(layers=2, width=16, features=8).build(scene)
    check_field(field, scene)
    check_renderer(SMALL[name].build(scene), field, scene)


def test_a_march_is_the_recurrence_of_an_lstm() -> None:
    """Hochreiter and Schmidhuber's equations written out, with torch's order of gates: input, forget, cell, output."""
    renderer = SMALL["srn"].build(toy_scene(views=2, size=8)).double()
    clipped = BOX.clip(rays())
    marched = list(renderer.march(Waves(), clipped, Context(BOX)))
    cell, hidden = renderer.cell, renderer.config.hidden
    h = c = torch.zeros(len(clipped), hidden, dtype=F64)
    t = clipped.near
    for step in range(renderer.config.steps + 1):
        assert torch.allclose(marched[step], t, atol=1e-12)
        x = Waves().query(Samples.on(clipped, torch.arange(len(clipped)), t, t), Quantity.FEATURES).features
        assert x is not None
        gates = x @ cell.weight_ih.T + cell.bias_ih + h @ cell.weight_hh.T + cell.bias_hh
        i, f, g, o = gates.unflatten(1, (4, hidden)).unbind(1)
        c = f.sigmoid() * c + i.sigmoid() * g.tanh()
        h = o.sigmoid() * c.tanh()
        t = torch.minimum(torch.maximum(t + (h @ renderer.step.weight.T + renderer.step.bias)[:, 0], clipped.near), clipped.far)
    assert len(marched) == renderer.config.steps + 1
    assert bool((marched[-1] - marched[0] > 0.1).all())


def test_clamped_distances_can_come_back_but_go_no_further() -> None:
    x = torch.tensor([-1.0, -1.0, 0.5, 2.0, 2.0], requires_grad=True)
    (within(x, torch.zeros(5), torch.ones(5)) * torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0])).sum().backward()
    assert torch.equal(within(x, torch.zeros(5), torch.ones(5)), torch.tensor([0.0, 0.0, 0.5, 1.0, 1.0]))
    assert x.grad is not None
    assert torch.equal(x.grad, torch.tensor([0.0, -1.0, 1.0, 1.0, 0.0]))


def test_a_block_is_softmax_attention_head_by_head() -> None:
    torch.manual_seed(0)
    block = AttentionBlock(8, 2).double()
    tokens = torch.randn(3, 5, 8, dtype=F64)
    x, mixed = block.norm(tokens), []
    q, k, v = (x @ block.attention.in_proj_weight.T + block.attention.in_proj_bias).split(8, dim=2)
    for head in (slice(0, 4), slice(4, 8)):
        scores = torch.einsum("rid,rjd->rij", q[..., head], k[..., head]) / math.sqrt(4)
        mixed.append(torch.einsum("rij,rjd->rid", scores.exp() / scores.exp().sum(dim=2, keepdim=True), v[..., head]))
    expected = tokens + torch.cat(mixed, dim=2) @ block.attention.out_proj.weight.T + block.attention.out_proj.bias
    assert torch.allclose(block(tokens), expected + block.net(expected), atol=1e-12)


def test_the_background_takes_the_light_that_samples_leave() -> None:
    renderer = SMALL["attention"].build(toy_scene(views=2, size=8)).double()
    rendering, trace = renderer.render_rays(Waves(), rays(), Context(BOX))
    assert trace.samples is not None
    assert trace.weights is not None
    _, tokens = renderer._tokens(Waves(), BOX.clip(rays()), torch.arange(5), Context(BOX))
    scores = renderer.query(tokens)[..., 0].exp()
    background = renderer.background.exp()
    assert torch.allclose(trace.weights.view(5, 12), scores / (scores.sum(dim=1, keepdim=True) + background), atol=1e-12)
    assert torch.allclose(rendering.alpha, 1 - background / (scores.sum(dim=1) + background), atol=1e-12)


@pytest.mark.parametrize("name", SMALL)
def test_gradients_are_those_of_finite_differences(name: str) -> None:
    """In the aggregation's weights and in the rays' origins, through the unrolled march and the softmax."""
    renderer, batch = SMALL[name].build(toy_scene(views=2, size=8)).double(), rays()

    def value(origins: Tensor) -> Tensor:
        moved = Rays.make(origins, batch.directions, radius=1e-3)
        rendering, _ = renderer.render_rays(Waves(), moved, Context(BOX))
        return (rendering.rgb * torch.tensor([1.0, -2.0, 0.5], dtype=F64)).sum() + rendering.alpha.square().sum()

    origins = batch.origins.clone().requires_grad_(True)
    parameters = [parameter for parameter in renderer.parameters() if parameter.numel() > 3]
    gradients = torch.autograd.grad(value(origins), [origins, *parameters])
    with torch.no_grad():
        for tensor, gradient in zip([origins, *parameters], gradients, strict=True):
            towards = torch.randn_like(tensor)
            change = []
            for sign in (1, -1):
                tensor.add_(sign * 1e-6 * towards)
                change.append(value(origins))
                tensor.add_(-sign * 1e-6 * towards)
            expected = (change[0] - change[1]) / 2e-6
            assert float((gradient * towards).sum()) == pytest.approx(float(expected), rel=1e-4, abs=1e-7)


def test_normals_of_a_plane_and_of_a_sphere() -> None:
    batch = rays(40)
    plane = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=F64), dim=0)

    def to_plane(other: Rays) -> Tensor:
        return (0.1 - other.origins @ plane) / (other.directions @ plane)

    def to_sphere(other: Rays) -> Tensor:
        middle = -(other.origins * other.directions).sum(dim=1)
        return middle - (0.8 - (other.origins + middle[:, None] * other.directions).square().sum(dim=1)).sqrt()

    found = normals_from_distances(batch, to_plane(batch), to_plane)
    facing = torch.where((batch.directions @ plane)[:, None] > 0, -plane, plane)
    assert torch.allclose(found, facing, atol=1e-9)
    aimed = Rays.make(batch.origins, torch.nn.functional.normalize(-batch.origins + 0.2 * plane, dim=1), radius=1e-3)
    t = to_sphere(aimed)
    outward = torch.nn.functional.normalize(aimed.at(t), dim=1)
    assert float((normals_from_distances(aimed, t, to_sphere) * outward).sum(dim=1).min()) > math.cos(math.radians(0.3))


def test_another_number_of_features_is_refused_with_a_remedy() -> None:
    scene = toy_scene(views=2, size=8)
    field = NeuralFieldConfig(layers=1, width=16, skip=-1, geometry_features=7).build(scene)
    with pytest.raises(NotComposableError, match="SRN takes 8 features, but NeuralField offers 7") as refusal:
        check(field, SMALL["srn"].build(scene))
    assert refusal.value.remedy == "Set renderer.features to 7."
    check(field, SRNConfig(features=7, width=16).build(scene))
