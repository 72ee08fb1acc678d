"""Weighted sums of consecutive rows are scipy's product with a sparse matrix, in every implementation."""

import pytest
import torch
from scipy.sparse import csr_array

from invgraphics import kernels
from invgraphics.kernels.segments import segment_sums

IMPLEMENTATIONS = kernels.dispatch.cpu_implementations()
SEGMENTS = 40


def rows(width: int, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Values, weights and segments; some segments are empty, the first and the last among them."""
    generator = torch.Generator().manual_seed(width)
    segment = (3 * torch.randint(1, 12, (300,), generator=generator)).sort().values
    values = torch.randn(300, width, generator=generator, dtype=dtype)
    return values, torch.randn(300, generator=generator, dtype=dtype), segment


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("width", [1, 3, 70])
@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_sums_and_gradients_are_those_of_a_sparse_matrix(implementation: str, width: int, threads: int) -> None:
    values, weights, segment = rows(width)
    received = torch.randn(SEGMENTS, width, generator=torch.Generator().manual_seed(1))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with kernels.using(implementation):
            sums = segment_sums(values.requires_grad_(), weights.requires_grad_(), segment, SEGMENTS)
            sums.backward(received)
    finally:
        torch.set_num_threads(before)
    x, w, g = (tensor.detach().double().numpy() for tensor in (values, weights, received))
    matrix = csr_array((w, (segment.numpy(), range(len(w)))), shape=(SEGMENTS, len(w)))
    near = {"atol": 2e-5, "rtol": 1e-5, "check_dtype": False}
    torch.testing.assert_close(sums.detach(), torch.from_numpy(matrix @ x), **near)
    torch.testing.assert_close(values.grad, torch.from_numpy(matrix.T @ g), **near)
    torch.testing.assert_close(weights.grad, torch.from_numpy((g[segment.numpy()] * x).sum(axis=1)), **near)


def test_gradients_of_the_reference_are_finite_differences() -> None:
    values, weights, segment = rows(3, torch.float64)
    values, weights, segment = (x[:20] for x in (values.requires_grad_(), weights.requires_grad_(), segment))
    assert torch.autograd.gradcheck(lambda v, w: segment_sums(v, w, segment, SEGMENTS), (values, weights))


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_nothing_sums_to_zero(implementation: str) -> None:
    none = torch.zeros(0, dtype=torch.int64)
    with kernels.using(implementation):
        values = torch.zeros(0, 5, requires_grad=True)
        sums = segment_sums(values, torch.zeros(0), none, 4)
        sums.sum().backward()
    assert torch.equal(sums, torch.zeros(4, 5))
    assert values.grad is not None
    assert values.grad.shape == (0, 5)


@pytest.mark.parametrize("segment", [[0, 4], [-1, 2]])
@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_a_segment_that_is_not_there_is_refused(implementation: str, segment: list[int]) -> None:
    with kernels.using(implementation), pytest.raises((IndexError, RuntimeError)):
        segment_sums(torch.ones(2, 3), torch.ones(2), torch.tensor(segment), 4)
