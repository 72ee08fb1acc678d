"""Fields over a class of objects: each conditioning against its formula, which code a ray gets, gradients, and the contract."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import layer_norm

from invgraphics.core import Conditional, Quantity, Samples, Scene
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model
from invgraphics.fields.conditional.field import ConditionalField, ConditionalFieldConfig
from invgraphics.fields.conditional.layers import ConcatenatedLayer, FilmLayer, HyperLayer
from invgraphics.recipes.recipe import load_method
from invgraphics.testing import check_field, toy_scene

WAYS = ("hypernetwork", "concatenation", "film")
SMALL = {"code": 5, "hidden": 6, "layers": 2, "width": 7, "features": 8}


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Six views of three subjects, 10 to 12."""
    toy = toy_scene(views=6, size=8)
    return replace(toy, train=tuple(replace(view, subject=10 + i // 2) for i, view in enumerate(toy.train)))


def field_of(scene: Scene, way: str, head: str = "none") -> ConditionalField:
    torch.manual_seed(3)
    field = ConditionalFieldConfig(conditioning=way, head=head, **SMALL).build(scene).double()  # pyright: ignore[reportArgumentType]
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return field


def samples(views: list[int]) -> Samples:
    position = torch.rand(len(views), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
    return replace(Samples.at(position), view=torch.tensor(views))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("head", ["none", "density"])
def test_a_field_over_a_class_keeps_the_contract(way: str, head: str, scene: Scene) -> None:
    check_field(ConditionalFieldConfig(conditioning=way, head=head, **SMALL).build(scene), scene)  # pyright: ignore[reportArgumentType]


def one_by_one(field: ConditionalField, x: Tensor, code: Tensor) -> Tensor:
    """Features of one point of one instance, with every conditioning written out for vectors."""
    x = field.network.encoding(field.network.bounds.to_unit(x[None]))[0]
    for layer in field.network.layers:
        if isinstance(layer, HyperLayer):
            flat = layer.hyper(code)
            weights = flat[: layer.outputs * layer.inputs].view(layer.outputs, layer.inputs)
            raw, scale, shift = weights @ x + flat[layer.outputs * layer.inputs :], 1.0, 0.0
        elif isinstance(layer, FilmLayer):
            raw = layer.linear.weight @ x + layer.linear.bias
            scale, shift = layer.film(code).view(2, -1)
            scale = 1 + scale
        else:
            assert isinstance(layer, ConcatenatedLayer)
            joined = torch.cat([layer.linear.weight, layer.code.weight], dim=1)
            raw = joined @ torch.cat([x, code]) + layer.linear.bias
            scale, shift = layer.norm.weight, layer.norm.bias
        normal = (raw - raw.mean()) / (raw.var(correction=0) + 1e-5).sqrt()
        assert torch.allclose(normal, layer_norm(raw, raw.shape))
        x = (normal * scale + shift).clamp_min(0)
    return x


@pytest.mark.parametrize("way", WAYS)
def test_each_ray_gets_the_code_of_its_view(way: str, scene: Scene) -> None:
    """Mixed views of one batch, in any order, against one point at a time; a view of -1 shows the mean code."""
    field, views = field_of(scene, way), [4, 0, 5, -1, 1, 4, 0, 2, -1]
    batch = samples(views)
    found = field.query(batch, Quantity.FEATURES).features
    assert found is not None
    for row, view in enumerate(views):
        code = field.codes.mean(dim=0) if view < 0 else field.codes[view // 2]
        assert torch.allclose(found[row], one_by_one(field, batch.position[row], code), atol=1e-10)


@pytest.mark.parametrize("way", WAYS)
def test_instances_and_other_codes_share_the_network(way: str, scene: Scene) -> None:
    field, batch = field_of(scene, way), samples([0, 3, 5])
    assert isinstance(field, Conditional)
    everything = field.query(batch, Quantity.FEATURES).features
    assert everything is not None
    alone = [field.of_subject(10 + i).query(batch[i : i + 1], Quantity.FEATURES).features for i in range(3)]
    assert torch.allclose(everything, torch.cat([one for one in alone if one is not None]))
    swapped = field.with_codes(field.codes.flip(0), torch.tensor([2, 0, 0, 1, 0, 0])).query(batch, Quantity.FEATURES).features
    assert swapped is not None and torch.allclose(swapped, everything)
    assert field.with_codes(field.codes, field.rows).network is field.network


@pytest.mark.parametrize("way", WAYS)
def test_gradients_of_codes_are_those_of_finite_differences(way: str, scene: Scene) -> None:
    field, batch = field_of(scene, way, "density"), samples([0, 3, 4, 4, -1])
    weights = torch.linspace(-1, 1, 15, dtype=torch.float64).view(5, 3)

    def value() -> Tensor:
        values = field.query(batch, Quantity.DENSITY | Quantity.RADIANCE)
        assert values.density is not None and values.radiance is not None
        return (values.radiance * weights).sum() + values.density.square().sum()

    (gradient,) = torch.autograd.grad(value(), [field.codes])
    for place in [(0, 1), (1, 4), (2, 2)]:
        ends = []
        for step in (1e-6, -2e-6):
            with torch.no_grad():
                field.codes[place] += step
                ends.append(float(value()))
        assert float(gradient[place]) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5)


@pytest.mark.parametrize("way", WAYS)
def test_normals_point_where_density_falls(way: str, scene: Scene) -> None:
    """Against central differences of the density, inside ``no_grad``; values beside normals are the same as without."""
    field, batch = field_of(scene, way, "density"), samples([0, 2, 4, -1])
    wanted = Quantity.NORMAL | Quantity.DENSITY
    values = field.query_no_grad(batch, wanted)
    slopes = []
    for axis in range(3):
        step = 1e-6 * torch.eye(3, dtype=torch.float64)[axis]
        low, high = (field.density_no_grad(replace(batch, position=batch.position + s * step)) for s in (-1, 1))
        slopes.append((high.log() - low.log()) / 2e-6)
    expected = torch.nn.functional.normalize(-torch.stack(slopes, dim=1), dim=1)
    assert values.normal is not None and values.density is not None and not values.normal.requires_grad
    assert torch.allclose(values.normal, expected, atol=1e-6)
    assert torch.equal(values.density, field.density_no_grad(batch))


def test_an_occupancy_grid_is_refused_which_would_know_the_mean_only(scene: Scene) -> None:
    method = load_method("prior/volumetric", "laptop", ['renderer.sampler={type="occupancy", resolution=8}'])
    with pytest.raises(InputError, match="shows many subjects, and an occupancy grid holds"):
        build_model(method, scene, 0, torch.device("cpu"))
