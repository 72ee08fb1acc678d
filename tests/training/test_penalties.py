"""Penalties against loops over vertices and closed forms; their place in recipes and in the loss."""

import itertools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from invgraphics.core import Bounds, Context, Field, FieldValues, Quantity
from invgraphics.core.lattice import Lattice
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_plan
from invgraphics.recipes.recipe import load_method, resolve
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit
from invgraphics.training.penalties import (
    L1Penalty,
    SparsityPenalty,
    TotalVariationPenalty,
    total_variation,
)

NO_RENDERER: Any = None
EDGES = torch.tensor([1.0, 2.0, 0.5])
BOX = Bounds(-torch.ones(3), torch.tensor([1.0, 3.0, 0.0]))  # edges 2, 4, 1: mean 2


class Grids(Field):
    """A field of given lattices and of constant density."""

    provides = Quantity.DENSITY
    croppable = False

    def __init__(self, density=0.0, **lattices) -> None:
        super().__init__()
        self.bounds, self._lattices, self._density = BOX, lattices, density

    def lattice_encodings(self):
        return dict.fromkeys(self._lattices, self)

    def lattices(self):
        return self._lattices["geometry"]

    def crop(self, lo, hi, resolution):
        raise NotImplementedError

    def query(self, samples, want):
        return FieldValues(density=torch.full((len(samples),), self._density))


def context(progress=0.0, seed=0):
    return Context(BOX, training=True, progress=progress, generator=torch.Generator().manual_seed(seed))


def looped(values, edges, squared):
    """Equation 3 vertex by vertex."""
    shape, total = values.shape[:-1], 0.0
    for place in itertools.product(*map(range, shape)):
        for channel in range(values.shape[-1]):
            lengths = 0.0
            for axis, size in enumerate(shape):
                if place[axis] + 1 < size:
                    step = tuple(p + (a == axis) for a, p in enumerate(place))
                    slope = float(values[step][channel] - values[place][channel]) * (size - 1) / float(edges[axis]) / 256
                    lengths += slope**2
            total += lengths if squared else math.sqrt(lengths + 1e-9)
    return total / math.prod(shape)


@pytest.mark.parametrize("norm", ["isotropic", "squared"])
@pytest.mark.parametrize(("axes", "shape"), [("xyz", (3, 4, 5)), ("xz", (4, 3)), ("z", (6,)), ("zxy", (2, 1, 3))])
def test_total_variation_is_that_of_a_loop(axes, shape, norm):
    values = 100 * torch.rand(*shape, 2, generator=torch.Generator().manual_seed(0))
    edges = EDGES[["xyz".index(axis) for axis in axes]]
    found = total_variation(Lattice(values, axes), edges, torch.arange(math.prod(shape)), norm)
    assert float(found) == pytest.approx(looped(values, edges, norm == "squared"), rel=1e-5)


def test_slope_of_a_ramp_is_the_same_at_every_resolution_and_per_mean_edge():
    """f = 256 (unit coordinate along y): slope 1 per mean edge and cell of 1/256, over an edge of twice the mean."""
    for size in (9, 33):
        ramp = torch.linspace(0, 256, size)[None, :, None, None].expand(3, size, 4, 1)
        inner = torch.arange(3 * size * 4).reshape(3, size, 4)[:, :-1].flatten()
        found = total_variation(Lattice(ramp.contiguous()), EDGES, inner, "isotropic")
        assert float(found) == pytest.approx(1 / 2, rel=1e-4)


def test_gradient_is_that_of_finite_differences():
    values = torch.rand(3, 2, 4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).mul(300).requires_grad_()
    for norm in ("isotropic", "squared"):
        assert torch.autograd.gradcheck(
            lambda x, norm=norm: total_variation(Lattice(x), EDGES.double(), torch.tensor([0, 5, 7, 23, 2]), norm), values
        )


def test_links_give_what_the_dense_lattice_gives():
    links = torch.tensor([[[2, -1], [0, 3]], [[-1, 1], [9, 2]]], dtype=torch.int32)
    rows = torch.rand(4, 3, generator=torch.Generator().manual_seed(2)) * 100
    dense = torch.where(((links >= 0) & (links < 4))[..., None], rows[links.clamp(0, 3).long()], torch.zeros(3))
    every = torch.arange(8)
    linked = total_variation(Lattice(rows, links=links), EDGES, every, "isotropic")
    torch.testing.assert_close(linked, total_variation(Lattice(dense), EDGES, every, "isotropic"))


def test_a_fraction_is_contiguous_random_and_right_on_average():
    values = 100 * torch.rand(4, 5, 3, 2, generator=torch.Generator().manual_seed(3))
    field = Grids(geometry=(Lattice(values),))
    part = TotalVariationPenalty(weight=1.0, fraction=0.1)
    drawn = part._vertices(Lattice(values), context(seed=5))
    assert len(drawn) == 6
    assert ((drawn[1:] - drawn[:-1]) % 60 == 1).all()
    assert not torch.equal(drawn, part._vertices(Lattice(values), context(seed=6)))
    ctx = context()
    means = torch.stack([part(field, NO_RENDERER, ctx) for _ in range(3000)])
    whole = TotalVariationPenalty(weight=1.0)(field, NO_RENDERER, ctx)
    assert float(means.mean()) == pytest.approx(float(whole), abs=4 * float(means.std()) / 3000**0.5)
    assert float(means.std()) > 0


def test_total_variation_sums_lattices_weighs_and_ends():
    lattices = (Lattice(100 * torch.rand(3, 4, 1), "xy"), Lattice(100 * torch.rand(5, 1), "z"))
    field, penalty = Grids(geometry=lattices), TotalVariationPenalty(weight=0.5, until=0.25)
    expected = sum(looped(x.features, torch.tensor([1.0, 2.0, 0.5])[list(x.columns)], squared=False) for x in lattices)
    assert float(penalty(field, NO_RENDERER, context(0.2))) == pytest.approx(0.5 * expected, rel=1e-5)
    assert float(penalty(field, NO_RENDERER, context(0.25))) == 0


def test_l1_is_the_sum_of_mean_absolute_features():
    field = Grids(geometry=(Lattice(torch.tensor([[1.0, -3.0]]), "x"), Lattice(torch.full((2, 2, 1), -0.5), "yz")))
    for progress, weight in ((0.0, 2.0), (0.5, 0.25)):
        found = L1Penalty(weight=2.0, later=0.25, change=0.5)(field, NO_RENDERER, context(progress))
        assert float(found) == pytest.approx(weight * (2 + 0.5))
    assert float(L1Penalty(weight=2.0)(field, NO_RENDERER, context(1.0))) == 5


def test_sparsity_of_a_constant_density():
    penalty = SparsityPenalty(weight=3.0, points=10)
    assert float(penalty(Grids(density=2.0), NO_RENDERER, context())) == pytest.approx(3 * math.log(9), rel=1e-6)


VOXELS = ["field.encoding.type=voxels", "field.encoding.resolution=8"]


def planned(scene, *changes, **table):
    method = load_method("volumetric/hash", None, [*VOXELS, "batches.rays=64", "renderer.sampler.resolution=16", *changes])
    method = resolve(method.name, "", method.table | table)
    return build_plan(method, scene, Budget(steps=4), 0, torch.device("cpu"))


def test_the_loss_of_a_step_has_the_penalties_and_so_do_the_gradients(scene):
    penalty = {"type": "l1", "weight": 1e3}
    plans = [planned(scene), planned(scene, penalties=[penalty])]
    fits = [Fit(plan) for plan in plans]
    expected = 1e3 * sum(level.features.abs().mean().item() for level in plans[0].model.field.encoding.lattices())
    losses = [fit.step() for fit in fits]
    assert losses[1] - losses[0] == pytest.approx(expected, rel=1e-4)
    weights = [next(plan.model.field.encoding.parameters()) for plan in plans]
    assert not torch.equal(*weights)


def test_a_recipe_keeps_its_table_without_penalties_and_gives_them_back():
    plain = load_method("volumetric/hash")
    assert "penalties" not in plain.table
    penalties = [{"type": "total_variation", "weight": 2.0, "until": 0.5}, {"type": "sparsity"}]
    method = resolve(plain.name, "", load_method("volumetric/hash", None, VOXELS).table | {"penalties": penalties})
    assert [type(penalty) for penalty in method.recipe.penalties] == [TotalVariationPenalty, SparsityPenalty]
    again = resolve(method.name, "", method.table)
    assert again.recipe == method.recipe
    assert again.digest == method.digest != plain.digest


def test_a_field_without_a_density_is_refused_before_anything_is_built():
    table = load_method("planes/mpi").table | {"penalties": [{"type": "sparsity"}]}
    with pytest.raises(InputError, match="The penalty 'sparsity' needs a density, which PlaneField does not have"):
        resolve("planes/mpi", "", table)


def test_fields_without_lattices_are_refused(scene):
    table = load_method("splatting/gaussians").table | {"penalties": [{"type": "total_variation"}]}
    with pytest.raises(InputError, match="The penalty 'total_variation' needs encodings made of lattices, which GaussianField"):
        resolve("splatting/gaussians", "", table)
    plan = planned(scene, "field.encoding.type=hash", penalties=[{"type": "l1"}])
    with pytest.raises(InputError, match="The penalty 'l1' needs lattices for geometry, which this field does not have"):
        Fit(plan).step()
    with pytest.raises(InputError, match="appearance"):
        Fit(replace(planned(scene), penalties=[TotalVariationPenalty(role="appearance")])).step()


@pytest.mark.parametrize("space", ["box", "contracted"])
def test_sparsity_looks_evenly_at_what_the_bounds_describe(space) -> None:
    """In endless space the share of points within a radius of the contracted ball is its cube, as of a ball's volume."""
    seen = []

    class Noted(Grids):
        def query(self, samples, want):
            seen.append(samples.position)
            return super().query(samples, want)

    bounds = Bounds(BOX.lo, BOX.hi, space)
    ctx = Context(bounds, training=True, generator=torch.Generator().manual_seed(0))
    SparsityPenalty(points=20000)(Noted(density=1.0), NO_RENDERER, ctx)
    unit = bounds.to_unit(seen[0]) - 0.5
    radius = 2 * unit.norm(dim=1)
    if space == "contracted":
        for share in (0.25, 0.5, 0.8, 0.99):
            assert float((radius < share).float().mean()) == pytest.approx(share**3, abs=0.01)
        assert float(unit.mean(dim=0).abs().max()) < 0.01
    else:
        assert float((unit.abs() < 0.25).all(dim=1).float().mean()) == pytest.approx(0.125, abs=0.01)
