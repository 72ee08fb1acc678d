"""Muon: orthogonalisation against singular vectors, steps against torch's class, and its place beside Adam."""

import math

import pytest
import torch

from invgraphics.experiments.build import build_model
from invgraphics.recipes.recipe import load_method
from invgraphics.testing import toy_scene
from invgraphics.training.optimiser import GroupConfig, Optimiser, OptimiserConfig
from invgraphics.training.optimisers.adam import DenseAdam
from invgraphics.training.optimisers.muon import MOMENTUM, Muon, orthogonalised, takes_muon

SHAPES = {
    "field.hidden.weight": (32, 24),
    "field.bias": (32,),
    "field.output.weight": (3, 32),
    "field.table": (4096, 2),
    "field.features": (80, 16),
    "renderer.hidden.weight": (16, 64),
}
GROUPS = {"field": GroupConfig("field", 1e-2, final=1e-3), "renderer": GroupConfig("renderer", 2e-2)}


def made(muon: float, decay: float = 0.0) -> tuple[dict[str, torch.nn.Parameter], Optimiser]:
    generator = torch.Generator().manual_seed(0)
    parameters = {name: torch.nn.Parameter(torch.randn(shape, generator=generator)) for name, shape in SHAPES.items()}
    return parameters, Optimiser(OptimiserConfig(GROUPS, muon=muon, muon_weight_decay=decay), parameters, 1.0)


def step(parameters: dict[str, torch.nn.Parameter], optimiser: Optimiser, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for parameter in parameters.values():
        parameter.grad = torch.randn(parameter.shape, generator=generator)
    optimiser.step()


@pytest.mark.parametrize("shape", [(32, 32), (64, 16), (16, 64)])
def test_orthogonalised_keeps_singular_vectors_and_brings_values_to_about_one(shape: tuple[int, int]) -> None:
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    u, _, vt = torch.linalg.svd(matrix, full_matrices=False)
    inner = u.mT @ orthogonalised(matrix) @ vt.mT
    values = inner.diagonal()
    assert float(values.min()) > 0.6 and float(values.max()) < 1.3
    assert float((inner - values.diag()).abs().max()) < 1e-4


@pytest.mark.parametrize("decay", [0.0, 2.0])
def test_steps_are_those_of_torchs_own_class(decay: float) -> None:
    """Up to bfloat16, in which torch's iterates; their scale is a whole-matrix factor, which it rounds too."""
    generator = torch.Generator().manual_seed(2)
    ours, theirs = (torch.nn.Parameter(torch.zeros(48, 24)) for _ in range(2))
    muon = Muon([{"params": [ours], "lr": 0.05}], weight_decay=decay)
    judge = torch.optim.Muon([theirs], lr=0.05, weight_decay=decay, adjust_lr_fn="match_rms_adamw")
    for _ in range(4):
        ours.grad = torch.randn(48, 24, generator=generator)
        theirs.grad = ours.grad.clone()
        muon.step()
        judge.step()
    assert float((ours - theirs).detach().norm() / theirs.detach().norm()) < 0.02
    assert torch.allclose(muon.state[ours][MOMENTUM], judge.state[theirs]["momentum_buffer"])


def test_weights_take_muons_steps_and_all_else_adams() -> None:
    (with_muon, optimiser), (alone, adam) = made(3.0), made(0.0)
    for seed in range(3):
        step(with_muon, optimiser, seed)
        step(alone, adam, seed)
    same = {name for name in SHAPES if torch.equal(with_muon[name], alone[name])}
    assert same == {"field.bias", "field.output.weight", "field.table", "field.features"}
    assert {key.rpartition("/")[2] for key in optimiser.state() if key.startswith("field.hidden.weight/")} == {MOMENTUM}


@pytest.mark.parametrize("components", [15, 16])
def test_layers_and_factor_lines_take_muon_however_many_components(components: int) -> None:
    changes = [f"field.{lattice}.components={components}" for lattice in ("encoding", "appearance")]
    method = load_method("volumetric/tensorf-vm", "laptop", changes)
    model = build_model(method, toy_scene(views=2, size=8), 0, torch.device("cpu"))
    named = {name: parameter for part in model.parts.values() for name, parameter in part.named_parameters()}
    chosen = {name for name, parameter in named.items() if takes_muon(name, parameter)}
    linear = {name for name, one in model.field.named_modules() if isinstance(one, torch.nn.Linear)}
    lines = {f"{lattice}.lines.{axis}" for lattice in ("encoding", "appearance") for axis in "xyz"}
    assert lines < chosen and {name.removesuffix(".weight") for name in chosen - lines} <= linear
    assert not any(takes_muon(f"field.{name}", torch.zeros(80, 16)) for name in ("table", "codes", "features", "planes.xy"))


def test_a_steps_size_is_adams_times_the_factor() -> None:
    """The first step of Adam has entries of +-lr; Muon's have a root mean square of a fifth of its rate (arXiv 2502.16982)."""
    parameters, optimiser = made(3.0)
    before = parameters["renderer.hidden.weight"].detach().clone()
    step(parameters, optimiser, 0)
    size = (parameters["renderer.hidden.weight"].detach() - before).square().mean().sqrt()
    assert float(size) == pytest.approx(0.2 * 3 * 2e-2, rel=0.15)


def test_weight_decay_is_decoupled_and_leaves_adams_parameters_alone() -> None:
    """With gradients of 0 nothing else moves; Adam's parameters do not decay."""
    parameters, optimiser = made(3.0, decay=0.5)
    before = {name: parameter.detach().clone() for name, parameter in parameters.items()}
    for parameter in parameters.values():
        parameter.grad = torch.zeros_like(parameter)
    optimiser.step()
    assert torch.allclose(parameters["field.hidden.weight"], before["field.hidden.weight"] * (1 - 3 * 1e-2 * 0.5))
    assert torch.allclose(parameters["renderer.hidden.weight"], before["renderer.hidden.weight"] * (1 - 3 * 2e-2 * 0.5))
    assert all(torch.equal(parameters[name], before[name]) for name in ("field.table", "field.output.weight", "field.bias"))


def test_rates_follow_progress_and_are_said_without_the_factor() -> None:
    parameters, optimiser = made(3.0)
    optimiser.set_progress(1.0)
    assert optimiser.rates() == pytest.approx({"field": 1e-3, "renderer": 2e-2})
    for name, rate in (("field.hidden.weight", 3e-3), ("renderer.hidden.weight", 6e-2)):
        alone = torch.nn.Parameter(parameters[name].detach().clone())
        judge = Muon([{"params": [alone], "lr": rate}])
        parameters[name].grad = torch.ones_like(alone).cumsum(0)
        alone.grad = parameters[name].grad.clone()
        judge.step()
        optimiser.step()
        assert torch.allclose(parameters[name], alone, rtol=1e-6, atol=1e-9)
        optimiser.zero_grad()


def test_resumption_is_bitwise() -> None:
    (straight, one), (first, two) = made(2.0), made(2.0)
    for seed in range(4):
        step(straight, one, seed)
    for seed in range(2):
        step(first, two, seed)
    second, three = made(2.0)
    for name, parameter in second.items():
        parameter.data = first[name].detach().clone()
    three.load(two.state())
    for seed in (2, 3):
        step(second, three, seed)
    assert all(torch.equal(second[name], straight[name]) for name in SHAPES)


def test_a_matrix_of_another_shape_begins_with_the_momentum_it_is_given() -> None:
    parameters, optimiser = made(2.0)
    step(parameters, optimiser, 0)
    new = torch.nn.Parameter(torch.zeros(20, 24))
    optimiser.replace("field.hidden.weight", new, lambda moment: moment[:20])
    assert optimiser.state()[f"field.hidden.weight/{MOMENTUM}"].shape == (20, 24)
    optimiser.replace("field.hidden.weight", torch.nn.Parameter(torch.zeros(18, 24)))
    assert f"field.hidden.weight/{MOMENTUM}" not in optimiser.state()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"muon": -1.0}, "'muon' must be at least 0"),
        ({"muon": 1.0, "muon_weight_decay": -0.1}, "'muon_weight_decay' must be at least 0"),
        ({"beta1": 1.5}, "'beta1' and 'beta2' must be in"),
        ({"beta2": -0.1}, "'beta1' and 'beta2' must be in"),
        ({"eps": 0.0}, "'eps' must be above 0"),
        ({"eps": math.nan}, "'eps' must be above 0"),
    ],
)
def test_impossible_settings_are_refused(values: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        OptimiserConfig(GROUPS, **values)


def test_without_muon_all_parameters_are_adams() -> None:
    _, optimiser = made(0.0)
    assert [type(one) for one in optimiser._optimisers] == [DenseAdam]
