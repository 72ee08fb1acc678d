"""Fixtures shared by all tests."""

import invgraphics  # noqa: F401, I001  # before torch, which then reads how long its waiting threads may spin

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from invgraphics import kernels
from invgraphics.experiments.recorder import Monitor

pytest_plugins = ["training_fixtures"]


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session", autouse=True)
def _monitored_pixels() -> None:
    """The monitor looks at few pixels: it takes longer than the steps between its looks in a fit of a few steps."""
    Monitor.PIXELS = 256


@pytest.fixture(autouse=True)
def _kernels() -> Iterator[None]:
    """Kernels that a test forces are its own."""
    yield
    kernels.use(None)


@pytest.fixture
def data() -> Callable[[str], Path]:
    """Path of a real data set under $INVGRAPHICS_DATA, or a skip that says why."""

    def find(name: str) -> Path:
        root = os.environ.get("INVGRAPHICS_DATA")
        if not root:
            pytest.skip("INVGRAPHICS_DATA is not set")
        path = Path(root).resolve() / name
        if not path.exists():
            pytest.skip(f"{path.name} is not in INVGRAPHICS_DATA")
        return path

    return find
