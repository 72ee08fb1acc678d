"""Heads without networks, a second encoding for colour, and densities around interpolation, against closed forms."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invgraphics.config import fill
from invgraphics.core import Quantity, Samples, harmonics
from invgraphics.errors import InputError
from invgraphics.fields.encodings.factors import CpConfig, VmConfig
from invgraphics.fields.encodings.lattices import LatticeFeatures
from invgraphics.fields.encodings.triplane import TriplaneConfig
from invgraphics.fields.encodings.voxels import VoxelsConfig
from invgraphics.fields.neural import NeuralField, NeuralFieldConfig

D, R, F, N = Quantity.DENSITY, Quantity.RADIANCE, Quantity.FEATURES, Quantity.NORMAL
GRID = NeuralFieldConfig(VoxelsConfig(2, features=1), geometry_head="none", appearance=VoxelsConfig(3, features=3), head="none")


def points(scene, m: int = 40) -> tuple[Samples, Tensor]:
    unit = torch.rand(m, 3, dtype=torch.float64)
    direction = torch.nn.functional.normalize(torch.randn(m, 3, dtype=torch.float64), dim=1)
    return Samples.at(scene.bounds.to(torch.float64).from_unit(unit), direction), unit


def built(config: NeuralFieldConfig, scene) -> NeuralField:
    field = config.build(scene).double()
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    return field


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("own", [True, False])
def test_harmonics_are_evaluated_in_the_direction(make_scene, degree: int, own: bool) -> None:
    """Red's coefficients come first; 0.5 is added and negative light cut off."""
    count = harmonics.count(degree)
    config = NeuralFieldConfig(
        VoxelsConfig(3, features=1 if own else 1 + 3 * count),
        geometry_head="none",
        head="sh",
        appearance=VoxelsConfig(3, features=3 * count) if own else None,
        colour_activation="clamp",
    )
    scene = make_scene()
    field = built(config, scene)
    samples, unit = points(scene)
    encoding = field.appearance if own else field.encoding
    assert encoding is not None
    features = encoding(unit)[:, 0 if own else 1 :]
    basis = harmonics.basis(samples.direction, degree)
    colour = torch.stack([(features[:, k * count : (k + 1) * count] * basis).sum(dim=1) for k in range(3)], dim=1)
    radiance = field.query(samples, R).radiance
    torch.testing.assert_close(radiance, (0.5 + colour).clamp_min(0))
    smooth = built(replace(config, colour_activation="sigmoid"), scene)
    smooth.load_state_dict(field.state_dict())
    torch.testing.assert_close(smooth.query(samples, R).radiance, colour.sigmoid())


def test_cut_off_light_can_come_back(make_scene) -> None:
    field = built(replace(GRID, colour_activation="clamp"), make_scene())
    assert field.appearance is not None
    (grid,) = field.appearance.parameters()
    torch.nn.init.constant_(grid, -3.0)
    samples, _ = points(make_scene())
    radiance = field.query(samples, R).radiance
    assert radiance is not None
    assert not radiance.any()
    (raising,) = torch.autograd.grad(-radiance.sum(), grid, retain_graph=True)
    (lowering,) = torch.autograd.grad(radiance.sum(), grid)
    assert float(raising.min()) < 0
    assert not lowering.any()


@pytest.mark.parametrize("kind", [VmConfig, CpConfig])
def test_density_is_the_sum_of_components(make_scene, kind) -> None:
    """TensoRF, equation 8: softplus(sum - 10), per length of the box over 25."""
    config = NeuralFieldConfig(
        kind(4, 5), geometry_head="none", appearance=kind(4, 6), density_bias=-10.0, density_scale=25.0, density_per="half"
    )
    for half in (1.5, 4.0):
        scene = make_scene(half=half)
        field = built(config, scene)
        samples, unit = points(scene)
        expected = 25 / half * torch.log1p(torch.exp(field.encoding(unit).sum(dim=1) - 10))
        torch.testing.assert_close(field.query(samples, D).density, expected, rtol=1e-6, atol=1e-12)


def test_tensorf_has_its_published_sizes(make_scene) -> None:
    config = NeuralFieldConfig(
        VmConfig(8, 16),
        geometry_head="none",
        appearance=VmConfig(8, 48),
        appearance_basis=27,
        feature_octaves=2,
        direction_degree=2,
        colour_layers=2,
    )
    field = config.build(make_scene())
    shapes = {name: tuple(parameter.shape) for name, parameter in field.named_parameters() if "net" in name or "basis" in name}
    assert shapes == {
        "basis.weight": (27, 144),
        "colour_net.hidden.0.weight": (128, 150),
        "colour_net.hidden.0.bias": (128,),
        "colour_net.hidden.1.weight": (128, 128),
        "colour_net.hidden.1.bias": (128,),
        "colour_net.output.weight": (3, 128),
        "colour_net.output.bias": (3,),
    }
    seen = []
    field.colour_net.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].double()))
    scene = make_scene()
    samples, unit = points(scene)
    float_samples = Samples.at(samples.position.float(), samples.direction.float())
    field.query(float_samples, R)
    assert field.appearance is not None
    own = field.appearance(unit.float()).double() @ field.basis.weight.double().T  # pyright: ignore[reportOptionalMemberAccess]
    for row, features in zip(seen[0].tolist(), own.tolist(), strict=True):
        assert row[:27] == pytest.approx(features, abs=1e-4)
        assert row[27:81] == pytest.approx([math.sin(2**k * x) for x in features for k in range(2)], abs=1e-4)
        assert row[81:135] == pytest.approx([math.cos(2**k * x) for x in features for k in range(2)], abs=1e-4)


def test_the_triplane_decoder_is_eg3ds(make_scene) -> None:
    """32 features, softplus, 64, softplus(density - 1), and colours of a widened sigmoid."""
    config = NeuralFieldConfig(
        TriplaneConfig(8), layers=1, width=64, skip=-1, geometry_features=3, head="none", hidden_activation="softplus",
        colour_padding=0.001,
    )  # fmt: skip
    scene = make_scene()
    field = built(config, scene)
    samples, unit = points(scene)
    (hidden,), output = field.geometry_net.hidden, field.geometry_net.output
    assert hidden.weight.shape == (64, 32) and output.weight.shape == (4, 64)
    h = torch.log1p(torch.exp(field.encoding(unit) @ hidden.weight.T + hidden.bias))
    out = h @ output.weight.T + output.bias
    values = field.query(samples, D | R | F)
    torch.testing.assert_close(values.density, torch.log1p(torch.exp(out[:, 0] - 1)))
    torch.testing.assert_close(values.radiance, out[:, 1:].sigmoid() * 1.002 - 0.001)
    again = field.query(replace(samples, features=values.features), R).radiance
    torch.testing.assert_close(again, values.radiance)


@pytest.mark.parametrize("interpolation", ["post", "in", "pre"])
def test_activation_after_inside_and_before_interpolation(make_scene, interpolation: str) -> None:
    """DVGO, figure 4: one voxel, raw values that change along x only."""
    scene = make_scene()
    field = built(replace(GRID, density_interpolation=interpolation, density_bias=0.5), scene)
    a, b = -3.0, 6.0
    with torch.no_grad():
        for parameter in field.encoding.parameters():
            parameter.copy_(torch.tensor([a, b]).view(2, 1, 1, 1).expand(2, 2, 2, 1))
    samples, unit = points(scene)
    density = field.query(samples, D).density
    assert density is not None
    softplus = lambda x: math.log1p(math.exp(x + 0.5))  # noqa: E731
    for found, t in zip(density.tolist(), unit[:, 0].tolist(), strict=True):
        mix = lambda low, high, t=t: low + t * (high - low)  # noqa: E731
        alpha = mix(*(1 - math.exp(-0.5 * softplus(raw)) for raw in (a, b)))
        expected = {"post": softplus(mix(a, b)), "in": mix(softplus(a), softplus(b)), "pre": -math.log(1 - alpha) / 0.5}
        assert found == pytest.approx(expected[interpolation])


@pytest.mark.parametrize("half", [1.0, 1.5])
def test_a_density_per_voxel_makes_dvgos_opacity(make_scene, half: float) -> None:
    """alpha = 1 - (1 + e^(d + shift))^(-interval), with intervals in voxels, whatever the box's size."""
    voxels, shift, start = 160, math.log(1 / (1 - 1e-2) - 1), 3.0
    config = replace(GRID, density_bias=shift, density_per="half", density_scale=voxels / 2)
    scene = make_scene(half=half)
    field = built(config, scene)
    torch.nn.init.constant_(next(field.encoding.parameters()), start)
    density = field.query(points(scene)[0], D).density
    assert density is not None
    step = 0.5 * 2 * half / voxels
    expected = 1 - (1 + math.exp(start + shift)) ** -0.5
    torch.testing.assert_close(1 - torch.exp(-density * step), torch.full_like(density, expected))


def test_colour_is_looked_up_where_it_is_asked(make_scene, monkeypatch) -> None:
    """A sampler that asks for densities and features gets no look-up of colour, and radiance needs none of geometry."""
    scene = make_scene()
    field = built(GRID, scene)
    samples, _ = points(scene)
    assert F not in field.provides and N in field.provides
    both = field.query(samples, D | R)
    with monkeypatch.context() as patched:
        patched.setattr(field.appearance, "forward", lambda *_: pytest.fail("colour was looked up"))
        torch.testing.assert_close(field.query(samples, D).density, both.density)
    monkeypatch.setattr(field.encoding, "forward", lambda *_: pytest.fail("geometry was looked up"))
    torch.testing.assert_close(field.query(samples, R).radiance, both.radiance)


def test_lattices_by_role(make_scene) -> None:
    both = GRID.build(make_scene()).lattice_encodings()
    assert set(both) == {"geometry", "appearance"}
    shared = replace(GRID, encoding=VoxelsConfig(2, features=4), appearance=None).build(make_scene())
    assert shared.lattice_encodings() == {"geometry": shared.encoding}
    assert isinstance(shared.encoding, LatticeFeatures)
    assert NeuralFieldConfig(layers=1, width=8, skip=-1).build(make_scene()).lattice_encodings() == {}


@pytest.mark.parametrize(
    "bad",
    [
        {"appearance_basis": 3},
        {"head": "sh", "feature_octaves": 1},
        {"geometry": "sdf", "geometry_head": "none"},
        {"density_scale": 0.0},
        {"density_interpolation": "in"},
        {"colour_padding": -0.1},
        {"head": "none", "geometry_features": 0},
    ],
)
def test_nonsense_is_refused(bad: dict) -> None:
    with pytest.raises(InputError) as caught:
        fill(NeuralFieldConfig, bad)
    assert "Unknown key" not in caught.value.sentence


def test_heads_without_a_network_say_how_many_features_they_take(make_scene) -> None:
    for head, features, expected in (("sh", 5, "27"), ("none", 5, "3 features")):
        with pytest.raises(InputError, match=expected):
            replace(GRID, head=head, appearance=VoxelsConfig(2, features=features)).build(make_scene())
