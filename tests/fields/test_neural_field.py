"""Neural fields: gradients and normals by finite differences, chunks, edges of the region, and the published sizes."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from invgraphics import kernels
from invgraphics.config import fill, to_table
from invgraphics.core import Bounds, Quantity, Samples
from invgraphics.errors import InputError
from invgraphics.fields import geometry
from invgraphics.fields.encodings.factors import CpConfig, VmConfig
from invgraphics.fields.encodings.frequency import FrequencyConfig, frequencies
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.encodings.sparse import SparseVoxelsConfig
from invgraphics.fields.encodings.triplane import TriplaneConfig
from invgraphics.fields.encodings.voxels import VoxelsConfig
from invgraphics.fields.mlp import Mlp, truncated_exp
from invgraphics.fields.neural import NeuralField, NeuralFieldConfig
from invgraphics.testing import toy_scene

D, S, G, R, N = Quantity.DENSITY, Quantity.SDF, Quantity.GRADIENT, Quantity.RADIANCE, Quantity.NORMAL

SMALL = NeuralFieldConfig(
    FrequencyConfig(octaves=2), layers=2, width=12, skip=0, geometry_features=5, colour_width=8, direction_degree=2
)
HASH = replace(
    SMALL, encoding=HashConfig(levels=2, features=2, log2_size=6, base=2, finest=6), direction="sh", density_activation="exp"
)
TENSORF = replace(
    SMALL,
    encoding=VmConfig(5, 2),
    geometry_head="none",
    appearance=VmConfig(5, 3),
    appearance_basis=4,
    feature_octaves=1,
    density_scale=3.0,
)
GRID = replace(SMALL, encoding=VoxelsConfig(4, features=1 + 12), geometry_head="none", head="sh")
KINDS = {
    "frequency": SMALL,
    "hash": HASH,
    "sdf": replace(SMALL, geometry="sdf"),
    "hash sdf": replace(HASH, geometry="sdf", direction="none"),
    "sdf and its colour": replace(SMALL, geometry="sdf", colour_inputs=("position", "normal")),
    "hash sdf and its colour": replace(HASH, geometry="sdf", colour_inputs=("normal",)),
    "density and its colour": replace(SMALL, colour_inputs=("position", "normal")),
    "vm": TENSORF,
    "cp": replace(TENSORF, encoding=CpConfig(5, 2), appearance=CpConfig(5, 3), appearance_basis=0),
    "triplane": replace(
        SMALL,
        encoding=TriplaneConfig(5, 4),
        geometry_features=3,
        head="none",
        hidden_activation="softplus",
        colour_padding=0.01,
    ),
    "grid": GRID,
    "grid, activated inside": replace(GRID, density_interpolation="in"),
    "grid of opacities": replace(GRID, density_interpolation="pre"),
    "two encodings and handed features": replace(SMALL, appearance=VoxelsConfig(4, features=2)),
    "triplane sdf": replace(SMALL, encoding=TriplaneConfig(5, 4), geometry="sdf", colour_inputs=("position", "normal")),
    "vm sdf": replace(SMALL, encoding=VmConfig(5, 2), geometry="sdf", colour_inputs=("position", "normal")),
    "dense sdf": replace(SMALL, encoding=VoxelsConfig(6, features=2, levels=2, coarsest=3), geometry="sdf"),
}


def _field(config: NeuralFieldConfig, scene) -> NeuralField:
    field = config.build(scene).double()
    # Away from the start: tables are almost zero there, and a distance function does not see its encoding.
    for name, parameter in field.named_parameters():
        torch.nn.init.normal_(parameter, std=1.0 if "table" in name else 0.4)
    return field


def _samples(scene, m: int = 6) -> Samples:
    unit = 0.05 + 0.9 * torch.rand(m, 3, dtype=torch.float64)
    direction = torch.nn.functional.normalize(torch.randn(m, 3, dtype=torch.float64), dim=1)
    return Samples.at(scene.bounds.to(torch.float64).from_unit(unit), direction)


def _flat(field: NeuralField, samples: Samples, want: Quantity) -> torch.Tensor:
    values = field.query(samples, want)
    parts = [values.density, values.sdf, values.radiance, values.gradient]
    return torch.cat([part.reshape(-1) for part in parts if part is not None])


@pytest.mark.parametrize("space", ["box", "contracted"])
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_to_positions_directions_and_parameters(make_scene, kind, space):
    scene = make_scene(space)
    field = _field(KINDS[kind], scene)
    samples = _samples(scene, 3)
    want = field.provides & ~N

    def at(position, direction):
        return _flat(field, replace(samples, position=position, direction=direction), want)

    inputs = (samples.position.clone().requires_grad_(), samples.direction.clone().requires_grad_())
    assert torch.autograd.gradcheck(at, inputs, eps=1e-7, atol=1e-5)

    # Parameters: the directional derivative along a random direction in the space of all of them.
    def total():
        flat = _flat(field, samples, want)
        return (flat * torch.arange(1, len(flat) + 1)).sum()

    parameters = list(field.parameters())
    gradients = torch.autograd.grad(total(), parameters)
    along = [torch.randn_like(parameter) for parameter in parameters]
    expected, step = sum((g * v).sum() for g, v in zip(gradients, along, strict=True)), 1e-6
    ends = []
    with torch.no_grad():
        for sign in (1, -2):
            for parameter, v in zip(parameters, along, strict=True):
                parameter.add_(sign * step * v)
            ends.append(total())
    torch.testing.assert_close((ends[0] - ends[1]) / (2 * step), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("space", ["box", "contracted"])
@pytest.mark.parametrize("kind", KINDS)
def test_normals_are_the_gradient_even_without_grad(make_scene, kind, space):
    scene = make_scene(space)
    field = _field(KINDS[kind], scene)
    samples = _samples(scene)
    quantity, sign = (S, 1) if field.config.geometry == "sdf" else (D, -1)
    step, slopes = 1e-6, []
    for axis in torch.eye(3, dtype=torch.float64):
        ahead, behind = (_flat(field, replace(samples, position=samples.position + s * step * axis), quantity) for s in (1, -1))
        slopes.append(sign * (ahead - behind) / (2 * step))
    expected = torch.nn.functional.normalize(torch.stack(slopes, dim=1), dim=1)
    with torch.no_grad():
        values = field.query(samples, (field.provides & G) | N | R)
    assert values.normal is not None
    if values.gradient is not None:
        assert not values.gradient.requires_grad
        torch.testing.assert_close(values.gradient, torch.stack(slopes, dim=1), atol=1e-4, rtol=1e-4)
    assert values.radiance is not None
    assert not values.normal.requires_grad
    assert not values.radiance.requires_grad
    torch.testing.assert_close(values.normal, expected, atol=1e-4, rtol=1e-4)


def test_normals_can_be_trained(make_scene):
    scene = make_scene()
    for config in KINDS.values():
        field = _field(config, scene)
        normal = field.query(_samples(scene), N).normal
        assert normal is not None
        gradient = torch.autograd.grad(
            normal[:, 0].sum(), list(field.encoding.parameters()) or [field.geometry_net.hidden[0].weight]
        )
        assert float(gradient[0].abs().max()) > 0


@pytest.mark.parametrize("kind", ["hash", "triplane sdf", "vm sdf", "dense sdf"])
def test_losses_on_gradients_reach_all_parameters_as_in_the_reference(make_scene, kind):
    """With compiled kernels: the vector-Jacobian product in positions alone loses none of the table's second derivatives."""
    scene = make_scene()
    field = _field(KINDS[kind], scene).float()
    samples = _samples(scene, 40)
    samples = replace(samples, position=samples.position.float(), direction=samples.direction.float())
    found = {}
    for implementation in kernels.dispatch.cpu_implementations():
        with kernels.using(implementation):
            values = field.query(samples, (field.provides & G) | N)
            slope = values.normal if values.gradient is None else values.gradient
            assert slope is not None
            found[implementation] = torch.autograd.grad(
                slope.square().sum() + slope[:, 0].sum(), list(field.encoding.parameters())
            )
    reference = found.pop("reference")
    for gradients in found.values():
        for ours, theirs in zip(gradients, reference, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-4 * float(theirs.abs().max()))


@pytest.mark.parametrize("grad", [True, False])
@pytest.mark.parametrize("kind", ["hash", "sdf", "vm", "two encodings and handed features"])
def test_chunks_change_nothing(make_scene, monkeypatch, kind, grad):
    scene = make_scene()
    field = _field(KINDS[kind], scene)
    samples = _samples(scene, 50)
    results = []
    for chunk in (1000, 7):
        monkeypatch.setattr(geometry, "CPU_CHUNK", chunk)
        with torch.set_grad_enabled(grad):
            values = field.query(samples, field.provides)
        results.append([getattr(values, name) for name in ("density", "sdf", "gradient", "radiance", "normal")])
    for one, other in zip(*results, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_no_samples(make_scene, kind):
    field = _field(KINDS[kind], make_scene())
    values = field.query(_samples(make_scene(), 0), field.provides)
    assert values.radiance is not None
    assert values.normal is not None
    assert values.radiance.shape == values.normal.shape == (0, 3)


def test_density_is_zero_outside_the_box(make_scene):
    scene = make_scene("box")
    field = _field(SMALL, scene)
    centre, half = scene.bounds.centre.double(), scene.bounds.half.double()
    offsets = torch.tensor([[1.01, 0, 0], [0, -1.01, 0], [0, 0, 5.0], [0.99, 0.99, 0.99]], dtype=torch.float64)
    density = field.query(Samples.at(centre + offsets * half), D).density
    assert density is not None
    assert (density[:3] == 0).all()
    assert density[3] > 0


@pytest.mark.parametrize("kind", KINDS)
def test_contracted_space_is_finite_far_away(make_scene, kind):
    scene = make_scene("contracted")
    field = _field(KINDS[kind], scene).float()
    far = Samples.at(torch.tensor([[1e4, 0, 0], [-1e6, 1e6, 1e6], [0, 0, 1e9]]))
    position = far.position.requires_grad_()
    values = field.query(far, field.provides)
    for value in (values.density, values.sdf, values.radiance, values.normal):
        assert value is None or torch.isfinite(value).all()
    radiance = values.radiance
    assert radiance is not None
    assert torch.isfinite(torch.autograd.grad(radiance.sum(), position)[0]).all()


def test_only_what_is_wanted_is_computed(make_scene, monkeypatch):
    field = _field(SMALL, make_scene())
    monkeypatch.setattr(field.colour_net, "forward", lambda *_: pytest.fail("the colour network was asked"))
    values = field.query(_samples(make_scene()), D)
    assert values.density is not None
    assert values.radiance is None
    assert values.normal is None


def test_colour_range_follows_the_scene(make_scene):
    scene = make_scene(colour="linear")
    field = _field(SMALL, scene)
    with torch.no_grad():
        field.colour_net.output.bias.fill_(5.0)
    radiance = field.query(_samples(scene), R).radiance
    assert radiance is not None
    assert float(radiance.detach().min()) > 1
    srgb = _field(SMALL, make_scene())
    srgb.load_state_dict(field.state_dict())
    bounded = srgb.query(_samples(scene), R).radiance
    assert bounded is not None
    assert float(bounded.detach().max()) <= 1


SPHERES = [
    (FrequencyConfig(octaves=6), 8, 4),
    (HashConfig(log2_size=12), 1, -1),
    (VoxelsConfig(9, features=4, levels=2, coarsest=5), 2, -1),
    (SparseVoxelsConfig(8), 1, -1),
    (VmConfig(8, 4), 1, -1),
    (CpConfig(8, 12), 1, -1),
    (TriplaneConfig(8, 8), 1, -1),
]


@pytest.mark.parametrize(("encoding", "layers", "skip"), SPHERES)
@pytest.mark.parametrize(("space", "interior"), itertools.product(["box", "contracted"], [False, True]))
def test_a_signed_distance_starts_as_a_sphere(make_scene, encoding, layers, skip, space, interior):
    """On every encoding, in a cube and in a flatter box: distances, and gradients of length 1 along the radius.

    The sphere is a solid one before the cameras, and a hollow one of two or three times its radius around cameras in the box,
    or in endless space around those that look away from its middle.
    """
    sign, radius = (-1, 1.0 if space == "box" else 1.5) if interior else (1, 0.5)
    for flat in (1.0, 0.6):
        scene = make_scene(space)
        if space == "box" and not interior:
            away = torch.eye(4)
            away[0, 3] = 4.0
            camera = replace(scene.train[0].camera, cam_to_world=away)
            scene = scene.with_views(train=(replace(scene.train[0], camera=camera),))
        if space == "contracted" and interior:
            outwards = torch.eye(4)
            outwards[2, 3] = 0.3 * float(scene.bounds.half[2])
            camera = replace(scene.train[0].camera, cam_to_world=outwards)
            scene = scene.with_views(train=(replace(scene.train[0], camera=camera),))
        half = scene.bounds.half * torch.tensor([1.0, 1.0, flat])
        bounds = Bounds(scene.bounds.centre - half, scene.bounds.centre + half, space)
        scene = replace(scene, bounds=bounds)
        field = NeuralFieldConfig(encoding, "sdf", layers, 128, skip, colour_inputs=("position", "normal")).build(scene)
        offset = (torch.rand(500, 3) * 2 - 1) * half
        inside = (offset / half).norm(dim=1) < 1  # contracted space bends distances beyond the unit ball
        values = field.query_no_grad(Samples.at(bounds.centre + offset), S | G)
        assert values.sdf is not None
        assert values.gradient is not None
        error = (sign * values.sdf - (offset.norm(dim=1) - radius * half[2]))[inside]
        assert float(error.abs().mean()) < 0.05 * float(half.mean())
        away = inside & (offset.norm(dim=1) > 0.2 * half.mean())
        cosine = sign * (values.gradient * torch.nn.functional.normalize(offset, dim=1)).sum(dim=1)[away]
        assert float((cosine - 1).abs().mean()) < 0.1
        assert float((values.gradient.norm(dim=1)[away] - 1).abs().mean()) < 0.1


def test_nerf_and_instant_ngp_have_their_published_sizes(make_scene):
    count = lambda net: sum(parameter.numel() for parameter in net.parameters())  # noqa: E731
    field = NeuralFieldConfig().build(make_scene())
    # nerf-pytorch: 8 x 256, input 63 again after layer 4, density and 256 features, view branch 283 -> 128 -> 3
    trunk = (63 * 256 + 256) + 6 * (256 * 256 + 256) + (319 * 256 + 256)
    assert count(field.geometry_net) == trunk + (256 + 1) + (256 * 256 + 256)
    assert count(field.colour_net) == (283 * 128 + 128) + (128 * 3 + 3)
    ngp = NeuralFieldConfig(HashConfig(), "density", 1, 64, -1, 15, 2, 64, "sh", 4, "exp", 0.0).build(make_scene())
    assert count(ngp.geometry_net) == 32 * 64 + 64 + 64 * 16 + 16
    assert count(ngp.colour_net) == (31 * 64 + 64) + (64 * 64 + 64) + (64 * 3 + 3)
    assert {name for name, _ in ngp.named_children()} == {"encoding", "geometry_net", "colour_net"}


@pytest.mark.parametrize(("activation", "expected"), [("softplus", math.log1p(math.e)), ("exp", math.e), ("relu", 1.0)])
def test_density_activation_and_bias_in_any_box(make_scene, activation, expected):
    """A network that says 2, with bias -1: the density is that of 1, per local unit, whatever the box's size."""
    for half in (0.5, 4.0):
        field = _field(replace(SMALL, density_activation=activation, density_bias=-1.0), make_scene(half=half))
        with torch.no_grad():
            field.geometry_net.output.weight.zero_()
            field.geometry_net.output.bias.fill_(2.0)
        density = field.query(Samples.at(field.lo[None] + half), D).density
        assert density is not None
        assert density.item() == pytest.approx(expected)


def test_truncated_exp_keeps_a_finite_slope():
    x = torch.tensor([-3.0, 2.0, 15.0, 200.0], dtype=torch.float64, requires_grad=True)
    y = truncated_exp(x)
    torch.testing.assert_close(y, x.detach().clamp_max(15).exp())
    torch.testing.assert_close(torch.autograd.grad(y.sum(), x)[0], y.detach())
    below = torch.tensor([-3.0, 2.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(truncated_exp, (below,))


def test_mlp_skip_is_the_written_out_product():
    net = Mlp(inputs=3, layers=2, width=4, outputs=5, skip=0).double()
    x = torch.randn(6, 3, dtype=torch.float64)
    first, second = net.hidden
    h = torch.relu(x @ first.weight.T + first.bias)
    h = torch.relu(torch.cat([h, x], dim=1) @ second.weight.T + second.bias)
    expected = h @ net.output.weight.T + net.output.bias
    torch.testing.assert_close(net(x), expected)
    torch.testing.assert_close(net(x, 2), expected[:, :2])


def test_directions_reach_the_colour_as_octaves(make_scene):
    field = _field(SMALL, make_scene())
    seen = []
    field.colour_net.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    samples = _samples(make_scene())
    field.query(samples, R)
    torch.testing.assert_close(seen[0][:, 5:], frequencies(samples.direction, 2))


@pytest.mark.parametrize("bad", [{"skip": 9}, {"direction": "sh", "direction_degree": 5}, {"layers": -1}, {"width": 0}])
def test_nonsense_is_refused(bad):
    with pytest.raises(InputError) as caught:
        fill(NeuralFieldConfig, bad)
    assert "Unknown key" not in caught.value.sentence


def test_config_survives_a_round_trip():
    for config in KINDS.values():
        assert fill(NeuralFieldConfig, to_table(config)) == config


def test_a_new_field_is_as_thin_in_endless_space_as_in_a_box(make_scene) -> None:
    """Its optical depth from the middle outward is the contracted distance, 2 - 1/r, times the density it starts with."""
    for half in (1.5, 0.2):
        scene = make_scene("contracted", half=half)
        config = NeuralFieldConfig(layers=1, width=8, skip=-1, geometry_features=2, density_bias=0.5, density_per="contracted")
        field = config.build(scene)
        torch.nn.init.zeros_(field.geometry_net.output.weight)
        torch.nn.init.zeros_(field.geometry_net.output.bias)
        r = torch.cat([torch.linspace(0, 1, 2001), torch.logspace(0, 2, 4001)[1:]]).double()
        position = scene.bounds.centre + (half * (r[1:] + r[:-1]) / 2).float()[:, None] * torch.tensor([[0.6, 0.0, 0.8]])
        density = field.density_no_grad(Samples.at(position)).double()
        depth = (density * half * r.diff()).sum()
        start = math.log1p(math.exp(0.5))  # softplus
        assert float(depth) == pytest.approx(start * (2 - 1 / 100), rel=1e-3)


@pytest.mark.parametrize("inputs", [(), ("position",)])
@pytest.mark.parametrize("geometry", ["density", "sdf"])
def test_a_crop_off_the_middle_changes_no_value_within(geometry, inputs) -> None:
    """Networks see positions from the middle of the first box, whatever box the lattices span now."""
    torch.manual_seed(0)
    config = replace(SMALL, encoding=VoxelsConfig(33, features=4), geometry=geometry, colour_inputs=inputs)
    field = config.build(toy_scene(2, 8))
    points = torch.rand(300, 3) * torch.tensor([0.6, 0.9, 0.5]) - torch.tensor([0.3, 0.2, 0.25])
    want = (S if geometry == "sdf" else D) | R
    with torch.no_grad():
        before = field.query(Samples.at(points), want)
        field.crop(torch.tensor([-0.4, -0.3, -0.35]), torch.tensor([0.5, 0.9, 0.4]), 200)
        after = field.query(Samples.at(points), want)
    values = [value.sdf if geometry == "sdf" else value.density for value in (before, after)]
    torch.testing.assert_close(values[1], values[0], atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(after.radiance, before.radiance, atol=1e-3, rtol=0)
