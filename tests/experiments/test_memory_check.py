"""Absurd requests are refused before anything is built, with the value to change."""

import time
from pathlib import Path

import pytest
import torch

from invgraphics import memory
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model
from invgraphics.experiments.memory_check import check_memory
from invgraphics.recipes.recipe import load_method, methods
from invgraphics.scenes.open import SceneOptions, open_scene


@pytest.mark.parametrize(
    ("method", "override", "remedy"),
    [
        ("splatting/gaussians", "field.count=1000000000", "field.count"),
        ("gaussian-volume/exact", "field.count=1000000000", "field.count"),
        ("volumetric/hash", "batches.rays=1000000000", "batches.rays"),
        ("volumetric/nerf", "batches.rays=1000000000", "batches.rays"),
        ("volumetric/nerf", "field.width=1000000", "field.width"),
        ("volumetric/hash", "field.width=1000000", "field.width"),
    ],
)
def test_absurd_requests_are_refused_at_once(toy_folder: Path, method: str, override: str, remedy: str) -> None:
    scene = open_scene(str(toy_folder), SceneOptions())
    began = time.perf_counter()
    with pytest.raises(InputError, match=f"of memory, and .* are free\\.\n.*{remedy}"):
        build_model(load_method(method, "", [override]), scene, 0, torch.device("cpu"))
    assert time.perf_counter() - began < 5


def test_every_method_fits_and_its_parameters_are_counted(toy_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With next to no memory every method is refused, so that none is left out of the forecast."""
    scene = open_scene(str(toy_folder), SceneOptions())
    for name in methods():
        check_memory(load_method(name), scene)
    monkeypatch.setattr(memory, "available_bytes", lambda: 1000)
    for name in methods():
        with pytest.raises(InputError, match="of memory"):
            check_memory(load_method(name), scene)


def test_counted_parameters_are_those_that_are_built(toy_folder: Path) -> None:
    from invgraphics.experiments.memory_check import _parameter_bytes

    scene = open_scene(str(toy_folder), SceneOptions())
    for name in ("volumetric/hash", "volumetric/nerf"):
        method = load_method(name)
        model = build_model(method, scene, 0, torch.device("cpu"))
        assert _parameter_bytes(method, scene) == 4 * sum(parameter.numel() for parameter in model.field.parameters())
