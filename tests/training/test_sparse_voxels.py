"""Sparse voxels: the function of a dense grid with zeros; pruning by weights that loops find; fits that learn and resume."""

import itertools

import pytest
import torch

from invgraphics.core.lattice import Lattice, LatticeEncoding
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_plan
from invgraphics.fields.encodings.sparse import SparseVoxels, SparseVoxelsConfig
from invgraphics.kernels.numba.lattice import encode
from invgraphics.kernels.reference.lattice import lattice_encode
from invgraphics.recipes.recipe import load_method
from invgraphics.runs import checkpoint
from invgraphics.training import prune
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit
from invgraphics.training.prune import PruneConfig, dilated, heaviest

SMALL = [
    "batches.rays=128",
    "batches.samples=4096",
    "field.encoding.resolution=16",
    "field.appearance.resolution=16",
    "renderer.sampler.resolution=16",
    "renderer.sampler.steps_per_diagonal=64",
    "renderer.sampler.evaluation_steps=64",
    "hooks.0.rays=2048",
    "hooks.0.at=[0.3, 0.6]",
    "hooks.1.at=[0.3, 0.6]",
    "hooks.1.resolution=24",
]


def filled(resolution=(4, 3, 5), features=2, share=0.6) -> SparseVoxels:
    """Random rows, of which ``share`` are kept."""
    encoding = SparseVoxels(resolution, features, 0.0)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        encoding.rows.copy_(torch.randn(encoding.rows.shape, generator=generator))
    encoding.keep(torch.rand(resolution, generator=generator) < share)
    return encoding


def dense(encoding: SparseVoxels) -> torch.Tensor:
    """The grid with zeros where there is no vertex."""
    values = torch.zeros(*encoding.resolution, encoding.width)
    for place in itertools.product(*map(range, encoding.resolution)):
        link = int(encoding.links[place])
        if link >= 0:
            values[place] = encoding.rows[link].detach()
    return values


def test_is_a_dense_grid_with_zeros():
    encoding = filled()
    assert isinstance(encoding, LatticeEncoding)
    assert 10 < len(encoding.rows) < 60
    unit = torch.rand(200, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(encoding(unit), lattice_encode(unit, [Lattice(dense(encoding))], "concat"))


def test_keeping_some_vertices_empties_the_others():
    encoding = filled()
    before, kept = dense(encoding), torch.rand(4, 3, 5, generator=torch.Generator().manual_seed(2)) < 0.5
    old = encoding.rows.detach().clone()
    rows = encoding.keep(kept)
    torch.testing.assert_close(dense(encoding), before * kept[..., None])
    torch.testing.assert_close(encoding.rows.detach(), old[rows])
    with pytest.raises(InputError, match="no voxel"):
        encoding.keep(torch.zeros(4, 3, 5, dtype=torch.bool))


def test_nested_vertices_leave_the_function_unchanged_and_stay_sparse():
    encoding = filled((7, 6, 8), share=0.1)
    unit = torch.rand(500, 3, generator=torch.Generator().manual_seed(1))
    before = encoding(unit).detach()
    encoding.resize((13, 11, 15))
    torch.testing.assert_close(encoding(unit).detach(), before, atol=1e-5, rtol=1e-5)
    assert encoding.resolution == (13, 11, 15)
    assert len(encoding.rows) < 13 * 11 * 15 / 2
    encoding.resize((5, 5, 5), (0.25, 0.0, 0.5), (0.75, 0.5, 1.0))
    inside = 0.5 * torch.cartesian_prod(*[torch.linspace(0, 1, 5)] * 3) + torch.tensor([0.25, 0.0, 0.5])
    expected = lattice_encode(inside, [Lattice(dense(filled((7, 6, 8), share=0.1)))], "concat")
    torch.testing.assert_close(dense(encoding).reshape(-1, 2), expected, atol=1e-5, rtol=1e-5)


def test_the_heaviest_sample_around_a_vertex_is_that_of_a_loop():
    generator = torch.Generator().manual_seed(3)
    unit, weights = 1.2 * torch.rand(60, 3, generator=generator) - 0.1, torch.rand(60, generator=generator)
    size = (4, 3, 6)
    expected = torch.zeros(size)
    for point, weight in zip(unit.tolist(), weights.tolist(), strict=True):
        if not all(0 <= x <= 1 for x in point):
            continue
        for place in itertools.product(*map(range, size)):
            if all(abs(x * (n - 1) - k) < 1 for x, n, k in zip(point, size, place, strict=True)):
                expected[place] = max(float(expected[place]), weight)
    torch.testing.assert_close(heaviest(unit, weights, size), expected)


def test_dilation_reaches_along_all_axes():
    mask = torch.zeros(7, 7, 7, dtype=torch.bool)
    mask[3, 3, 0] = True
    found = dilated(mask, 2)
    expected = torch.zeros_like(mask)
    expected[1:6, 1:6, 0:3] = True
    assert torch.equal(found, expected)
    assert torch.equal(dilated(mask, 0), mask)


def fit_of(scene, steps, *changes) -> Fit:
    method = load_method("volumetric/plenoxels", None, [*SMALL, *changes])
    return Fit(build_plan(method, scene, Budget(steps=steps), 0, torch.device("cpu")))


def advance(fit, step):
    fit.run(lambda loss: fit.steps == step)


def test_pruning_keeps_the_moments_of_the_rows_that_stay(scene):
    fit = fit_of(scene, 10, "hooks.1.at=[0.9]")
    advance(fit, 3)
    encoding, before = fit.model.field.encoding, fit.state()["optimiser"]["field.encoding.rows/exp_avg_sq"].clone()
    links, count = encoding.links.clone(), len(encoding.rows)
    hook = fit.plan.hooks[0]
    moments = []
    original = fit._optimiser.step
    fit._optimiser.step = lambda: (moments.append(fit._optimiser.state()["field.encoding.rows/exp_avg_sq"].clone()), original())
    advance(fit, 4)
    assert len(encoding.rows) < count
    assert len(fit.model.field.appearance.rows) == len(encoding.rows)
    kept = encoding.links >= 0
    torch.testing.assert_close(moments[0], before[links[kept].long()])
    assert int(hook.state_dict()["done"]) == 1


def test_rays_that_are_traced_a_few_at_a_time_prune_the_same_vertices(scene, monkeypatch):
    kept = []
    for rays in (7, 10**6):
        monkeypatch.setattr(prune, "RAYS_AT_ONCE", rays)
        fit = fit_of(scene, 10, "hooks.1.at=[0.9]")
        full = len(fit.model.field.encoding.rows)
        advance(fit, 4)
        kept.append(fit.model.field.encoding.links >= 0)
        assert 0 < int(kept[-1].sum()) < full
    assert torch.equal(*kept)


def test_resumes_to_the_bit_across_pruning_and_up_sampling(scene, tmp_path):
    whole = fit_of(scene, 20)
    whole.run(lambda loss: False)
    resumed, rows = fit_of(scene, 20), []
    for stop in (4, 9, 15, 20):
        advance(resumed, stop)
        checkpoint.save(tmp_path / f"{stop}", resumed.state())
        rows.append(tuple(resumed.model.field.encoding.rows.shape))
        resumed = fit_of(scene, 20)
        resumed.load(checkpoint.load(tmp_path / f"{stop}"), seconds=1.0)
    assert len(set(rows)) >= 3
    a, b = whole.state(), resumed.state()
    assert all(torch.equal(a[part][name], b[part][name]) for part in a for name in a[part])


def psnr(fit) -> float:
    scene, errors = fit.plan.scene, []
    for view in scene.test:
        picture = fit.model.render(view.camera, normals=False)
        errors.append((picture.over(scene.background).clamp(0, 1) - view.over(scene.background)).square().mean())
    return -10 * float(torch.stack(errors).mean().log10())


DVGO = ["field.encoding.resolution=16", "field.appearance.resolution=16", "hooks.0.resolution=16", "hooks.1.resolution=24"]


SKIPPING = [("volumetric/plenoxels", SMALL), ("volumetric/dvgo", [*SMALL[:2], *SMALL[4:7], *DVGO, "field.colour_width=16"])]
"""Methods whose optimiser skips entries without gradient."""


@pytest.mark.parametrize(("name", "settings"), SKIPPING)
def test_sparse_gradients_change_no_fit(name, settings, scene, monkeypatch):
    """Through pruning and up-sampling; on grids of this size gradients are dense unless the limit is lowered."""
    found = []
    for large in (encode.LARGE, 1e-6):
        monkeypatch.setattr(encode, "LARGE", large)
        torch.manual_seed(0)
        fit = Fit(build_plan(load_method(name, None, settings), scene, Budget(steps=12), 0, torch.device("cpu")))
        kinds = set()

        def note(loss, fit=fit, kinds=kinds):
            kinds.update(x.grad.is_sparse for x in fit.model.field.parameters() if x.grad is not None and x.numel() > 4000)

        fit.run(note)
        assert (True in kinds) == (large < 1)  # beside dense ones, of Plenoxels' total variation
        found.append({key: value.detach().clone() for key, value in fit.model.field.named_parameters()})
    for key, value in found[0].items():
        torch.testing.assert_close(found[1][key], value, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(("name", "settings"), SKIPPING)
def test_methods_learn_the_toy_scene(name, settings, scene):
    method = load_method(name, None, settings)
    fit = Fit(build_plan(method, scene, Budget(steps=120), 0, torch.device("cpu")))
    before = psnr(fit)
    fit.run(lambda loss: False)
    assert psnr(fit) > max(before + 6, 19)


def test_bad_settings_are_refused(scene):
    for settings, words in (
        ({"at": ()}, "'at' needs"),
        ({"at": (0.5, 0.2)}, "'at' needs"),
        ({"at": (0.5,), "weight": -1.0}, "'weight' and 'dilation' must not be negative"),
        ({"at": (0.5,), "rays": 0}, "'rays' must be at least 1"),
    ):
        with pytest.raises(ValueError, match=words):
            PruneConfig(**settings)
    with pytest.raises(ValueError, match="resolution"):
        SparseVoxelsConfig(resolution=1)
    with pytest.raises(InputError, match="Moments of sparse lattices"):
        fit_of(scene, 2, "hooks.1.at=[0.5]", "hooks.0.at=[0.9]", "hooks.1.moments=keep")
    dense_colour = load_method(
        "volumetric/plenoxels",
        None,
        [
            *SMALL,
            "field.encoding.type=voxels",
            "field.encoding.features=1",
            "field.encoding.resolution=16",
            "field.appearance.type=voxels",
            "field.appearance.features=27",
            "field.appearance.resolution=16",
        ],
    )
    plan = build_plan(dense_colour, scene, Budget(steps=3), 0, torch.device("cpu"))
    with pytest.raises(InputError, match="needs sparse voxel grids"):
        Fit(plan)
