"""DVGO's hooks and losses: the tight box against a known one, view counts against single projections, losses by hand."""

import math
from dataclasses import replace

import pytest
import torch

from invgraphics.core import Batch, Bounds, Context, Field, FieldValues, Quantity, Rendering, Samples, Trace
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model, build_plan
from invgraphics.recipes.recipe import Method, load_method, resolve
from invgraphics.runs import checkpoint
from invgraphics.testing import toy_scene
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit
from invgraphics.training.losses import BackgroundEntropyLoss, PointColourLoss
from invgraphics.training.tight_box import TightBoxConfig, enlarged, occupied_box
from invgraphics.training.view_rates import ViewRatesConfig, view_counts

SMALL = ["batches.rays=64", "batches.samples=2048", "field.colour_width=16", "renderer.sampler.resolution=16"]
GRIDS = ["field.encoding.resolution=12", "field.appearance.resolution=12", "field.appearance.features=3"]


class Blob(Field):
    """Density 5 in a box of its own, whose edge is 0.01 elsewhere."""

    provides = Quantity.DENSITY

    def __init__(self, lo, hi) -> None:
        super().__init__()
        self.lo, self.hi = lo, hi

    def query(self, samples, want):
        inside = ((samples.position >= self.lo) & (samples.position <= self.hi)).all(dim=1)
        return FieldValues(density=torch.where(inside, 5.0, 0.01))


BOUNDS = Bounds(torch.tensor([-1.0, -2.0, 0.0]), torch.tensor([1.0, 2.0, 1.0]))


class Distance(Blob):
    """A field of a signed distance on a lattice."""

    provides = Quantity.SDF | Quantity.GRADIENT

    def lattice_encodings(self):
        return {"geometry": None}


def test_a_tight_box_of_what_has_no_grid_or_no_density_is_refused_before_the_first_step(scene):
    table = load_method("volumetric/hash").table | {"hooks": [{"type": "tight_box", "at": 0.5}]}
    plan = build_plan(resolve("mine", "", table), scene, Budget(steps=9), 0, torch.device("cpu"))
    with pytest.raises(InputError, match="needs a geometry made of lattices"):
        Fit(plan)
    with pytest.raises(InputError, match="needs a density, which Distance does not have"):
        TightBoxConfig(at=0.5).build().check_fit(Distance(0, 1), plan.model.renderer)


def test_a_tight_box_with_colour_of_a_hash_grid_is_refused_in_a_box_before_the_first_step(scene):
    dvgo = load_method("volumetric/dvgo").table
    field = dvgo["field"] | {"encoding": {"type": "voxels", "resolution": 9}, "appearance": {"type": "hash"}}
    plan = build_plan(resolve("mine", "", dvgo | {"field": field}), scene, Budget(steps=9), 0, torch.device("cpu"))
    with pytest.raises(InputError, match="which the appearance's is not"):
        Fit(plan)


def test_vertices_of_a_grid_lie_in_the_order_of_memory():
    found = BOUNDS.vertices((3, 2, 5)).reshape(3, 2, 5, 3)
    torch.testing.assert_close(found[1, 0, 3], torch.tensor([0.0, -2.0, 0.75]))
    torch.testing.assert_close(found[2, 1, 4], BOUNDS.hi)


def test_occupied_box_holds_the_voxels_around_what_is_dense():
    lo, hi = torch.tensor([-0.33, -1.03, 0.41]), torch.tensor([0.25, 1.93, 1.0])
    found = occupied_box(Blob(lo, hi), BOUNDS, (21, 41, 11), 0.05, 1000)
    assert found is not None
    # Vertices at multiples of 0.1: the outermost inside, then one voxel more, but not beyond the bounds.
    torch.testing.assert_close(found[0], torch.tensor([-0.4, -1.1, 0.4]), atol=1e-5, rtol=0)
    torch.testing.assert_close(found[1], torch.tensor([0.3, 2.0, 1.0]), atol=1e-5, rtol=0)
    # Opacity along an edge of 0.1 is 1 - exp(-0.5) = 0.39 inside, 0.001 outside.
    whole = occupied_box(Blob(lo, hi), BOUNDS, (21, 41, 11), 9e-4, 1000)
    assert whole is not None
    assert torch.equal(whole[0], BOUNDS.lo)
    assert occupied_box(Blob(lo, hi), BOUNDS, (21, 41, 11), 0.4, 1000) is None


def test_a_box_grows_about_its_middle_up_to_the_bounds():
    box = torch.tensor([0.0, -2.0, 0.4]), torch.tensor([0.4, 0.0, 0.6])
    lo, hi = enlarged(box, 1.5, BOUNDS)
    torch.testing.assert_close(lo, torch.tensor([-0.1, -2.0, 0.35]))
    torch.testing.assert_close(hi, torch.tensor([0.5, 0.5, 0.65]))


def test_view_counts_are_those_of_single_projections(scene):
    cameras = [replace(view.camera, focal=2.5 * view.camera.focal) for view in scene.train]
    points = 1.5 * torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
    expected = []
    for point in points:
        count = 0
        for camera in cameras:
            x, y, z, _ = (camera.world_to_cam @ torch.cat([point, torch.ones(1)])).tolist()
            u = float(camera.focal[0]) * x / z + float(camera.principal_point[0])
            v = float(camera.focal[1]) * y / z + float(camera.principal_point[1])
            count += z > 0 and 0 <= u <= camera.width and 0 <= v <= camera.height
        expected.append(count)
    assert view_counts(points, cameras).tolist() == expected
    assert len(set(expected)) > 3


def method_with(*hooks, change=()) -> Method:
    table = load_method("volumetric/dvgo", None, [*SMALL, *GRIDS, *change]).table
    return resolve("volumetric/dvgo", "", table | {"hooks": list(hooks)})


def fit_of(scene, steps, *hooks, change=()) -> Fit:
    return Fit(build_plan(method_with(*hooks, change=change), scene, Budget(steps=steps), 0, torch.device("cpu")))


def advance(fit, step):
    fit.run(lambda loss: fit.steps == step)


def test_rates_follow_the_views_and_end(scene):
    zoomed = scene.with_views(
        train=tuple(replace(view, camera=replace(view.camera, focal=4 * view.camera.focal)) for view in scene.train)
    )
    fit = fit_of(zoomed, 8, {"type": "view_rates", "until": 0.5}, {"type": "upsample", "at": [0.25], "resolution": 15})
    for expected in (12, 12, 12, 15):  # the hook before the up-sampling sees its result one step later
        fit.step()
        rates = fit._optimiser.row_rates("field.encoding.levels.0")
        if fit.steps in (1, 2, 4):
            assert rates is not None
            assert rates.shape == (expected,) * 3
    points = fit.model.field.bounds.vertices((15, 15, 15))
    counts = view_counts(points, [view.camera for view in zoomed.train]).reshape(15, 15, 15)
    torch.testing.assert_close(fit._optimiser.row_rates("field.appearance.levels.0"), counts / counts.max())
    assert 0 < float(counts.min() / counts.max()) < 1 or float(counts.min()) == 0
    fit.step()
    assert fit._optimiser.row_rates("field.encoding.levels.0") is None


def values_at(field, points):
    direction = torch.nn.functional.normalize(points, dim=1)
    found = field.query_no_grad(Samples.at(points, direction), Quantity.DENSITY | Quantity.RADIANCE)
    return torch.cat([found.density[:, None], found.radiance], dim=1)


def test_cropping_to_vertices_leaves_the_function_inside_unchanged(scene):
    """The new box's vertices are old ones and their middles; densities are per local unit, whatever the box."""
    field = build_model(method_with(change=["field.encoding.spread=3.0", "field.appearance.spread=1.0"]), scene, 0, CPU).field
    resolution = field.encoding.resolution[0]
    lo = field.lo + 2 / (resolution - 1) * (field.hi - field.lo)
    hi = lo + 6 / (resolution - 1) * (field.hi - field.lo)
    points = lo + (hi - lo) * torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    before = values_at(field, points)
    field.crop(lo, hi, 13)
    assert field.encoding.resolution == (13, 13, 13)
    torch.testing.assert_close(values_at(field, points), before, atol=1e-4, rtol=1e-4)
    assert (values_at(field, lo - 0.1 * torch.rand(50, 3))[:, 0] == 0).all()


CPU = torch.device("cpu")


def test_the_tight_box_resumes_to_the_bit_and_restarts(scene, tmp_path):
    hooks = (
        {"type": "tight_box", "at": 0.5, "threshold": 0.5, "resolution": 14, "scale": 1.1},
        {"type": "upsample", "at": [0.7], "resolution": 18, "moments": "drop_all", "restart_rates": True},
    )

    def make():
        fit = fit_of(scene, 20, *hooks)
        with torch.no_grad():
            fit.model.field.encoding.lattices()[0].features[4:8, 3:9, 5:8] = 8.0
        return fit

    whole = make()
    whole.run(lambda loss: False)
    resumed = make()
    for stop in (6, 12, 20):
        advance(resumed, stop)
        checkpoint.save(tmp_path / f"{stop}", resumed.state())
        resumed = make()
        resumed.load(checkpoint.load(tmp_path / f"{stop}"), seconds=1.0)
    a, b = whole.state(), resumed.state()
    assert all(torch.equal(a[part][name], b[part][name]) for part in a for name in a[part])
    field = whole.model.field
    assert not torch.equal(field.lo, scene.bounds.lo) or not torch.equal(field.hi, scene.bounds.hi)
    assert (field.lo >= scene.bounds.lo).all()
    assert (field.hi <= scene.bounds.hi).all()
    sizes = torch.tensor(field.encoding.resolution)
    assert float(sizes.prod()) ** (1 / 3) == pytest.approx(18, rel=0.05)
    voxels = (field.hi - field.lo) / sizes
    assert float(voxels.max() / voxels.min()) < 1.15


def test_contracted_space_is_not_cropped_but_refined():
    scene = toy_scene(views=3, size=12, space="contracted")
    fit = fit_of(scene, 8, {"type": "tight_box", "at": 0.5, "threshold": 0.5, "resolution": 15})
    with torch.no_grad():
        fit.model.field.encoding.lattices()[0].features[4:8, 3:9, 5:8] = 8.0
    rates = []
    fit.run(lambda loss: bool(rates.append(fit._optimiser.rates()["density"])))
    field = fit.model.field
    assert torch.equal(field.lo, scene.bounds.lo) and torch.equal(field.hi, scene.bounds.hi)
    assert [encoding.resolution for encoding in field.lattice_encodings().values()] == [(15, 15, 15)] * 2
    assert rates[3] < rates[0] and max(rates[4:]) > rates[3]  # restarted


def test_bad_settings_and_fields_are_refused(scene):
    for settings, words in (
        ({"at": 0.0}, "'at' and 'threshold' lie between 0 and 1"),
        ({"at": 0.5, "threshold": 0.0}, "'at' and 'threshold' lie between 0 and 1"),
        ({"at": 0.5, "scale": 0.9}, "'scale' is at least 1"),
        ({"at": 0.5, "moments": "keep"}, "cannot be kept"),
    ):
        with pytest.raises(ValueError, match=words):
            TightBoxConfig(**settings)
    vm = ["field.encoding.type=vm", "field.encoding.resolution=8"]
    with pytest.raises(InputError, match="needs dense voxel grids"):
        fit_of(scene, 2, {"type": "view_rates"}, change=vm).step()
    with pytest.raises(InputError, match="skip_zero"):
        fit_of(scene, 2, {"type": "view_rates"}, change=["optimiser.groups.density.skip_zero=false"]).step()
    with pytest.raises(InputError, match="can be cropped"):
        build_model(load_method("volumetric/hash"), scene, 0, CPU).field.crop(scene.bounds.lo, scene.bounds.hi, 8)
    assert ViewRatesConfig().until == 1.0


def test_losses_by_hand():
    """Two rays; the second's light is undecided."""
    ray = torch.tensor([0, 0, 1])
    zero = torch.zeros(3)
    samples = Samples(ray, zero, zero, torch.zeros(3, 3), torch.zeros(3, 3), zero, ray)
    radiance = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.2, 0.2, 0.2]], requires_grad=True)
    weights = torch.tensor([0.75, 0.25, 0.5], requires_grad=True)
    trace = Trace(samples, FieldValues(radiance=radiance), weights, rays=2)
    target = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    alpha = torch.tensor([1.0, 0.25])
    rendering = Rendering(torch.zeros(2, 3), alpha, torch.zeros(2))
    batch = Batch(target, torch.ones(2), torch.ones(3))
    ctx = Context(BOUNDS)
    loss = PointColourLoss(weight=2.0)(rendering, trace, batch, ctx)
    assert loss.item() == pytest.approx(2 * (0.25 * (1 + 0.25) + 0.5 * (0.04 + 0.04 + 0.64)) / 2)
    loss.backward()
    assert weights.grad is None
    entropy = BackgroundEntropyLoss(weight=2.0)(rendering, trace, batch, ctx)
    assert float(entropy) == pytest.approx(-2 * (0.25 * math.log(0.25) + 0.75 * math.log(0.75)) / 2, abs=1e-4)
    assert float(PointColourLoss()(rendering, Trace(), batch, ctx)) == 0
