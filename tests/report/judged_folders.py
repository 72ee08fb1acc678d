"""Made-up study folders that are judged: records of runs without pictures, each number chosen."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from made_up_runs import provenance_table

MARKS = (0.0, 0.01, 0.02, 0.04, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
SECONDS = {"60s": 60.0, "5min": 300.0, "20min": 1200.0}


def rising(end: float, budget: float) -> list[dict[str, Any]]:
    """Lines of a history whose PSNR rises to ``end`` dB."""
    lines = []
    for index, share in enumerate(MARKS):
        psnr = 8 + (end - 8) * (1 - math.exp(-4 * share)) / (1 - math.exp(-4))
        lines.append({"step": 10 * index, "seconds": share * budget, "progress": share, "psnr": psnr, "loss": 0.1})
    return lines


def entry(method: str, scene: str, size: int, budget: str, **other: Any) -> dict[str, Any]:
    """A cell of ``study.json`` that is done, in a little more than its budget."""
    label = f"{method} {scene.rpartition('/')[2]}@{size} {budget} seed=0"
    name = hashlib.sha256(label.encode()).hexdigest()[:12]
    cell = {"id": name, "label": label, "scene": scene, "method": method, "seed": 0, "levels": {"budget": budget, "size": size}}
    cell |= {"size": size, "budget": f"{SECONDS[budget]:g} s", "budget_seconds": SECONDS[budget], "budget_steps": None}
    cell |= {"run": f"runs/{name}", "status": "done", "error": None}
    return cell | {"seconds": SECONDS[budget] + 12, "forecast_seconds": SECONDS[budget] + 10} | other


def write_judged(root: Path, cells: Sequence[dict[str, Any]], known: Sequence[dict[str, Any]] = ()) -> Path:
    """``study.json`` and the records of all cells that are done.

    A cell may carry ``psnr`` (per view, dB), ``history`` (lines), and ``scores`` and ``provenance`` (laid over the files).
    """
    entries = []
    for cell in cells:
        made = {key: cell[key] for key in ("psnr", "history", "scores", "provenance") if key in cell}
        entries.append({key: value for key, value in cell.items() if key not in made})
        if cell["status"] == "done":
            _write_run(root / cell["run"], cell, **made)
    table = {"schema": 1, "name": "trial", "question": "Does every method hold on every scene?", "design": "list"}
    table |= {"report": "verdicts", "known": list(known), "factors": {}, "base": {}, "seeds": [0], "cells": entries}
    table |= {key: list(dict.fromkeys(cell[key[:-1]] for cell in cells)) for key in ("scenes", "methods")}
    table |= {"protocol": {"name": "default", "summary": "8-bit pictures"}, "command": "invgraphics ablate trial --out out"}
    table |= {"environment": {"cpu": "A test machine", "threads": 2, "date": "2025-11-21"}}
    root.mkdir(parents=True, exist_ok=True)
    (root / "study.json").write_text(json.dumps(table))
    return root


def _write_run(
    run: Path,
    cell: dict[str, Any],
    psnr: Sequence[float] = (24.0, 25.0, 26.0),
    history: Sequence[dict[str, Any]] | None = None,
    scores: dict[str, Any] | None = None,
    provenance: dict[str, Any] | None = None,
) -> None:
    run.mkdir(parents=True)
    score = {"mean": sum(psnr) / len(psnr), "unit": "dB", "higher_is_better": True, "per_view": list(psnr)}
    splats = cell["method"].startswith("splatting")
    cost = {"fit_seconds": SECONDS["60s"], "steps": 500, "peak_memory_bytes": 3e8, "primitives": 40000 if splats else None}
    table = {"schema": 1, "method": cell["method"], "preset": "laptop", "scene": cell["scene"], "seed": 0}
    table |= {"protocol": "default", "views": [f"{view:04d}" for view in range(len(psnr))], "skipped": {}}
    table |= {"quality": {"psnr": score}, "cost": cost | ({"dead": 0.002} if splats else {})} | (scores or {})
    (run / "scores.json").write_text(json.dumps(table))
    record = provenance_table(code_version="0.1.0+abc123def456", memory_forecast_bytes=4e8) | (provenance or {})
    (run / "provenance.json").write_text(json.dumps(record))
    (run / "environment.json").write_text("{}")
    (run / "recipe.toml").write_text("")
    budget = cell["budget_seconds"]
    lines = rising(sum(psnr) / len(psnr), budget) if history is None else history
    (run / "history.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
