"""Fixtures shared by all tests."""

import shared_cores  # noqa: F401, I001  # before torch, as the next one
import invgraphics  # noqa: F401  # before torch, which then reads how long its waiting threads may spin

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from invgraphics import kernels
from invgraphics.experiments.recorder import Monitor

gc.disable()  # imports and collection make a million objects that live on: looking through them again and again takes seconds

pytest_plugins = ["shared_folders", "training_fixtures"]


LONGEST = (
    "fuzz/test_fuzz.py",
    "viewer/test_viewer_browser.py",
    "scenes/test_import_photos.py",
    "sabotage/test_sabotage.py",
    "experiments/test_terminated.py",
    "experiments/test_run.py",
    "report/test_report_browser.py",
    "test_extending.py",
    "test_registering.py",
    "kernels/test_instruction_sets.py",
)
"""Files that come first, so that none of them is left to one of several processes when the others have finished."""


def pytest_collection_finish() -> None:
    """Collect garbage from here on, but not among what the collection of tests has made."""
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order files by `LONGEST`, all others as they are."""
    place = {Path(__file__).parent / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(LONGEST)))


@pytest.fixture(autouse=True)
def _seed() -> None:
    # `torch.manual_seed` looks for all kinds of accelerators, for 3 ms.
    torch.default_generator.manual_seed(0)
    if torch.cuda.is_available():
        torch.cuda.manual_seed_all(0)


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
def unpainted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots are laid out but not painted, which takes half of the time of a page, for tests of everything but plots."""
    from matplotlib.figure import Figure

    monkeypatch.setattr("invgraphics.report.figures.views.EVENLY_SPACED", 1)  # how many views a page shows
    monkeypatch.setattr(Figure, "draw_without_rendering", lambda figure: None)
    monkeypatch.setattr(Figure, "savefig", lambda figure, file, **settings: file.write("<svg/>"))


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
