"""``invgraphics ablate`` up to the first run and after the last: questions, refusals, exit statuses."""

import io
import shlex
import sys
import types
from pathlib import Path

import pytest

from invgraphics.cli import arguments, main
from invgraphics.cli.ablate import Ablate
from invgraphics.experiments.request import AblateRequest
from invgraphics.runs.study import CellRecord
from invgraphics.studies import ablate as module
from invgraphics.studies.forecast import Forecast

LONG, SHORT = Forecast(90, 80, 5 * 3600.0, 3 * 10**9), Forecast(9, 8, 600.0, 10**6)


@pytest.fixture
def study(monkeypatch, tmp_path: Path):
    """A command whose runs and report are left out: calls the confirmation, then 'fails' the cells it is told."""
    report = types.ModuleType("invgraphics.report.study")
    report.build_study_report = lambda folder: folder / "index.html"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "invgraphics.report.study", report)

    def run(forecast: Forecast, *words: str, failed: tuple = ()) -> int:
        def instead(request: AblateRequest, confirm):
            confirm(forecast)
            return Path(request.out), list(failed)

        monkeypatch.setattr(module, "ablate", instead)
        return main.run(["ablate", "families", "--out", str(tmp_path / "out"), *words])

    return run


def test_a_short_study_starts_and_ends_with_its_page(study, tmp_path: Path, capsys) -> None:
    assert study(SHORT) == main.DONE
    shown = capsys.readouterr()
    assert "9 runs, 1 of them finished; the rest takes about 10 min and 0.001 GB." in shown.err
    assert shown.out.strip() == str(tmp_path / "out" / "index.html")


def test_failed_cells_are_named_and_decide_the_status(study, capsys) -> None:
    error = "Step 3: the loss is not finite.\nmore"
    cell = CellRecord(id="a", scene="s", method="m", seed=0, run="runs/a", status="failed", error=error)
    assert study(SHORT, failed=(cell,)) == main.FAILED
    assert "runs/a failed: Step 3: the loss is not finite.\n" in capsys.readouterr().out


def test_a_long_study_asks(study, monkeypatch, capsys) -> None:
    assert study(LONG) == main.BAD_INPUT  # under pytest there is nobody to ask
    assert "about 5 h, and there is no terminal to confirm it" in capsys.readouterr().err
    assert study(LONG, "--yes") == main.DONE
    for answer, status in (("y\n", main.DONE), ("\n", main.BAD_INPUT), ("no\n", main.BAD_INPUT), ("", main.BAD_INPUT)):
        terminal = io.StringIO(answer)
        terminal.isatty = lambda: True  # type: ignore[method-assign]
        monkeypatch.setattr(sys, "stdin", terminal)
        assert study(LONG) == status
    assert "was not started" in capsys.readouterr().err


def test_the_recorded_command_gives_the_same_request(tmp_path: Path) -> None:
    words = ["families", "--out", str(tmp_path), "--executor", "ray", "--jobs", "2", "--seeds", "3,1", "--budget", "5s"]
    words += ["--size", "64x48", "--test-views", "all", "--device", "cuda", "--kernels", "reference", "--gpus", "0.5"]
    request = arguments.parse(Ablate, "invgraphics ablate", words).request()
    assert (request.jobs, request.seeds, request.size, request.test_views, request.gpus) == (2, (3, 1), (64, 48), "all", 0.5)
    assert arguments.parse(Ablate, "invgraphics ablate", shlex.split(request.shell())[2:]).request() == request
    plain = arguments.parse(Ablate, "invgraphics ablate", ["families"]).request()
    assert plain.shell() == "invgraphics ablate families --out reports/families"
    on_ray = ["families", "--device", "cuda", "--executor", "ray"]
    assert arguments.parse(Ablate, "invgraphics ablate", on_ray).request().gpus == 1
    here = arguments.parse(Ablate, "invgraphics ablate", on_ray[:3]).request()
    assert arguments.parse(Ablate, "invgraphics ablate", shlex.split(here.shell())[2:]).request() == here


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nowhere"], "no study 'nowhere'"),
        (["families", "--jobs", "0"], "--jobs cannot be 0"),
        (["families", "--seeds", "x"], "--seeds cannot be 'x'"),
        (["families", "--seeds", "1,1"], "'seeds' has 1 twice"),
        (["families", "--budget", "soon"], "'soon' is not a budget"),
        (["families", "--size", "7"], "--size cannot be '7'"),
    ],
)
def test_bad_arguments_are_refused(words: list[str], sentence: str, capsys) -> None:
    assert main.run(["ablate", *words]) == main.BAD_INPUT
    message = capsys.readouterr().err
    assert sentence in message
    assert len(message.strip().splitlines()) <= main.MOST_LINES


def test_studies_are_listed(capsys) -> None:
    assert main.run(["list", "studies"]) == main.DONE
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split()[:1] == ["families"] and line.split()[-1] == "84" for line in lines)
