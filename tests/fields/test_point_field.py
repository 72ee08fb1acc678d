"""Neural points: by hand for few points, against a k-d tree's neighbours, starts, support, conformance."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from torch.nn.functional import softplus

from invgraphics.core import Context, Points, Quantity, Samples
from invgraphics.errors import InputError, NotComposableError
from invgraphics.fields.gaussian import GaussianFieldConfig
from invgraphics.fields.points.field import ROWS, PointFieldConfig
from invgraphics.renderers.occupancy import OccupancyConfig
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import TwoBalls, check_field, check_renderer, toy_scene

SMALL = PointFieldConfig(features=4, neighbours=3, layers=2, width=8, octaves=2, colour_layers=1, colour_width=8)
D, R = Quantity.DENSITY, Quantity.RADIANCE


@pytest.fixture(scope="module")
def scene():
    return toy_scene(views=3, size=8)


def test_one_neighbour_by_hand(scene) -> None:
    points = Points(torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]), torch.tensor([[0.9, 0.2, 0.4], [0.1, 0.6, 0.7]]))
    field = replace(SMALL, confidence=0.25).from_points(points, scene)
    with torch.no_grad():
        field.density_head.weight.zero_()
        field.density_head.bias.fill_(2.0)
        field.colour_net.output.weight.zero_()
        field.colour_net.output.bias.zero_()
        field.radius.fill_(0.4)
    at = Samples.at(torch.tensor([[0.05, 0.0, 0.0], [0.25, 0.0, 0.0], [0.0, 0.9, 0.0]]))
    values = field.query(at, D | R)
    one = 0.25 * float(softplus(torch.tensor(1.0))) * field.config.density_scale / 0.4
    assert values.density.tolist() == pytest.approx([one, one, 0.0], rel=1e-5)  # 0.45 away from the second point
    assert values.radiance[0].tolist() == pytest.approx([0.9, 0.2, 0.4], abs=1e-5)
    # Half way between them: the mean of the raw colours, and half of each confidence.
    assert values.radiance[1].tolist() == pytest.approx(points.rgb.logit().mean(dim=0).sigmoid().tolist(), abs=1e-5)
    with torch.no_grad():
        field.confidence_logits[1] = torch.tensor(0.75).logit()
    assert field.query_no_grad(at, D).density[1].item() == pytest.approx(2 * one, rel=1e-5)


def test_weights_are_inverse_distances_to_the_k_d_trees_neighbours(scene) -> None:
    torch.manual_seed(0)
    field = SMALL.from_points(Points(torch.rand(60, 3) - 0.5, torch.rand(60, 3)), scene)
    with torch.no_grad():
        field.colour_net.output.weight.zero_()
        field.colour_net.output.bias.zero_()
    position = torch.rand(40, 3) - 0.5
    tree, radius = KDTree(field.positions.numpy()), float(field.radius)
    distance, index = tree.query(position.numpy(), k=3, distance_upper_bound=radius)
    weight = np.where(np.isinf(distance), 0, 1 / distance)
    raw = np.append(field.raw_rgb.detach().numpy(), np.zeros((1, 3)), axis=0)  # the tree's index of nothing
    expected = (weight[:, :, None] * raw[index]).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    found = field.query(Samples.at(position), D | R)
    near = weight.any(axis=1)
    assert near.any()
    np.testing.assert_allclose(found.radiance.detach().logit().numpy()[near], expected[near], atol=2e-3)
    assert not found.density[~near].any()


def test_contract_and_samplers(scene) -> None:
    field = SMALL.build(scene)
    check_field(field, scene)
    for sampler in (StratifiedConfig(32), OccupancyConfig(resolution=16, steps_per_diagonal=64)):
        check_renderer(VolumetricConfig(sampler).build(scene), field, scene)
    # Radiance of features that a sampler brings along is that of another look.
    samples = Samples.at(field.positions[:9] + 0.01)
    whole = field.query(samples, D | R | Quantity.FEATURES)
    again = field.query(replace(samples, features=whole.features), R).radiance
    torch.testing.assert_close(again, whole.radiance)


def test_support_holds_every_sample_with_a_density(scene) -> None:
    field = SMALL.build(scene)
    support = field.support(scene.bounds, 20)
    unit = torch.rand(20_000, 3)
    density = field.density_no_grad(Samples.at(scene.bounds.from_unit(unit)))
    x, y, z = (unit * 20).long().unbind(dim=1)
    assert bool(support[x, y, z][density > 0].all())
    assert 0.02 < float(support.float().mean()) < 0.8
    sampler = OccupancyConfig(resolution=20, grace=5).build(scene)
    sampler.update(field, Context(scene.bounds, training=True))
    assert torch.equal(sampler.occupied, support)


@pytest.mark.parametrize("resolution", [5, 12])
def test_support_is_the_cells_that_a_box_around_a_point_meets(scene, resolution: int) -> None:
    torch.manual_seed(1)
    # Some overlap, some stick out of the bounds, some are wholly outside.
    position = scene.bounds.from_unit(2 * torch.rand(12, 3) - 0.5)
    field = SMALL.from_points(Points(position, torch.full((12, 3), 0.5)), scene)
    field.radius.fill_(0.15)
    reach = field.radius / (2 * scene.bounds.half)
    unit, first = scene.bounds.to_unit(position)[:, None], torch.arange(resolution)[:, None]
    meets = ((unit + reach) * resolution >= first) & ((unit - reach) * resolution < first + 1)
    x, y, z = meets.unbind(dim=2)
    boxes = x[:, :, None, None] & y[:, None, :, None] & z[:, None, None, :]
    assert 0 < int(boxes.flatten(1).any(dim=1).sum()) < 12
    assert torch.equal(field.support(scene.bounds, resolution), boxes.any(dim=0))


@pytest.mark.parametrize("init", ["scene", "random", "depth"])
def test_starts(scene, init: str) -> None:
    torch.manual_seed(0)
    field = replace(SMALL, init=init, count=50, max_init=50).build(scene)
    count = len(field.positions)  # pictures of 8 x 8 pixels have few depths
    assert count == 50 or (init == "depth" and 20 < count < 50)
    if init != "random":
        truth = TwoBalls()
        distance = (field.positions[:, None] - truth.centres).norm(dim=-1) - truth.radii
        assert float(distance.abs().amin(dim=1).max()) < 0.1
    points = field.primitives(Quantity.POINTS, Context(scene.bounds))
    assert points.confidence.tolist() == pytest.approx([0.15] * count)
    assert bool(((points.rgb > 0) & (points.rgb < 1)).all())


def test_start_from_other_fields(scene) -> None:
    config = replace(SMALL, init="field", source="somewhere", max_init=30)
    splats = GaussianFieldConfig(count=40, init="random").build(scene)
    with torch.no_grad():
        splats.opacity_logits[7] = 3.0
    field = config.converted(splats, scene)
    assert len(field.positions) == 30
    assert torch.equal(field.positions[0], splats.means[7])
    assert len(config.converted(TwoBalls(), scene).positions) == 30


def test_checkpoint_of_another_number_of_points(scene) -> None:
    small, big = replace(SMALL, max_init=20).build(scene), replace(SMALL, max_init=33).build(scene)
    small.load_state_dict(big.state_dict())
    assert all(torch.equal(getattr(small, name), getattr(big, name)) for name in ROWS)
    at = Samples.at(big.positions[:5] + 0.01)
    assert torch.equal(small.query(at, D).density, big.query(at, D).density)


def test_bad_input(scene) -> None:
    for wrong in ({"neighbours": 0}, {"confidence": 1.0}, {"init": "field"}, {"direction_degree": 5}):
        with pytest.raises(ValueError, match=next(iter(wrong)) if "init" not in wrong else "source"):
            replace(SMALL, **wrong)
    with pytest.raises(InputError, match="no points"):
        SMALL.from_points(Points(torch.zeros(0, 3), torch.zeros(0, 3)), scene)
    with pytest.raises(NotComposableError, match="planes"):
        SMALL.build(scene).primitives(Quantity.PLANES, Context(scene.bounds))


def test_points_join_with_what_is_known_of_both() -> None:
    one = Points(torch.zeros(2, 3), torch.ones(2, 3), confidence=torch.tensor([0.1, 0.2]))
    other = Points(torch.ones(1, 3), torch.zeros(1, 3))
    assert one.joined(one).confidence.tolist() == pytest.approx([0.1, 0.2, 0.1, 0.2])
    assert one.joined(other).confidence is None
    assert len(one.joined(other)) == 3
    assert one[1:].confidence.tolist() == pytest.approx([0.2])
