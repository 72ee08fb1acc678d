"""Tables, power laws and promises from made-up measurements."""

import csv

import pytest
from bench_made_up import measured

from invgraphics.bench import iterations, lattice_cases, sample_cases, splat_cases
from invgraphics.bench.gates import gates
from invgraphics.bench.growth import growths
from invgraphics.bench.results import BOTH, COLUMNS, FORWARD, PEERS, SIZE_KEYS, PeakMemory, Results, write_tables
from invgraphics.bench.run import thread_counts
from invgraphics.bench.tables import number, quantity


def test_share_is_the_rate_over_the_limit() -> None:
    m = measured("splats", "numba", FORWARD, {}, 0.5, amount=3e9, unit="alpha evaluations", limit="exp2", limit_rate=2.4e10)
    assert m.rate == pytest.approx(6e9) and m.share == pytest.approx(0.25)
    assert measured("splats", "numba", FORWARD, {}, 0.5).share is None


def test_tables_on_disk(tmp_path) -> None:
    results = Results(
        [measured("ssim", "numba", BOTH, {"width": 400, "channels": 3}, 0.002, amount=10.0, unit="flop")],
        [PeakMemory("ssim", "numba", 1000, "pixel", 64_000)],
    )
    write_tables(results, tmp_path)
    (row,) = csv.DictReader((tmp_path / "results.csv").open())
    assert tuple(row) == COLUMNS
    assert (row["operation"], row["width"], row["gaussians"], row["threads"]) == ("ssim", "400", "", "2")
    assert [float(row[key]) for key in ("median_ms", "low_ms", "high_ms")] == pytest.approx([2.0, 1.8, 2.2])
    assert (float(row["rate"]), row["unit"], row["share"]) == (5000.0, "flop/s", "")
    (memory,) = csv.DictReader((tmp_path / "memory.csv").open())
    assert float(memory["bytes_per_unit"]) == 64


def test_every_size_of_every_case_has_a_column() -> None:
    makers = (splat_cases.splats, splat_cases.ssim, sample_cases.hash_encode, lattice_cases.lattice_encode)
    for make in (*makers, sample_cases.ray_march, sample_cases.composite):
        for case in make(False):
            assert case.sizes and set(case.sizes) <= set(SIZE_KEYS)


def test_exponents_of_exact_power_laws() -> None:
    times = {
        ("splats", "gaussians"): [({"gaussians": n, "width": 100}, 3e-9 * n**1.7) for n in (10, 100, 1000)],
        ("ssim", "pixels"): [({"width": w}, 1e-9 * w**2) for w in (10, 20, 80)],
        ("hash_encode", "entries per level"): [({"log2_size": k}, 2 ** (k / 2)) for k in (3, 5, 9)],
        ("composite", ""): [({"samples": n}, 1.0 * n) for n in (10, 20)],
    }
    made = [measured(name, "numba", BOTH, sizes, seconds) for (name, _), cells in times.items() for sizes, seconds in cells]
    found = {(g.operation, g.along): g.exponent for g in growths(made)}
    assert found == {
        ("splats", "gaussians"): pytest.approx(1.7),
        ("ssim", "pixels"): pytest.approx(1.0),
        ("hash_encode", "entries per level"): pytest.approx(0.5),
    }


def test_measurements_that_differ_in_more_than_one_size_are_not_compared() -> None:
    sizes = [{"gaussians": 10 * k, "width": k} for k in (1, 2, 3)]
    assert growths([measured("splats", "numba", BOTH, size, 1.0) for size in sizes]) == []


def promised(speed_up: float, splat_share: float, step: float, hash_share: float, rate_share: float, lattice: float) -> Results:
    """A run in which the promises come out as asked."""
    limit = {"amount": 1.0, "limit": "x"}
    samplers = [
        measured(f"{PEERS}: {name}", who, BOTH, layout.sizes(lattice_cases.GATE_POINTS), seconds)
        for name, layout in lattice_cases.LAYOUTS.items()
        for who, seconds in (("numba", 0.1), (lattice_cases.TORCH, 0.1 * lattice * lattice_cases.SPEED_UPS[name]))
    ]
    return Results(
        [
            measured("splats", "reference", BOTH, splat_cases.GATE, 0.1 * speed_up),
            measured("splats", "numba", BOTH, splat_cases.GATE, 0.1, **limit, limit_rate=10 / splat_share),
            measured("splat_rasterise", "numba", BOTH, splat_cases.GATE, 0.1, **limit, limit_rate=10 / splat_share),
            measured("hash_encode", "numba", BOTH, sample_cases.GATE, 0.1, **limit, limit_rate=10 / hash_share),
            measured(iterations.SPLAT_SHARE, "numba", BOTH, splat_cases.GATE, 0.1),
            measured(iterations.SPLAT_STEP, "numba", BOTH, splat_cases.GATE, 0.1 * step),
            measured(iterations.NERF_SHARE, "torch", BOTH, iterations.NERF_GATE, 0.1, amount=100.0),
            measured(iterations.NERF_STEP, "numba", BOTH, iterations.NERF_GATE, 0.2, amount=200.0 * rate_share),
            *samplers,
            *(
                measured(name, "numba", BOTH, lattice_cases.STEP.sizes(lattice_cases.STEP_POINTS), seconds)
                for name, seconds in (
                    (lattice_cases.WHOLE_STEP, 0.1 * lattice * lattice_cases.STEP_SPEED_UP),
                    (lattice_cases.SPARSE_STEP, 0.1),
                )
            ),
        ]
    )


def test_promises_kept_and_missed() -> None:
    kept = gates(promised(26, 0.07, 1.6, 0.5, 0.45, 1.1))
    speed_ups = [1.1 * factor for factor in (*lattice_cases.SPEED_UPS.values(), lattice_cases.STEP_SPEED_UP)]
    assert [gate.verdict for gate in kept] == ["PASS"] * (6 + len(speed_ups))
    assert [gate.measured for gate in kept] == pytest.approx([26, 0.07, 0.07, 1.6, 0.5, 0.45, *speed_ups])
    assert [gate.verdict for gate in gates(promised(24, 0.05, 1.8, 0.3, 0.35, 0.9))] == ["MISS"] * len(kept)
    assert [gate.verdict for gate in gates(Results())] == ["-"] * len(kept)


def test_numbers_in_words() -> None:
    assert [quantity(x) for x in (5, 16384, 2.1e9)] == ["5", "16.4k", "2.1 G"]
    assert [number(x) for x in (0.01234, 99.96, 1234.5)] == ["0.0123", "100", "1234"]
    assert [thread_counts(n) for n in (1, 2, 6, 8)] == [[1], [1, 2], [1, 2, 4, 6], [1, 2, 4, 8]]
