"""Adam: torch's bits; and with ``skip_zero``: entries left alone, rates per row, changes of rows, resumption to the bit."""

import subprocess
import sys

import pytest
import torch

from invgraphics.errors import InputError
from invgraphics.training.optimiser import GroupConfig, Optimiser, OptimiserConfig
from invgraphics.training.optimisers.adam import DenseAdam

CONFIG = OptimiserConfig({"grid": GroupConfig("field.grid", 0.1, skip_zero=True), "net": GroupConfig("field.net", 0.1)})


def made(values=None):
    """A grid and a network, and their optimiser."""
    values = torch.ones(4, 3, 2) if values is None else values
    parameters = {"field.grid": torch.nn.Parameter(values.clone()), "field.net": torch.nn.Parameter(torch.ones(5))}
    return parameters, Optimiser(CONFIG, parameters, 1.0)


def step(parameters, optimiser, seed, touched=slice(0, 2)):
    """One step in which only some rows of the grid have a gradient."""
    generator = torch.Generator().manual_seed(seed)
    gradient = torch.zeros(parameters["field.grid"].shape)
    gradient[touched] = torch.randn(gradient[touched].shape, generator=generator)
    parameters["field.grid"].grad = gradient
    parameters["field.net"].grad = torch.randn(5, generator=generator)
    optimiser.step()


def test_dense_steps_are_those_of_torchs_own_class():
    generator = torch.Generator().manual_seed(0)
    ours, theirs = ([torch.nn.Parameter(torch.ones(4, 3)), torch.nn.Parameter(torch.ones(5))] for _ in range(2))
    adam = DenseAdam([{"params": ours[:1], "lr": 0.1}, {"params": ours[1:], "lr": 0.02}], (0.8, 0.95), 1e-6)
    groups = [{"params": theirs[:1], "lr": 0.1}, {"params": theirs[1:], "lr": 0.02}]
    judge = torch.optim.Adam(groups, betas=(0.8, 0.95), eps=1e-6, fused=True)
    for number in range(5):
        for a, b in zip(ours, theirs, strict=True):
            a.grad = torch.randn(a.shape, generator=generator)
            b.grad = a.grad.clone()
        if number == 2:
            ours[0].grad = theirs[0].grad = None
        adam.step()
        judge.step()
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    for a, b in zip(ours, theirs, strict=True):
        assert adam.state[a].keys() == judge.state[b].keys()
        assert all(torch.equal(value, judge.state[b][key]) for key, value in adam.state[a].items())
    adam.zero_grad()
    assert all(parameter.grad is None for parameter in ours)


def test_rows_without_gradient_stay_while_torch_moves_them_by_momentum():
    parameters, optimiser = made()
    step(parameters, optimiser, 0, slice(0, 3))
    before = parameters["field.grid"].detach().clone()
    step(parameters, optimiser, 1, slice(0, 2))
    moved = (parameters["field.grid"].detach() != before).flatten(1).all(1)
    assert moved.tolist() == [True, True, False, False]
    assert (parameters["field.net"] != 1).all()


def test_touched_entries_move_as_in_torch():
    parameters, optimiser = made()
    plain, dense = made()
    dense = Optimiser(OptimiserConfig({"all": GroupConfig("field", 0.1)}), plain, 1.0)
    for seed in range(4):
        step(parameters, optimiser, seed)
        step(plain, dense, seed)
    for name in parameters:
        torch.testing.assert_close(parameters[name].detach(), plain[name].detach(), atol=1e-5, rtol=1e-5)


def test_rates_per_row_scale_the_step():
    (slow, slowly), (fast, quickly) = made(), made()
    rates = torch.rand(4, 3)
    slowly.set_row_rates("field.grid", rates)
    for parameters, optimiser in ((slow, slowly), (fast, quickly)):
        step(parameters, optimiser, 0, slice(0, 4))
    ratio = (slow["field.grid"] - 1) / (fast["field.grid"] - 1)
    torch.testing.assert_close(ratio.detach(), rates[..., None].expand(4, 3, 2), atol=1e-4, rtol=1e-4)


def test_resumes_to_the_bit():
    parameters, optimiser = made()
    optimiser.set_row_rates("field.grid", torch.rand(4, 3))
    step(parameters, optimiser, 0)
    stored = {name: value.clone() for name, value in optimiser.state().items()}
    again, resumed = made(parameters["field.grid"].detach())
    again["field.net"].data.copy_(parameters["field.net"].detach())
    resumed.load(stored)
    step(parameters, optimiser, 1)
    step(again, resumed, 1)
    assert set(stored) >= {"field.grid/row_rates", "field.grid/step", "field.grid/exp_avg", "field.net/exp_avg"}
    assert all(torch.equal(parameters[name], again[name]) for name in parameters)


def test_moments_and_rates_follow_the_rows():
    parameters, optimiser = made(torch.ones(4, 3))
    optimiser.set_row_rates("field.grid", torch.tensor([0.1, 0.2, 0.3, 0.4]))
    step(parameters, optimiser, 0, slice(0, 4))
    old = optimiser.state()["field.grid/exp_avg"].clone()
    replaced = torch.nn.Parameter(torch.ones(3, 3))
    optimiser.reindex_rows("field.grid", replaced, torch.tensor([3, 1]), 1)
    state = optimiser.state()
    torch.testing.assert_close(state["field.grid/row_rates"], torch.tensor([0.4, 0.2, 1.0]))
    torch.testing.assert_close(state["field.grid/exp_avg"], torch.cat([old[[3, 1]], torch.zeros(1, 3)]))
    optimiser.reset_moments("field.grid")
    assert not optimiser.state()["field.grid/exp_avg"].any()
    assert optimiser.state()["field.grid/row_rates"].all()
    step({"field.grid": replaced, "field.net": parameters["field.net"]}, optimiser, 1, slice(0, 3))
    assert (replaced != 1).all()


def test_rates_that_do_not_fit_are_refused():
    _, optimiser = made()
    with pytest.raises(InputError, match=r"has rows \(4, 3\), but the rates have \(4,\)"):
        optimiser.set_row_rates("field.grid", torch.ones(4))
    with pytest.raises(InputError, match=r"'skip_zero = true' in 'optimiser\.groups\.net'"):
        optimiser.set_row_rates("field.net", torch.ones(()))


def test_a_process_that_fits_imports_no_compiler():
    """As torch's optimisers do, and its switch to deterministic algorithms."""
    code = (
        "import sys, torch\n"
        "from invgraphics.experiments.build import configure_torch\n"
        "from invgraphics.training.optimiser import GroupConfig, Optimiser, OptimiserConfig\n"
        "configure_torch(torch.device('cpu'))\n"
        "assert torch.are_deterministic_algorithms_enabled()\n"
        "parameters = {name: torch.nn.Parameter(torch.ones(2, 3)) for name in ('field.a', 'field.b')}\n"
        "groups = {name[-1]: GroupConfig(name, 0.1, skip_zero=name == 'field.b') for name in parameters}\n"
        "optimiser = Optimiser(OptimiserConfig(groups), parameters, 1.0)\n"
        "sum(parameter.sum() for parameter in parameters.values()).backward()\n"
        "optimiser.step()\n"
        "assert all(float(parameter.max()) < 1 for parameter in parameters.values())\n"
        "print([name for name in ('torch._dynamo', 'torch._inductor', 'sympy') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("places", [[0, 5, 7], [7, 0, 5], [7, 0, 7]])
def test_sparse_gradients_step_as_dense_ones(places):
    """Whether their rows are in order, are not, or come twice."""
    (some, sparsely), (whole, densely) = made(), made()
    rates = torch.rand(4, 3)
    for number in range(3):
        at, values = torch.tensor(places) + number, torch.randn(3, 2)
        gradient = torch.sparse_coo_tensor(torch.stack([at // 3, at % 3]), values, (4, 3, 2), check_invariants=True)
        some["field.grid"].grad, whole["field.grid"].grad = gradient, gradient.to_dense()
        sparsely.step()
        densely.step()
        if number == 0:
            sparsely.set_row_rates("field.grid", rates)
            densely.set_row_rates("field.grid", rates)
    torch.testing.assert_close(some["field.grid"], whole["field.grid"], atol=1e-6, rtol=1e-6)
    assert (some["field.grid"] != 1).flatten(1).any(1).sum() > 1


def test_only_parameters_whose_zeros_are_skipped_may_have_sparse_gradients():
    _, optimiser = made()
    assert optimiser.skips_zero("field.grid")
    assert not optimiser.skips_zero("field.net")
