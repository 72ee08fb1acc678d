"""Long-format tables of results as CSV and Parquet, in stored units and full precision."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from invgraphics.files import replacing, writing_text
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import METHOD
from invgraphics.report.data.studies import Study
from invgraphics.report.wording import COSTS
from invgraphics.runs.run import Run
from invgraphics.runs.scores import COST_UNITS
from invgraphics.text import slug

Kind = Literal["text", "int", "float", "bool"]

Columns = dict[str, Kind]
"""Name -> type, in order."""

Row = dict[str, Any]
"""Column -> value; what is absent or ``None`` is empty in CSV and null in Parquet."""

COMPARISON_COLUMNS: Columns = {
    "scene": "text",
    "method": "text",
    "seed": "int",
    "status": "text",
    "group": "text",
    "metric": "text",
    "value": "float",
    "unit": "text",
    "higher_is_better": "bool",
    "views": "int",
    "protocol": "text",
    "run": "text",
    "note": "text",
}

STUDY_TAIL: Columns = {
    "seed": "int",
    "view": "text",
    "status": "text",
    "group": "text",
    "metric": "text",
    "value": "float",
    "unit": "text",
    "higher_is_better": "bool",
    "cell": "text",
    "run": "text",
    "note": "text",
}


def write_table(columns: Columns, rows: Sequence[Row], stem: Path) -> None:
    """Write ``stem.csv`` and ``stem.parquet``."""
    import pyarrow as pa
    from pyarrow import parquet

    with writing_text(stem.with_suffix(".csv")) as file:
        writer = csv.DictWriter(file, list(columns), restval="")
        writer.writeheader()
        writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)
    types = {"text": pa.string(), "int": pa.int64(), "float": pa.float64(), "bool": pa.bool_()}
    schema = pa.schema([(name, types[kind]) for name, kind in columns.items()])
    table = pa.Table.from_pylist([{name: row.get(name) for name in columns} for row in rows], schema)
    with replacing(stem.with_suffix(".parquet")) as temporary:
        parquet.write_table(table, temporary)


def write_comparison_table(comparison: Comparison, stem: Path, base: Path | None) -> None:
    """One row per method, seed and metric; runs are named by their path from ``base``, or by method and seed without one.

    ``status`` is ``ok``, ``skipped`` (the note says why), ``failed`` (the note is the error) or ``baseline``.
    """
    rows: list[Row] = []
    for method in comparison.methods:
        for run in comparison.runs_of(method):
            common: Row = {"scene": comparison.scene, "method": run.method, "seed": run.seed, "views": len(run.scores.views)}
            place = f"{slug(run.method)}-seed-{run.seed}" if base is None else relative(run.folder, base)
            common |= {"protocol": run.scores.protocol, "run": place}
            rows += [common | row for row in (*_mean_rows(run), *_skipped_rows(run), *_cost_rows(run))]
        for failure in comparison.failures_of(method):
            row = {"scene": comparison.scene, "method": method, "seed": failure.seed, "status": "failed", "note": failure.error}
            rows.append(row)
    for name, quality in comparison.baselines.items():
        for key, score in quality.items():
            row = {"scene": comparison.scene, "method": name, "status": "baseline", "group": "quality", "metric": key}
            row |= {"value": score.mean, "unit": score.unit, "higher_is_better": score.higher_is_better}
            rows.append(row | {"views": len(score.per_view) or None})
    write_table(COMPARISON_COLUMNS, rows, stem)


def write_study_table(study: Study, stem: Path, base: Path) -> None:
    """One row per cell, metric and test view; ``view`` is empty for what is measured once per run, such as costs.

    Runs are named by their path from ``base``, the study's folder.
    The columns between method and seed are the study's factors. ``status`` is ``ok``, ``skipped``, ``failed`` or ``missing``.
    """
    paths = [factor.path for factor in study.factors if factor.path != METHOD]
    columns: Columns = {"scene": "text", "method": "text", **dict.fromkeys(paths, "text"), **STUDY_TAIL}
    rows: list[Row] = []
    for cell in study.cells:
        common: Row = {"scene": cell.scene, "method": cell.method, "seed": cell.seed, "cell": cell.id}
        common |= {path: cell.levels.get(path) for path in paths}
        if cell.run is None:
            rows.append(common | {"status": cell.status, "note": cell.error})
            continue
        common["run"] = relative(cell.run.folder, base)
        rows += [common | row for row in (*_view_rows(cell.run), *_skipped_rows(cell.run), *_cost_rows(cell.run))]
    write_table(columns, rows, stem)


def _mean_rows(run: Run) -> list[Row]:
    return [_quality_row(key, run) | {"value": score.mean} for key, score in run.scores.quality.items()]


def _view_rows(run: Run) -> list[Row]:
    rows = []
    for key, score in run.scores.quality.items():
        row = _quality_row(key, run)
        if score.per_view:
            rows += [row | {"view": view, "value": value} for view, value in zip(run.scores.views, score.per_view, strict=True)]
        else:
            rows.append(row | {"value": score.mean})
    return rows


def _quality_row(key: str, run: Run) -> Row:
    score = run.scores.quality[key]
    row = {"status": "ok", "group": "quality", "metric": key, "unit": score.unit}
    return row | {"higher_is_better": score.higher_is_better}


def _skipped_rows(run: Run) -> list[Row]:
    return [{"status": "skipped", "group": "quality", "metric": key, "note": why} for key, why in run.scores.skipped.items()]


def _cost_rows(run: Run) -> list[Row]:
    directions = {cost.key: cost.better for cost in COSTS}
    rows = []
    for key, value in run.scores.cost.items():
        better = directions.get(key, "none")
        row = {"status": "ok", "group": "cost", "metric": key, "value": value, "unit": COST_UNITS.get(key, "")}
        rows.append(row | {"higher_is_better": None if better == "none" else better == "higher"})
    return rows


def relative(path: Path, folder: Path) -> str:
    """``path`` as seen from ``folder``."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _plain(value: Any) -> str:
    """Format a value for CSV: whole floats without a point, others with the digits of an exact round trip."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return str(int(value)) if math.isfinite(value) and value == int(value) and abs(value) < 2**53 else repr(value)
    return str(value)
