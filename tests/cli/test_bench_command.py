"""``invgraphics bench``: arguments, exit statuses and the page, with a made-up run."""

import json
import re
from pathlib import Path

import pytest
from bench_made_up import measured

from invgraphics.bench import PARTS, QUICK, iterations, lattice_cases, sample_cases, splat_cases
from invgraphics.bench import run as bench_run
from invgraphics.bench.results import BOTH, FORWARD, PEERS, THREADS, PeakMemory, Results, Skipped
from invgraphics.cli import main
from invgraphics.cli.bench import Bench
from invgraphics.errors import InputError


def made_up_results() -> Results:
    """A run with something in every table, in which all promises but the iteration's are kept."""
    limit = {"amount": 1.0, "unit": "look-ups", "limit": "gather 1 KB", "limit_rate": 20.0}
    results = Results(memory=[PeakMemory("splats", "numba", 10, "Gaussian", 10_000)])
    for n in (10_000, splat_cases.GATE["gaussians"], 200_000):
        for direction in (FORWARD, BOTH):
            sizes = {**splat_cases.GATE, "gaussians": n}
            results.measurements += [
                measured("splats", "reference", direction, sizes, 3.0 * n / 1e4),
                measured("splats", "numba", direction, sizes, 0.1 * n / 1e4, **limit | {"amount": n / 1e4}),
            ]
    results.measurements += [
        measured("splat_rasterise", "numba", BOTH, splat_cases.GATE, 0.1, **limit),
        measured("hash_encode", "numba", BOTH, sample_cases.GATE, 0.1, **limit),
        measured(iterations.SPLAT_SHARE, "numba", BOTH, splat_cases.GATE, 0.1, amount=1.0),
        measured(iterations.SPLAT_STEP, "numba", BOTH, splat_cases.GATE, 0.2, amount=1.0),
        measured(iterations.NERF_SHARE, "torch", BOTH, iterations.NERF_GATE, 0.1, amount=100.0),
        measured(iterations.NERF_STEP, "numba", BOTH, iterations.NERF_GATE, 0.2, amount=100.0),
        measured(f"{PEERS}: hash encoding", "numba", BOTH, sample_cases.GATE, 0.1),
        measured(f"{PEERS}: hash encoding", "another's <code>", BOTH, sample_cases.GATE, 0.4),
        *(measured(f"{THREADS}: ssim", "numba", BOTH, {"width": 400}, 1 / n, threads=n) for n in (1, 2)),
        *(measured(f"gather {n} KB", "machine", "", {"bytes": 1024 * n}, 0.1, amount=10 / n) for n in (1, 4)),
    ]
    for name, layout in lattice_cases.LAYOUTS.items():
        sizes = layout.sizes(lattice_cases.GATE_POINTS)
        results.measurements += [
            measured(f"{PEERS}: {name}", "numba", BOTH, sizes, 0.1),
            measured(f"{PEERS}: {name}", lattice_cases.TORCH, BOTH, sizes, 1.2),
        ]
    at = lattice_cases.STEP.sizes(lattice_cases.STEP_POINTS)
    results.measurements += [
        measured(lattice_cases.WHOLE_STEP, "numba", BOTH, at, 0.6),
        measured(lattice_cases.SPARSE_STEP, "numba", BOTH, at, 0.1),
    ]
    results.skipped.append(Skipped("a peer", "it is not installed"))
    return results


def made_up_run(request: bench_run.BenchRequest, results: Results) -> Results:
    made = made_up_results()
    results.measurements += made.measurements
    results.memory += made.memory
    results.skipped += made.skipped
    return results


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_run, "bench", made_up_run)


def test_the_help_names_every_part(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main.run(["bench", "--help"])
    listed = re.search(r"Parts to measure: ([^.]*)\.", capsys.readouterr().out.replace("│", " "))
    assert listed is not None and tuple(re.findall(r"\w+", listed.group(1))) == PARTS


def test_parts() -> None:
    assert Bench().parts() == PARTS
    assert Bench(quick=True).parts() == QUICK
    assert set(QUICK) == {*bench_run._CASES, "iterations"}
    assert Bench(only="splats, hash").parts() == ("splats", "hash")
    with pytest.raises(InputError, match="no part 'splat'"):
        Bench(only="splat").parts()


def test_unknown_kernels_are_refused(capsys) -> None:
    assert main.run(["bench", "--kernels", "fortran"]) == main.BAD_INPUT
    assert "There are no 'fortran' kernels." in capsys.readouterr().err


@pytest.mark.usefixtures("made_up")
def test_a_missed_promise_fails_only_a_check(tmp_path: Path, capsys) -> None:
    assert main.run(["bench", "--out", str(tmp_path)]) == main.DONE
    shown = capsys.readouterr().out
    assert "10 of 11 promises kept, 1 missed." in shown and "left out: a peer (it is not installed)" in shown
    assert main.run(["bench", "--out", str(tmp_path), "--check"]) == main.FAILED


@pytest.mark.usefixtures("made_up")
def test_the_page_is_whole_and_works_offline(tmp_path: Path) -> None:
    main.run(["bench", "--out", str(tmp_path)])
    html = (tmp_path / "index.html").read_text()
    assert html.count(">PASS<") == 10 and html.count(">MISS<") == 1
    assert "another&#39;s &lt;code&gt;" in html and "10 of 11 promises kept" in html
    sections = ("kernels", "steps", "growth", "threads", "memory", "peers", "limits", "machine")
    assert all(f'<section id="{name}">' in html and f'href="#{name}"' in html for name in sections)
    links = re.findall(r'(?:src|href)="([^"#]+)"', html)
    assert not [link for link in links if link.startswith(("http", "/", "file"))]
    assert all((tmp_path / link).is_file() for link in links if not link.startswith("data:"))
    assert sum(link.endswith(".svg") for link in links) == 4
    record = json.loads((tmp_path / "bench.json").read_text())
    assert record["gates"][3]["verdict"] == "MISS" and record["gates"][3]["measured"] == pytest.approx(2)
    exponents = {(g["implementation"], g["along"]): g["exponent"] for g in record["growth"]}
    assert exponents["numba", "gaussians"] == pytest.approx(1)
    assert "load at the start" in record["record"]


def test_a_part_does_not_replace_the_page_of_a_whole_run() -> None:
    folders = [Bench()._default_folder(), Bench(quick=True)._default_folder(), Bench(only="ssim, hash")._default_folder()]
    assert folders == [Path("reports/bench"), Path("reports/bench-quick"), Path("reports/bench-ssim-hash")]


def test_a_folder_that_cannot_be_made_is_refused_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def measured_anyway(*_: object) -> Results:
        raise AssertionError

    monkeypatch.setattr(bench_run, "bench", measured_anyway)
    (tmp_path / "file").write_text("")
    assert main.run(["bench", "--out", str(tmp_path / "file")]) == main.BAD_INPUT
    assert "cannot be written: File exists" in capsys.readouterr().err


def test_an_interrupted_run_shows_and_writes_what_it_has_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(request: bench_run.BenchRequest, results: Results) -> Results:
        results.measurements += made_up_results().measurements[:2]
        raise KeyboardInterrupt

    monkeypatch.setattr(bench_run, "bench", interrupted)
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "earlier.svg").write_text("")
    assert main.run(["bench", "--out", str(tmp_path)]) == main.INTERRUPTED
    assert "not measured" in capsys.readouterr().out
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 3
    assert json.loads((tmp_path / "bench.json").read_text())["record"]["interrupted"] == "yes"
    assert not (tmp_path / "figures" / "earlier.svg").exists()
