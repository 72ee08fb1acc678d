"""The forecast of an evaluation's time, with a clock of one's own."""

import time
from types import SimpleNamespace
from typing import Any

import pytest

from invgraphics.core import Camera
from invgraphics.experiments.evaluate import expected_seconds
from invgraphics.testing import toy_cameras

VIEWS = 10


class SlowModel:
    """Pictures cost a constant and a part per pixel; the first also compiles."""

    def __init__(self, constant: float, per_pixel: float, compilation: float, monkeypatch: pytest.MonkeyPatch) -> None:
        self._costs, self._compilation, self._now, self.largest = (constant, per_pixel), compilation, 0.0, 0
        monkeypatch.setattr(time, "perf_counter", lambda: self._now)

    def render(self, camera: Camera) -> None:
        constant, per_pixel = self._costs
        self._now += constant + per_pixel * camera.width * camera.height + self._compilation
        self._compilation, self.largest = 0.0, max(self.largest, camera.width)


def _forecast(model: Any) -> float:
    view = SimpleNamespace(camera=toy_cameras(1, 128)[0].resized(128, 64))
    return expected_seconds(model, SimpleNamespace(test=[view] * VIEWS))  # pyright: ignore[reportArgumentType]


def test_pictures_that_are_quick_are_tried_at_full_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither compilation nor the cost of each picture is multiplied by its pixels."""
    model = SlowModel(0.02, 1e-6, 1.0, monkeypatch)
    assert _forecast(model) == pytest.approx(VIEWS * (0.02 + 1e-6 * 128 * 64))


def test_pictures_that_are_slow_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    model = SlowModel(0.0, 1e-2, 1.0, monkeypatch)
    assert _forecast(model) == pytest.approx(VIEWS * 1e-2 * 128 * 64)
    assert model.largest == 16
