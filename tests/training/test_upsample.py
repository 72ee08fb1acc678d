"""Up-sampling: the function stays, the optimiser follows as the recipe says, and a fit resumes across it to the bit."""

from functools import partial

import pytest
import torch
from torch.nn.functional import interpolate

from invgraphics.core import Quantity, Samples
from invgraphics.core.camera import pixel_limit
from invgraphics.core.lattice import resampled, vertices_along
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model, build_plan
from invgraphics.recipes.recipe import load_method, resolve
from invgraphics.runs import checkpoint
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit
from invgraphics.training.hooks import FitState
from invgraphics.training.optimiser import GroupConfig, Optimiser, OptimiserConfig
from invgraphics.training.optimisers.muon import MOMENTUM, MOMENTUM_DECAY
from invgraphics.training.upsample import Upsample, UpsampleConfig

ENCODINGS = {
    "voxels": {"type": "voxels", "resolution": 7, "features": 4, "spread": 0.5},
    "levels": {"type": "voxels", "resolution": 9, "coarsest": 5, "levels": 2, "features": 2, "spread": 0.5},
    "vm": {"type": "vm", "resolution": 7, "components": 2},
    "cp": {"type": "cp", "resolution": 7, "components": 4},
    "triplane": {"type": "triplane", "resolution": 7, "features": 4},
}


def method_with(encoding, **hook):
    """The hash recipe over another encoding, with small everything, masked Adam on the grid and a hook."""
    small = ["batches.rays=64", "batches.samples=2048", "field.width=16", "field.colour_width=16"]
    table = load_method("volumetric/hash", None, [*small, "renderer.sampler.resolution=16"]).table
    groups = table["optimiser"]["groups"] | {"table": {"match": "field.encoding", "lr": 0.05, "final": 0.01, "skip_zero": True}}
    hooks = [{"type": "upsample", **hook}] if hook else []
    table = table | {"field": table["field"] | {"encoding": ENCODINGS[encoding]}, "hooks": hooks}
    return resolve("volumetric/hash", "", table | {"optimiser": table["optimiser"] | {"groups": groups}})


def fit_of(scene, encoding, steps, **hook):
    return Fit(build_plan(method_with(encoding, **hook), scene, Budget(steps=steps), 0, torch.device("cpu")))


def advance(fit, step):
    fit.run(lambda loss: fit.steps == step)


def density(field, scene):
    points = scene.bounds.from_unit(torch.rand(500, 3, generator=torch.Generator().manual_seed(0)))
    direction = torch.nn.functional.normalize(points, dim=1)
    values = field.query_no_grad(Samples.at(points, direction), Quantity.DENSITY | Quantity.RADIANCE)
    return torch.cat([values.density[:, None], values.radiance], dim=1)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_nested_vertices_leave_the_function_unchanged(encoding, scene):
    field = build_model(method_with(encoding), scene, 0, torch.device("cpu")).field
    before = density(field, scene)
    grid = field.lattice_encodings()["geometry"]
    grid.resize(tuple(2 * size - 1 for size in grid.resolution))
    assert grid.resolution[0] > 10
    torch.testing.assert_close(density(field, scene), before, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("size", [(5, 9, 3), (4, 1, 11), (7, 7, 7)])
def test_interpolation_is_torchs_with_aligned_corners(size):
    features = torch.rand(4, 6, 5, 3, generator=torch.Generator().manual_seed(0))
    expected = interpolate(features.movedim(-1, 0)[None], size=size, mode="trilinear", align_corners=True)[0].movedim(0, -1)
    torch.testing.assert_close(resampled(features, size), expected)


def test_a_part_of_a_lattice_is_looked_up_where_it_is():
    """A trilinear function, of which every box of vertices holds the exact values; beyond the border it continues level."""

    def ramp(x, y, z):
        return torch.stack([1 + 2 * x - y, x * y * z], dim=-1)

    grid = torch.meshgrid(*(torch.linspace(0, 1, n) for n in (3, 4, 2)), indexing="ij")
    lo, hi = (0.25, -0.5, 0.1), (0.5, 1.0, 0.9)
    found = resampled(ramp(*grid), (4, 7, 3), lo, hi)
    axes = (torch.linspace(a, b, n).clamp(0, 1) for a, b, n in zip(lo, hi, (4, 7, 3), strict=True))
    torch.testing.assert_close(found, ramp(*torch.meshgrid(*axes, indexing="ij")))


def test_vertices_follow_the_boxs_edges():
    assert vertices_along(40, (1.0, 1.0, 1.0)) == (40, 40, 40)
    x, y, z = vertices_along(40, (4.0, 2.0, 1.0))
    assert (x, y, z) == (80, 40, 20)


def sizes(fit, steps):
    """Resolution at every step."""
    found = []
    for _ in range(steps):
        fit.step()
        found.append(fit.model.field.encoding.resolution[0])
    return found


def test_counts_grow_log_linearly_or_as_listed(scene):
    grown = sizes(fit_of(scene, "voxels", 10, at=[0.2, 0.4, 0.6], resolution=56), 10)
    assert grown == [7, 7, 14, 14, 28, 28, 56, 56, 56, 56]
    listed = sizes(fit_of(scene, "voxels", 5, at=[0.2, 0.6], resolutions=[9, 8]), 5)
    assert listed == [7, 9, 9, 8, 8]


def test_growth_ends_at_the_pixels(scene):
    finest = pixel_limit(scene.bounds, [view.camera for view in scene.train])
    schedule = {"at": [0.2, 0.6], "resolution": 500}
    whole, half = (sizes(fit_of(scene, "voxels", 5, **schedule, min_spacing=pixels), 5) for pixels in (1.0, 2.0))
    assert whole[0] == half[0] == 7
    assert (whole[-1], half[-1]) == (pytest.approx(finest, abs=1), pytest.approx(finest / 2, abs=1))
    assert sizes(fit_of(scene, "voxels", 5, **schedule, min_spacing=10.0), 5) == [7] * 5  # never coarser


def test_several_that_are_due_at_once_are_one(scene):
    field = build_model(method_with("voxels"), scene, 0, torch.device("cpu")).field
    parameters = {f"field.{name}": parameter for name, parameter in field.named_parameters()}
    optimiser = Optimiser(OptimiserConfig({"all": GroupConfig("field", 0.1)}), parameters, 1.0)
    hook = Upsample(UpsampleConfig(at=(0.1, 0.2, 0.3), resolution=56))
    fit = fit_of(scene, "voxels", 10)
    state = FitState(field, fit.model.renderer, optimiser, scene, fit.context())
    for progress, expected in ((0.05, 7), (0.25, 28), (0.26, 28), (0.9, 56)):
        object.__setattr__(state.ctx, "progress", progress)
        hook.before_step(state)
        assert field.encoding.resolution == (expected,) * 3


GRID = OptimiserConfig(
    {"grid": GroupConfig("field.grid", 0.1, final=0.001, skip_zero=True), "net": GroupConfig("field.net", 0.1, final=0.001)}
)


def followed(moments):
    """An optimiser after one step, whose grid (4, 3, 2) was then replaced by one of (7, 5, 2)."""
    grid, net = torch.nn.Parameter(torch.ones(4, 3, 2)), torch.nn.Parameter(torch.ones(5))
    optimiser = Optimiser(GRID, {"field.grid": grid, "field.net": net}, 1.0)
    optimiser.set_row_rates("field.grid", torch.full((4, 3), 0.5))
    grid.grad, net.grad = torch.rand(4, 3, 2, generator=torch.Generator().manual_seed(0)), torch.ones(5)
    optimiser.step()
    before = optimiser.state()
    bigger = torch.nn.Parameter(torch.zeros(7, 5, 2))
    optimiser.replace("field.grid", bigger, partial(resampled, size=(7, 5)) if moments == "keep" else None)
    return optimiser, bigger, before


def test_kept_moments_are_interpolated():
    optimiser, bigger, before = followed("keep")
    after = optimiser.state()
    for name in ("exp_avg", "exp_avg_sq"):
        old, new = before[f"field.grid/{name}"], after[f"field.grid/{name}"]
        torch.testing.assert_close(new[::2, ::2], old)
        torch.testing.assert_close(new[1::2, ::2], (old[:-1] + old[1:]) / 2)
    assert int(after["field.grid/step"]) == 1
    assert optimiser.row_rates("field.grid") is None
    bigger.grad = torch.ones_like(bigger)
    optimiser.step()
    assert (bigger != 0).all()


def test_dropped_moments_are_those_of_the_grid_or_of_all():
    optimiser, bigger, _ = followed("drop")
    assert {path.partition("/")[0] for path in optimiser.state()} == {"field.net"}
    optimiser.drop_moments()
    assert not optimiser.state()
    bigger.grad = torch.ones_like(bigger)
    optimiser.step()
    # Adam's first step is the rate, whatever the gradient.
    torch.testing.assert_close(bigger.detach(), torch.full_like(bigger, -0.1))


def test_rates_restart_and_take_the_rest_of_the_fit():
    optimiser, _, _ = followed("drop")
    optimiser.set_progress(0.5)
    assert optimiser.rate_of("field.net") == pytest.approx(0.01)
    optimiser.restart(0.5)
    assert optimiser.rate_of("field.net") == pytest.approx(0.1)
    for progress, rate in ((0.75, 0.01), (1.0, 0.001)):
        optimiser.set_progress(progress)
        assert optimiser.rate_of("field.net") == pytest.approx(rate)
    again, _, _ = followed("drop")
    again.load(optimiser.state())
    again.set_progress(0.75)
    assert again.rate_of("field.grid") == pytest.approx(0.01)


def test_a_hook_restarts_rates_and_drops_all_moments(scene):
    for moments, left in (("keep", True), ("drop_all", False)):
        fit = fit_of(scene, "voxels", 4, at=[0.5], resolution=9, moments=moments, restart_rates=True)
        advance(fit, 2)
        before = int(fit.state()["optimiser"]["field.colour_net.output.weight/step"])  # Adam's
        fit.step()
        after = fit.state()["optimiser"]
        assert int(after["field.colour_net.output.weight/step"]) - before == (1 if left else -1)
        gradient = fit.model.field.geometry_net.output.weight.grad
        anew = torch.allclose(after[f"field.geometry_net.output.weight/{MOMENTUM}"], (1 - MOMENTUM_DECAY) * gradient)
        assert anew != left
        assert float(after["restarted"]) == 0.5
        assert fit._optimiser.rate_of("field.encoding.levels.0") == pytest.approx(0.05)


def test_a_larger_budget_stretches_the_restarted_rates(scene):
    """At 8 of 40 steps, restarted at 4 (progress 0.1): a ninth of the rest is over, and no rate is above its start."""
    fit = fit_of(scene, "voxels", 8, at=[0.5], resolution=9, moments="drop", restart_rates=True)
    fit.run(lambda loss: False)
    fit.set_budget(Budget(steps=40))
    fit.step()
    config = method_with("voxels").recipe.optimiser.groups
    for key, rate in fit._optimiser.rates().items():
        assert rate == pytest.approx(config[key].rate(1 / 9)), key


def equal(a, b):
    return a.keys() == b.keys() and all(
        a[part].keys() == b[part].keys() and all(torch.equal(a[part][name], b[part][name]) for name in a[part]) for part in a
    )


@pytest.mark.parametrize("moments", ["keep", "drop_all"])
@pytest.mark.parametrize("encoding", ["voxels", "vm"])
def test_resumes_to_the_bit_before_and_after(encoding, moments, scene, tmp_path):
    """Through the checkpoint file, interrupted twice: between two up-samplings, and before the first."""
    make = partial(fit_of, scene, encoding, 16, at=[0.25, 0.625], resolution=13, moments=moments, restart_rates=True)
    whole = make()
    whole.run(lambda loss: False)
    resumed, states = make(), []
    for stop in (3, 7, 12, 16):
        advance(resumed, stop)
        checkpoint.save(tmp_path / f"{stop}", resumed.state())
        states.append(resumed.model.field.encoding.resolution)
        torch.manual_seed(99)
        resumed = make()
        resumed.load(checkpoint.load(tmp_path / f"{stop}"), seconds=1.0)
    assert len(set(states)) == 3
    assert equal(whole.state(), resumed.state())
    model = build_model(method_with(encoding), scene, 5, torch.device("cpu"))
    model.load_state_dict(checkpoint.load(tmp_path / "16"))
    assert torch.equal(density(model.field, scene), density(whole.model.field, scene))


def test_warming_up_leaves_the_fit_as_it_was(scene):
    """One step is taken and taken back before the clock starts: also where that step is the one that resizes."""
    make = partial(fit_of, scene, "voxels", 8, at=[0.5], resolution=13, moments="keep")
    plain, warmed = make(), make()
    for fit in (plain, warmed):
        advance(fit, 4)
    warmed.warmup_step()
    assert warmed.model.field.encoding.resolution == (7, 7, 7)
    for fit in (plain, warmed):
        fit.run(lambda loss: False)
    assert equal(plain.state(), warmed.state())


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"at": ()}, "'at' needs"),
        ({"at": (0.5, 0.2), "resolution": 9}, "'at' needs"),
        ({"at": (0.0,), "resolution": 9}, "'at' needs"),
        ({"at": (1.0,), "resolution": 9}, "'at' needs"),
        ({"at": (0.5,)}, "either 'resolution' or 'resolutions' must be given"),
        ({"at": (0.5,), "resolution": 9, "resolutions": (9,)}, "either 'resolution' or 'resolutions' must be given"),
        ({"at": (0.2, 0.5), "resolutions": (9,)}, "one entry for each of the 2 in 'at'"),
        ({"at": (0.2,), "resolution": 1}, "at least 2 vertices"),
        ({"at": (0.2,), "resolution": 9, "min_spacing": -1.0}, "'min_spacing' is a number of pixels"),
    ],
)
def test_bad_schedules_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        UpsampleConfig(**settings)


def test_fields_without_lattices_are_refused(scene):
    table = load_method("splatting/gaussians").table | {"hooks": [{"type": "upsample", "at": [0.5], "resolution": 9}]}
    with pytest.raises(InputError, match="The hook 'upsample' needs encodings made of lattices, which GaussianField"):
        resolve("splatting/gaussians", "", table)
    hash_table = load_method("volumetric/hash", None, ["batches.rays=32"]).table
    method = resolve("volumetric/hash", "", hash_table | {"hooks": table["hooks"]})
    plan = build_plan(method, scene, Budget(steps=2), 0, torch.device("cpu"))
    with pytest.raises(InputError, match="The hook 'upsample' needs encodings made of lattices, which this field"):
        Fit(plan)  # not at the milestone, half a fit later
