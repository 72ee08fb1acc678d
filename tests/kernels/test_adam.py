"""Adam on touched entries: DVGO's rule in Python, torch's Adam where nothing is skipped, Numba against the reference."""

import math

import pytest
import torch

from invgraphics.kernels import numba, reference
from invgraphics.kernels.types import AdamStep

BETAS = (0.9, 0.99)


def tensors(shape, touched=0.3):
    """Values, a gradient that is zero on most entries, and moments."""
    gradient = torch.randn(shape) * (torch.rand(shape) < touched)
    return torch.randn(shape), gradient, (torch.randn(shape), torch.rand(shape))


def dvgo(entry, step, rate):
    """One entry's update, in Python's own arithmetic (masked_adam_upd and adam_upd_with_perlr of DVGO)."""
    value, g, m, v = entry
    if step.skip_zero and g == 0:
        return value, m, v
    m, v = step.beta1 * m + (1 - step.beta1) * g, step.beta2 * v + (1 - step.beta2) * g * g
    size = step.lr * math.sqrt(1 - step.beta2**step.number) / (1 - step.beta1**step.number)
    return value - rate * size * m / (math.sqrt(v) + step.eps), m, v


@pytest.mark.parametrize("kernels", [reference, numba])
@pytest.mark.parametrize("skip_zero", [True, False])
@pytest.mark.parametrize("per_row", [True, False])
def test_follows_dvgo_entry_by_entry(kernels, skip_zero, per_row):
    values, gradient, (first, second) = tensors((7, 5, 3))
    rates, step = torch.rand(7, 5), AdamStep(0.1, 0.9, 0.99, 1e-8, 4, skip_zero)
    entries = zip(*(x.double().flatten().tolist() for x in (values, gradient, first, second)), strict=True)
    each = rates.double()[..., None].expand(7, 5, 3).flatten().tolist() if per_row else [1.0] * 105
    truth = torch.tensor([dvgo(entry, step, rate) for entry, rate in zip(entries, each, strict=True)])
    before = [x.clone() for x in (values, first, second)]
    kernels.adam_rows(values, gradient, (first, second), step, rates if per_row else None)
    untouched = gradient == 0
    assert untouched.any()
    for k, (found, old) in enumerate(zip((values, first, second), before, strict=True)):
        torch.testing.assert_close(found.flatten(), truth[:, k], atol=1e-5, rtol=1e-5)
        assert torch.equal(found[untouched], old[untouched]) == skip_zero


@pytest.mark.parametrize("kernels", [reference, numba])
def test_equals_torch_where_every_entry_has_a_gradient(kernels):
    values = torch.randn(40, 6)
    parameter, moments = torch.nn.Parameter(values.clone()), (torch.zeros(40, 6), torch.zeros(40, 6))
    adam = torch.optim.Adam([parameter], lr=0.02, betas=BETAS, eps=1e-15)
    for number in range(1, 6):
        parameter.grad = torch.randn(40, 6)
        adam.step()
        kernels.adam_rows(values, parameter.grad, moments, AdamStep(0.02, *BETAS, 1e-15, number))
    torch.testing.assert_close(values, parameter.detach(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (1000, 1), (333, 28), (0, 4), (5, 200)])
@pytest.mark.parametrize("per_row", [True, False])
def test_numba_equals_the_reference(shape, per_row):
    values, gradient, moments = tensors(shape, touched=0.02)
    rates = torch.rand(shape[0]) if per_row else None
    copies = [x.double() for x in (values, gradient, *moments)]
    step = AdamStep(0.1, *BETAS, 1e-12, 7)
    numba.adam_rows(values, gradient, moments, step, rates)
    reference.adam_rows(copies[0], copies[1], (copies[2], copies[3]), step, None if rates is None else rates.double())
    for found, true in zip((values, *moments), (copies[0], *copies[2:]), strict=True):
        torch.testing.assert_close(found.double(), true, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kernels", [reference, numba])
def test_a_gradient_that_is_not_a_number_is_not_hidden(kernels):
    values, gradient, moments = tensors((100, 3), touched=0.0)
    gradient[50, 1] = torch.nan
    kernels.adam_rows(values, gradient, moments, AdamStep(0.1, *BETAS, 1e-12, 1))
    assert values.isnan().sum() == 1
    assert values[50, 1].isnan()


def test_tensors_that_are_not_contiguous():
    values, gradient, moments = tensors((30, 4))
    turned, step = values.T.contiguous().T, AdamStep(0.1, *BETAS, 1e-12, 2)
    copies = [x.clone() for x in moments]
    numba.adam_rows(turned, gradient, (copies[0], copies[1]), step)
    numba.adam_rows(values, gradient, moments, step)
    torch.testing.assert_close(turned, values)


@pytest.mark.parametrize("kernels", [reference, numba])
@pytest.mark.parametrize("shape", [(300, 1), (6, 5, 10, 12), (300, 28)])
@pytest.mark.parametrize("per_row", [True, False])
def test_a_gradient_of_some_rows_steps_these_alone(kernels, shape, per_row):
    values, gradient, moments = tensors(shape)
    rows = torch.randperm(300)[:40].sort().values
    some, whole = gradient.reshape(300, -1)[rows], torch.zeros(300, shape[-1])
    whole[rows] = some
    rates, step = torch.rand(shape[:-1]) if per_row else None, AdamStep(0.1, *BETAS, 1e-12, 3)
    copies = [x.clone() for x in (values, *moments)]
    kernels.adam_rows(values, some, moments, step, rates, rows)
    reference.adam_rows(copies[0], whole.reshape(shape), (copies[1], copies[2]), step, rates)
    for found, true in zip((values, *moments), copies, strict=True):
        torch.testing.assert_close(found, true, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kernels", [reference, numba])
def test_a_gradient_of_no_row_changes_nothing(kernels):
    values, gradient, moments = tensors((30, 4))
    before = [x.clone() for x in (values, *moments)]
    kernels.adam_rows(values, gradient[:0], moments, AdamStep(0.1, *BETAS, 1e-12, 2), None, torch.zeros(0, dtype=torch.int64))
    assert all(torch.equal(x, old) for x, old in zip((values, *moments), before, strict=True))
