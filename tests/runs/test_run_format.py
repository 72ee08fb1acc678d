"""The page about the format names what the records hold; nobody else knows files or keys; what was published is still read."""

from __future__ import annotations

import ast
import csv
import dataclasses
import importlib
import json
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

import invgraphics
from invgraphics import runs
from invgraphics.runs.environment import Environment
from invgraphics.runs.history import Moment
from invgraphics.runs.run import Run, read_run
from invgraphics.runs.schema import Record, stored_fields
from invgraphics.runs.scores import COST_UNITS
from invgraphics.runs.study import StudyRecord

ROOT = Path(__file__).parents[2]
SOURCES = Path(invgraphics.__file__).parent
PAGE = ROOT / "docs" / "run-format.md"
REPORTS = ROOT / "reports"

NAMES = (
    "scores.json", "provenance.json", "environment.json", "history.jsonl", "fit.json", "compare.json", "study.json",
    "renderings.json", "recipe.toml", "checkpoint.safetensors", "ray.json", "ray.csv",
)  # fmt: skip
KEYS = (
    "cell_sha256", "recipe_sha256", "truth_sha256", "train_sha256", "cameras_sha256", "preset_chosen_on", "fitted_run",
    "per_training_view", "forecast_seconds", "wall_seconds", "loss_at_start", "test_view", "rotation_deg",
)  # fmt: skip


def tables(page: str) -> dict[str, dict[str, bool]]:
    """Heading -> key -> whether every file has it."""
    found: dict[str, dict[str, bool]] = {}
    for section in re.split(r"^##+ ", page, flags=re.M)[1:]:
        rows = re.findall(r"^\| `(\w+)`( \?)? \|", section.partition("| cost |")[0], flags=re.M)
        if "| key |" in section:
            found[section.splitlines()[0]] = {key: not mark for key, mark in rows}
    return found


def kinds() -> Iterator[type]:
    """Every record of the package, and every table in one."""
    for module in pkgutil.iter_modules(runs.__path__):
        importlib.import_module(f"{runs.__name__}.{module.name}")
    waiting: list[Any] = [*Record.__subclasses__(), Moment]
    while waiting:
        kind = waiting.pop()
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            yield kind
            waiting += get_type_hints(kind).values()
        waiting += get_args(kind)


def test_the_page_names_every_key() -> None:
    page = PAGE.read_text()
    described = tables(page)
    held = {kind.__name__: stored_fields(kind) for kind in kinds()}
    assert described == held
    costs = re.findall(r"^\| `(\w+)` \| ([^|]*?) ?\|", page.partition("| cost |")[2].partition("###")[0], flags=re.M)
    assert dict(costs) == COST_UNITS
    for kind in Record.__subclasses__():
        assert not kind.FILE or f"`{kind.FILE}`" in page or kind.FILE in page, kind
    for document in ("README.md", "CONTRIBUTING.md"):
        assert "docs/run-format.md" in (ROOT / document).read_text(), document


def test_no_other_module_knows_a_files_name_or_key() -> None:
    """Docstrings may speak of files; only strings that code uses count."""
    paths = sorted(path for path in SOURCES.rglob("*.py") if "runs" not in path.parts)
    assert len(paths) > 500
    found = []
    for path in paths:
        nodes = list(ast.walk(ast.parse(path.read_text())))
        documented = {id(node.value) for node in nodes if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)}
        for node in nodes:
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documented:
                name = node.value.rpartition("/")[2]
                if name in NAMES or re.fullmatch(r"scores\..*json", name) or node.value in KEYS:
                    found.append(f"{path.relative_to(SOURCES)}:{node.lineno}: {node.value!r}")
    assert not found


def published() -> Iterator[Run]:
    """Every run of the committed reports."""
    for path in sorted(REPORTS.rglob("scores.json")):
        yield read_run(path.parent)


def test_published_runs_are_read_as_they_are() -> None:
    """Each number of each file, taken from the JSON by hand; what is empty need not be written."""
    count = 0
    for run in published():
        count += 1
        scores, provenance = (json.loads((run.folder / f"{name}.json").read_text()) for name in ("scores", "provenance"))
        for name, score in scores["quality"].items():
            found = run.scores.quality[name]
            assert (found.mean, list(found.per_view)) == (score["mean"], score.get("per_view", []))
            assert found.unit == score.get("unit", "")
        assert run.scores.cost == scores["cost"] and list(run.scores.views) == scores["views"]
        for key in ("truth_sha256", "cell_sha256", "seed", "command", "data", "notes"):
            value = getattr(run.provenance, key)
            assert value == provenance[key] if key in provenance else not value, key
        lines = [json.loads(line) for line in (run.folder / "history.jsonl").read_text().splitlines()]
        assert [(moment.step, moment.psnr, moment.loss) for moment in run.history] == [
            (line["step"], line.get("psnr"), line.get("loss")) for line in lines
        ]
    assert count >= 199


@pytest.mark.parametrize("path", sorted(REPORTS.glob("*/results.csv")), ids=lambda path: path.parent.name)
def test_published_tables_say_what_published_runs_say(path: Path) -> None:
    """Every number of quality of every ``results.csv`` stands in exactly the runs beside it: of a study view by view, of a
    comparison the means."""
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if row["group"] == "quality" and row["status"] == "ok"]
    seen = {}
    for scores in path.parent.rglob("scores.json"):
        run = read_run(scores.parent)
        seen[run.provenance.cell_sha256] = run
    if "view" not in rows[0]:
        means = {(row["method"], row["metric"], float(row["value"])) for row in rows}
        quality = {run.scores.method: run.scores.quality for run in seen.values()}
        held = {(method, name, score.mean) for method, scores in quality.items() for name, score in scores.items()}
        assert means == {entry for entry in held if entry[2] is not None}
        return
    told = sorted((row["metric"], row["view"], float(row["value"])) for row in rows if row["view"])
    held = sorted(
        (name, view, value)
        for run in seen.values()
        for name, score in run.scores.quality.items()
        for view, value in zip(run.scores.views, score.per_view, strict=False)
        if value is not None
    )
    assert told and set(told) == set(held)


def test_packages_beside_the_other_facts_of_a_machine_are_read(tmp_path: Path) -> None:
    """As schema 1 had them."""
    facts = {"python": "3.11.7", "threads": 2, "numpy": "2.4.6", "mitsuba": None}
    (tmp_path / "environment.json").write_text(json.dumps(facts | {"schema": 1}))
    found = Environment.read(tmp_path / "environment.json")
    assert (found.python, found.threads, found.packages) == ("3.11.7", 2, {"numpy": "2.4.6", "mitsuba": None})


def test_published_studies_are_read() -> None:
    paths = sorted(REPORTS.rglob("study.json"))
    assert paths
    for path in paths:
        table, study = json.loads(path.read_text()), StudyRecord.read(path)
        assert [(cell.id, cell.status, cell.levels) for cell in study.cells] == [
            (cell["id"], cell["status"], cell["levels"]) for cell in table["cells"]
        ]
        environment = table["environment"]
        assert study.environment.packages["numpy"] == environment.get("packages", environment)["numpy"]
