"""Kernels are tested with as many threads as there are cores, whatever else runs: their threads must not disturb each other."""

from collections.abc import Iterator

import pytest
import torch

from invgraphics.thread_pools import usable_cores


@pytest.fixture(autouse=True)
def _all_cores() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(usable_cores())
    yield
    torch.set_num_threads(before)
