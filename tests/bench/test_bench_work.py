"""What is measured: the synthetic object, counts of work, the limits' kernels, and a run from end to end at tiny sizes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from invgraphics import kernels
from invgraphics.bench import gates as gates_module
from invgraphics.bench import (
    iterations,
    lattice_cases,
    limits,
    memory,
    peers,
    run,
    sample_cases,
    splat_cases,
    surface_cases,
    workload,
)
from invgraphics.bench.case import Case
from invgraphics.bench.gates import gates
from invgraphics.bench.results import BOTH, FORWARD, FORWARD_ONLY, SIZE_KEYS, Results, Skipped
from invgraphics.bench.run import BenchRequest, bench, measure_case
from invgraphics.bench.timing import TimingBudget
from invgraphics.fields.encodings.hash import HashConfig
from invgraphics.fields.geometry import CPU_CHUNK
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.kernels.types import Footprints
from invgraphics.memory import reset_peak


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sizes and yardsticks that take milliseconds."""
    for module, name, value in (
        (splat_cases, "QUICK_SIZES", ((50, 16), (100, 16))),
        (splat_cases, "GATE", {"gaussians": 100, "width": 16}),
        (sample_cases, "QUICK_HASH_SIZES", ((4, 5), (4, 6))),
        (limits, "MATRIX", 16),
        (limits, "TRIAD_FLOATS", 64),
        (limits, "LOOKUPS", 64),
        (limits, "EXP2_PASSES", 2),
        (limits, "GATHER_BYTES", (1 << 10, 1 << 12)),
        (run, "QUICK", TimingBudget(0.0, 1, 1)),
    ):
        monkeypatch.setattr(module, name, value)
    limits.sgemm.cache_clear()
    limits.triad.cache_clear()
    yield
    limits.sgemm.cache_clear()
    limits.triad.cache_clear()


def test_the_object_is_repeatable_and_its_gaussians_overlap_their_neighbours() -> None:
    field = workload.gaussian_field(3000)
    assert torch.equal(field.means, workload.gaussian_field(3000).means)
    means = field.means.detach()
    ball = (means[:1000] - torch.tensor([-0.4, 0.1, -0.2])).norm(dim=1)
    assert torch.allclose(ball, torch.full_like(ball, 0.4), atol=1e-5)
    nearest = KDTree(means.numpy()).query(means.numpy(), k=4)[0][:, 1:].mean(axis=1)
    ratio = np.median(field.log_scales.detach().exp().numpy() / nearest[:, None])
    assert ratio == pytest.approx(workload.SCALE, rel=0.05)
    assert float(field.opacity_logits.detach().std()) == pytest.approx(2, rel=0.1)


def test_occupied_cells_hold_the_object_and_little_else() -> None:
    cells = workload.occupied(64)
    unit = workload.bounds().to_unit(workload.gaussian_field(500, seed=7).means.detach())
    x, y, z = (unit * 64).long().unbind(1)
    assert bool(cells[x, y, z].all())
    assert 0.01 < float(cells.float().mean()) < 0.2


def test_a_footprint_over_the_whole_picture_is_evaluated_once_per_pixel() -> None:
    one = torch.ones(1)
    wide = Footprints(
        torch.full((1, 2), 16.0), torch.tensor([[1e-6, 0, 1e-6]]), 0.5 * one, one, torch.zeros(1, 3), torch.tensor([1e4])
    )
    assert splat_cases.alpha_evaluations(wide, torch.ones(1, 3), 32, 24) == 32 * 24
    small = Footprints(
        torch.full((1, 2), 2.0), torch.tensor([[9.0, 0, 9.0]]), 0.5 * one, one, torch.zeros(1, 3), torch.tensor([1.0])
    )
    assert splat_cases.alpha_evaluations(small, torch.ones(1, 3), 32, 24) == 16


def test_limits_do_the_work_they_count() -> None:
    from invgraphics.bench.probes import exp2_passes, gather_sum

    table = np.arange(100, dtype=np.int64) ** 2
    places = np.random.default_rng(1).integers(0, 100, 1001, dtype=np.uint32)
    sums = np.zeros(3, np.int64)
    gather_sum(table, places, 3, sums)
    assert sums.sum() == table[places].sum()
    values = np.linspace(-1, 0.5, 2 * 33, dtype=np.float32).reshape(2, 33)
    expected = values.astype(np.float64)
    exp2_passes(values, 3)
    for _ in range(3):
        expected = 2**expected - 1
    assert np.abs(values - expected).max() < 1e-6


def test_networks_alone_are_the_fields_networks() -> None:
    config = NeuralFieldConfig(
        encoding=HashConfig(levels=2, log2_size=4), layers=1, width=8, skip=-1, geometry_features=3,
        colour_width=8, direction="sh", density_activation="exp",
    )  # fmt: skip
    field = config.build(workload.scene(workload.gaussian_field(50), 1, 8))
    gradients = iterations.networks_alone(field, CPU_CHUNK + 5)()
    parameters = sum(1 for _ in (*field.geometry_net.parameters(), *field.colour_net.parameters()))
    assert [part[0].shape for part in gradients] == [(CPU_CHUNK, 4), (5, 4)]
    assert all(len(part) == 1 + parameters and all(bool((g != 0).any()) for g in part) for part in gradients)


def test_whole_steps_are_measured_beside_their_part(monkeypatch) -> None:
    monkeypatch.setattr(iterations, "WARM_STEPS", 2)
    monkeypatch.setattr(iterations, "WARM_SAMPLES", 256)
    monkeypatch.setattr(iterations, "SAMPLES", 512)
    monkeypatch.setattr(iterations, "nerf_scene", lambda: workload.scene(workload.gaussian_field(200), 2, 16))
    once = TimingBudget(0.0, 1, 1)
    found = iterations.splat_step(100, 16, once) + iterations.nerf_step({"levels": 2, "log2_size": 5, "hidden": 8}, once)
    assert [m.operation for m in found] == [
        iterations.SPLAT_SHARE, iterations.SPLAT_STEP, iterations.NERF_SHARE, iterations.NERF_STEP,
    ]  # fmt: skip
    assert all(m.timing.median > 0 and m.amount > 0 for m in found)


@pytest.mark.usefixtures("tiny")
def test_a_run_measures_both_implementations_and_their_limit() -> None:
    said: list[str] = []
    results = bench(BenchRequest(("splats", "hash"), quick=True, progress=said.append))
    for operation in ("splats", "splat_project", "hash_encode"):
        for name in ("reference", "numba"):
            for direction in (FORWARD, BOTH):
                found = results.find(operation, name, direction)
                assert found is not None and found.share is not None and found.share > 0, (operation, name, direction)
    assert results.find("splats", "numba", BOTH).amount == 2 * results.find("splats", "numba", FORWARD).amount
    assert {"sgemm", "triad", "exp2", "gather 1 KB"} <= {m.operation for m in results.measurements}
    assert any("hash_encode levels=16" in sentence for sentence in said)
    assert kernels.in_use() == "numba"


@pytest.mark.usefixtures("tiny")
def test_surfaces_and_neighbours_are_measured_by_both_implementations(monkeypatch) -> None:
    monkeypatch.setattr(surface_cases, "QUICK_DISTANCES", (16,))
    monkeypatch.setattr(surface_cases, "QUICK_TRACE_RAYS", (16,))
    monkeypatch.setattr(surface_cases, "QUICK_MESH_SIZES", ((12, 24),))
    monkeypatch.setattr(surface_cases, "QUICK_NEAR_POINTS", ((60, 40),))
    results = bench(BenchRequest(("trace", "mesh", "near"), quick=True))
    for operation in (
        "sdf_values",
        "sdf_radiance",
        "sdf_skip",
        "sdf_trace",
        "mesh_rasterise",
        "mesh_interpolate",
        "near_points",
    ):
        for name in ("reference", "numba"):
            found = results.find(operation, name, FORWARD)
            assert found is not None and found.timing.median > 0 and found.amount > 0, (operation, name)
            assert set(found.sizes) <= set(SIZE_KEYS)
            assert (results.find(operation, name, BOTH) is None) == (operation in FORWARD_ONLY)
    traced = results.find("sdf_trace", "numba", FORWARD)
    # 19 features and coordinates to 32, and those to one distance; a ray looks once at least, 128 times at most.
    look_ups = traced.amount / 2 / (19 * 32 + 32)
    assert look_ups == int(look_ups)
    assert 8 <= look_ups <= 16 * surface_cases.LIMITS.steps


@pytest.mark.usefixtures("tiny")
def test_without_numba_the_reference_is_measured_alone(monkeypatch) -> None:
    missing = lambda name: "ImportError: no numba" if name == "numba" else ""  # noqa: E731
    for module in (run, limits, splat_cases):
        monkeypatch.setattr(module, "unavailable_reason", missing)
    monkeypatch.setattr(run, "cpu_implementations", lambda: ("reference",))
    results = bench(BenchRequest(("splats", "iterations", "peers"), quick=True))
    assert {m.implementation for m in results.measurements} == {"reference", "machine"}
    slow = "splat_rasterise gaussians=100 width=16 by the reference"
    assert {skipped.what for skipped in results.skipped} == {"numba kernels", "cuda kernels", slow, "iterations", "peers"}
    assert results.find("splats", "reference", BOTH).share is None


@pytest.mark.usefixtures("tiny")
def test_sizes_too_slow_for_the_reference_say_so() -> None:
    results = Results()
    (case,) = [case for case in splat_cases.splats(True) if case.operation == "splat_rasterise"]
    found = measure_case(case, BenchRequest(quick=True), results.skipped)
    assert {m.implementation for m in found} == {"numba"}
    assert "splat_rasterise gaussians=100" in results.skipped[0].what


def test_memory_of_compositing_holds_at_least_its_outputs() -> None:
    if not reset_peak():
        pytest.skip("no /proc")
    results = Results()
    memory.MEMORY_CASES, everything = (
        {"composite": memory.MemoryCase("sample", memory.SAMPLES, ("numba",))},
        memory.MEMORY_CASES,
    )
    try:
        memory.measure_memory(("numba",), results)
    finally:
        memory.MEMORY_CASES = everything
    (found,) = results.memory
    # Weights, transmittance behind, and gradients of the depth and of four channels.
    assert 4 * (1 + 1 + 1 + 4) < found.each < 200


def test_peers_that_are_missing_or_broken_are_named(monkeypatch) -> None:
    def absent():
        raise peers.MissingError("not installed")

    def broken():
        return {FORWARD: lambda: 1 / 0}

    small = {"gaussians": 50, "width": 16}
    monkeypatch.setattr(peers, "SPLAT_GATE", small)
    monkeypatch.setattr(peers, "HASH_GATE", {"levels": 4, "log2_size": 4, "points": 32})
    monkeypatch.setattr(peers, "_nerfstudio", absent)
    monkeypatch.setattr(peers, "_drjit", broken)
    monkeypatch.setattr(peers, "_mitsuba", absent)
    results = Results()
    peers.peers(TimingBudget(0.0, 1, 1), results)
    assert [(skipped.what, skipped.why) for skipped in results.skipped] == [
        ("nerfstudio (torch) hash encoding", "not installed"),
        ("Dr.Jit (LLVM) hash encoding", "it failed: ZeroDivisionError: division by zero"),
        ("Mitsuba's volprim_rf_basic", "not installed"),
    ]
    assert {m.implementation for m in results.measurements} == {"numba"}


def test_quick_runs_measure_what_promises_on_lattices_are_made_for(monkeypatch) -> None:
    monkeypatch.setattr("invgraphics.bench.run._CASES", {"lattice": lambda quick: iter(())})
    monkeypatch.setattr("invgraphics.bench.run._budget", lambda request: TimingBudget(0.0, 1, 1))
    monkeypatch.setattr("invgraphics.bench.run._measure_limits", lambda request, results: None)
    monkeypatch.setattr("invgraphics.bench.run.kernels.warm_up", lambda: None)
    for name, layout in lattice_cases.LAYOUTS.items():
        monkeypatch.setitem(lattice_cases.LAYOUTS, name, replace(layout, vertices=16))
    for module in (lattice_cases, peers, gates_module):
        monkeypatch.setattr(module, "GATE_POINTS", 256)
    found = [gate for gate in gates(bench(BenchRequest(("lattice",), quick=True))) if "lattice" in gate.name]
    assert len(found) == 4 and all(gate.measured is not None for gate in found)


def test_sizes_that_take_the_reference_minutes_are_left_out_where_it_is_alone_too() -> None:
    case = Case("splats", {}, dict, without_reference="minutes")
    skipped: list[Skipped] = []
    assert measure_case(case, BenchRequest(kernels="reference"), skipped) == []
    assert [one.why for one in skipped] == ["minutes"]
