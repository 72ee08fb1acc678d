"""Absurd requests are refused before anything is built, with the value to change."""

import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from invgraphics import memory
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model, build_plan
from invgraphics.experiments.memory_check import check_memory
from invgraphics.experiments.start import memory_forecast
from invgraphics.fields.depth_maps import DepthMapsConfig
from invgraphics.recipes.recipe import load_method, methods
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.training.budget import Budget


@pytest.mark.parametrize(
    ("method", "override", "remedy"),
    [
        ("splatting/gaussians", "field.count=1000000000", "field.count"),
        ("gaussian-volume/exact", "field.count=1000000000", "field.count"),
        ("volumetric/hash", "batches.rays=1000000000", "batches.rays"),
        ("volumetric/nerf", "batches.rays=1000000000", "batches.rays"),
        ("volumetric/nerf", "field.width=1000000", "field.width"),
        ("volumetric/hash", "field.width=1000000", "field.width"),
        ("volumetric/nerf", "renderer.sampler.coarse=65536", "renderer.sampler"),
        ("volumetric/hash", "renderer.sampler.resolution=1000000", "renderer.sampler"),
        ("volumetric/hash", "renderer.sampler.cells=1000000000", "renderer.sampler"),
        ("volumetric/dvgo", "field.encoding.resolution=1000000", "field.encoding"),
        ("volumetric/plenoxels", "hooks.0.rays=1000000000", "rays"),
        ("volumetric/plenoxels", "hooks.1.resolution=10000", "in the hooks"),
        ("volumetric/tensorf-vm", "hooks.0.resolution=1000000", "in the hooks"),
        ("sphere-tracing/mlp", "penalties.0.points=1000000000", "points"),
    ],
)
def test_absurd_requests_are_refused_at_once(toy_folder: Path, method: str, override: str, remedy: str) -> None:
    scene = open_scene(str(toy_folder), SceneOptions())
    began = time.process_time()
    with pytest.raises(InputError, match=f"of memory, and .* are free\\.\n.*{remedy}"):
        build_model(load_method(method, "", [override]), scene, 0, torch.device("cpu"))
    assert time.process_time() - began < 5


def test_photographs_with_depth_are_counted_and_not_made(toy_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the meta device, which is for shapes, a stack of photographs would be as large as on the CPU."""
    scene = open_scene(str(toy_folder), SceneOptions())
    monkeypatch.setattr(DepthMapsConfig, "build", lambda config, scene: pytest.fail("built"))
    check_memory(load_method("planes/depth-warp"), scene)
    large = replace(scene.train[0], camera=replace(scene.train[0].camera, width=1 << 20, height=1 << 20))
    with pytest.raises(InputError, match=r"with 1 photographs and their depth needs about 8,796 GB"):
        check_memory(load_method("planes/depth-warp"), scene.with_views(train=(large,)))


def test_a_container_has_less_memory_than_its_machine(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, device = open_scene(str(toy_folder), SceneOptions()), torch.device("cpu")
    method = load_method("splatting/gaussians-mcmc", "long")
    plan = build_plan(method, scene, Budget(seconds=300.0), 0, device)
    memory_forecast(plan, method, 24_000_000)
    (tmp_path / "memory.max").write_text("200000000\n")
    monkeypatch.setattr(memory, "_CGROUP", tmp_path)
    with pytest.raises(InputError, match=r"150,000 primitives need about .* this machine has 0\.2 GB"):
        memory_forecast(plan, method, 24_000_000)


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
    from invgraphics.experiments.memory_check import _build, _bytes

    scene = open_scene(str(toy_folder), SceneOptions())
    for name in ("volumetric/hash", "volumetric/nerf"):
        method = load_method(name)
        model = build_model(method, scene, 0, torch.device("cpu"))
        assert _bytes(_build(method.recipe.field, name, scene)) == 4 * sum(
            parameter.numel() for parameter in model.field.parameters()
        )


@pytest.mark.parametrize(
    ("method", "override"),
    [
        ("volumetric/nerf", "field.layers=1000000000"),
        ("volumetric/nerf", "field.colour_layers=1000000000"),
        ("volumetric/nerf", "field.direction_degree=1000000000"),
        ("volumetric/tensorf-vm", "field.feature_octaves=1000000000"),
        ("volumetric/hash", "field.encoding.levels=1000000000"),
        ("volumetric/dense", "field.encoding.levels=1000000000"),
        ("volumetric/hash", "renderer.sampler.steps_per_diagonal=1000000000"),
        ("hybrid/neus", "renderer.sampler.rounds=1000000000"),
        ("hybrid/volsdf", "renderer.sampler.bisections=1000000000"),
        ("sphere-tracing/mlp", "renderer.steps=1000000000"),
        ("gaussian-volume/exact", "renderer.steps=1000000000"),
    ],
)
def test_numbers_of_rounds_have_a_limit(method: str, override: str) -> None:
    """What is done one after another takes no memory that could be forecast, and for ever."""
    name = override.partition("=")[0].rpartition(".")[2]
    with pytest.raises(InputError, match=rf"{name}.* from [01] to \d+"):
        load_method(method, "", [override])


def test_the_forecast_covers_a_growth_that_was_measured(toy_folder: Path) -> None:
    """MCMC on `bricks` at 128 px held 24 MB after its first step, and 555 MB at most while it grew to 150,000 Gaussians."""
    scene, device = open_scene(str(toy_folder), SceneOptions()), torch.device("cpu")
    method, budget = load_method("splatting/gaussians-mcmc", "long"), Budget(seconds=300.0)
    forecast = memory_forecast(build_plan(method, scene, budget, 0, device), method, 24_000_000)
    assert forecast.primitives == 150_000
    assert 555e6 < forecast.bytes < 1.25 * 555e6


def test_the_forecast_covers_gaps_that_were_measured(toy_folder: Path) -> None:
    """NeRF on `room` at 128 px and two threads held 49 MB after its first step and monitor pass, and 144 MB at most."""
    scene, device = open_scene(str(toy_folder), SceneOptions()), torch.device("cpu")
    method, budget = load_method("volumetric/nerf", "laptop"), Budget(seconds=60.0)
    forecast = memory_forecast(build_plan(method, scene, budget, 0, device), method, 49_000_000)
    assert 144e6 < forecast.bytes < 1.25 * 144e6


@pytest.mark.parametrize(
    ("method", "preset", "override", "held", "peak"),
    [
        ("volumetric/dvgo", "laptop", "", 90e6, 532e6),
        ("volumetric/dvgo", "hour", "hooks.1.min_spacing=0", 100e6, 5710e6),
        ("volumetric/plenoxels", "laptop", "", 150e6, 723e6),
        ("volumetric/plenoxels", "hour", "hooks.1.min_spacing=0", 160e6, 1833e6),
    ],
)
def test_the_forecast_covers_lattices_that_grow(
    toy_folder: Path, method: str, preset: str, override: str, held: float, peak: float
) -> None:
    """Peaks of fits at 128 px on `bricks` and `room`, and of `mic` at 800: 48 vertices along an edge became 112, 256, 320."""
    scene, device = open_scene(str(toy_folder), SceneOptions()), torch.device("cpu")
    found = load_method(method, preset, [override] if override else [])
    forecast = memory_forecast(build_plan(found, scene, Budget(seconds=60.0), 0, device), found, int(held))
    assert peak < forecast.bytes < 2.5 * peak


def test_a_network_is_not_counted_once_for_every_point(toy_folder: Path) -> None:
    """A point of the paper's Point-NeRF has a position, 32 features, a colour and a confidence: 156 bytes, of 6 copies each."""
    scene, device = open_scene(str(toy_folder), SceneOptions()), torch.device("cpu")
    method = load_method("volumetric/point-nerf", "paper")
    forecast = memory_forecast(build_plan(method, scene, Budget(seconds=60.0), 0, device), method, 24_000_000)
    assert forecast.primitives == 1_000_000
    assert 6 * 156e6 < forecast.bytes < 3 * 6 * 156e6
