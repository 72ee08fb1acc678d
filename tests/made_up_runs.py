"""Run records made up for tests: raw tables as files hold them, and records in memory."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from invgraphics.runs.environment import Environment
from invgraphics.runs.provenance import Options, Provenance
from invgraphics.runs.run import Run
from invgraphics.runs.scores import Score, Scores


def provenance_table(**given: Any) -> dict[str, Any]:
    """The content of a ``provenance.json`` with ``given`` laid over it."""
    table = {
        "schema": 1,
        "cell_sha256": "ce11",
        "method": "volumetric/hash",
        "preset": "laptop",
        "recipe_sha256": "4ec1",
        "scene": "balls",
        "seed": 0,
        "budget": "60s",
        "truth_sha256": "c0ffee",
        "train_sha256": "7ea",
        "cameras_sha256": "ca3e4a",
        "truth": "../../truth",
        "background": [1.0, 1.0, 1.0],
        "colour": "srgb",
        "data": {},
        "notes": {},
        "code_version": "0.1.0+abc",
        "command": "invgraphics fit volumetric/hash balls --out runs/x",
        "options": {"size": None, "test_views": 16},
        "device": "cpu",
    }
    return table | given


def made_up_provenance(**given: Any) -> Provenance:
    """The same as a record."""
    table = provenance_table() | {"options": Options(), "background": (1.0, 1.0, 1.0)} | given
    return Provenance(**{key: value for key, value in table.items() if key != "schema"})


@functools.cache
def _provenance_of(truth: str) -> Provenance:
    """Kept: simulations make thousands of runs."""
    return made_up_provenance(truth_sha256=truth)


def made_up_run(quality: dict[str, Score], method: str = "m", seed: int = 0, truth: str = "t", **scores: Any) -> Run:
    """A run that lies nowhere; ``scores`` are further fields of its scores."""
    given = {"views": (), "cost": {}} | scores
    record = Scores(method=method, seed=seed, quality=quality, **given)
    return Run(Path(), method, seed, record, _provenance_of(truth), Environment(), ())
