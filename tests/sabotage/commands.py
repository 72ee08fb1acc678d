"""Commands that are sabotaged: their words, how they are finished afterwards, and what must then be the same."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from processes import Running
from training_fixtures import SMALL, write_blender

from invgraphics.scenes.mitsuba.cache import VARIABLE
from invgraphics.testing import toy_scene

SPLATS = "splatting/gaussians"
CLOCKS = {
    "seconds",
    "cost",
    "load_average",
    "memory_forecast_bytes",
    "wall_seconds",
    "forecast_seconds",
    "disturbed",
    "environment",
}
"""Keys of JSON files that hold times, what follows from them, or the state of the machine."""
ASIDE = re.compile(r"(^|/)(jobs/|environment\.json$|\.import/)|lock$")
"""Logs, the machine's description and unfinished work: no results."""


@dataclass(frozen=True)
class Case:
    """A command.

    Attributes:
        name: of the command.
        words: its arguments, given the folder to write.
        results: patterns of files that are the same whenever it is done again, besides others that turn out to be.
        finish: what to add to the words so that it goes on with what is there.
        quick: whether it is part of the test suite's handful.
    """

    name: str
    words: Callable[[Path], list[str]]
    results: tuple[str, ...]
    finish: Callable[[Path], list[str]] = lambda out: []
    quick: bool = False

    def start(self, place: Path, finish: bool = False, log: str = "log", before: str = "") -> Running:
        """Start the command in ``place``, or go on with it."""
        out = place / "out"
        words = self.words(out) + (self.finish(out) if finish else [])
        return Running(words, place / log, before, {VARIABLE: str(place / "cache")})


def made(folder: Path) -> list[Case]:
    """The cases, on a scene, a run and photographs that are made in ``folder``."""
    scene = write_blender(toy_scene(), folder / "toy")
    settings = [word for item in SMALL[SPLATS] for word in ("--set", item)]
    fit = ["fit", SPLATS, str(scene), "--budget", "20steps", "--checkpoint-every", "1steps", "--snapshots", "3", *settings]
    fit += ["--kernels", "reference"]
    run = folder / "run"
    assert Running([*fit, "--out", str(run)], folder / "log").wait() == 0
    methods = f"{SPLATS},{SPLATS}:batches.views=31"
    compare = ["compare", str(scene), "--methods", methods, "--budget", "10steps", "--kernels", "reference", *settings]
    return [
        Case(
            "fit",
            lambda out: [*fit, "--out", str(out)],
            ("checkpoint.safetensors", "scores.json", "history.jsonl", "test/*.npz", "test/*.png", "snapshots/*", "truth/*/*"),
            lambda out: ["--resume"] if (out / "provenance.json").is_file() else [],
            quick=True,
        ),
        Case(
            "report",
            lambda out: ["report", str(run), "--out", str(out)],
            ("results.csv", "index.md", "index.html", "table.tex"),
            quick=True,
        ),
        Case(
            "compare",
            lambda out: [*compare, "--checkpoint-every", "1steps", "--out", str(out)],
            ("runs/*/*/checkpoint.safetensors", "runs/*/*/scores.json", "runs/*/*/test/*", "truth/*/*", "compare.json"),
        ),
        Case(
            "ablate",
            lambda out: ["ablate", str(_study(folder, scene)), "--out", str(out), "--checkpoint-every", "1steps"],
            ("runs/*/checkpoint.safetensors", "runs/*/scores.json", "runs/*/test/*", "truth/*/*", "study.json"),
        ),
        Case("make-scene", lambda out: ["make-scene", str(_scene(folder)), "--out", str(out)], ("*", "*/*")),
        Case(
            "import-photos",
            lambda out: ["import-photos", str(_photos(folder)), "--lens", "pinhole", "--out", str(out)],
            ("images/*", "sparse/*/*"),
        ),
    ]


def _study(folder: Path, scene: Path) -> Path:
    path = folder / "trial.toml"
    if not path.is_file():
        base = [f"{key} = {value}" for key, _, value in (item.partition("=") for item in SMALL[SPLATS])]
        lines = ['question = "Why?"', f'scenes = ["{scene}"]', f'methods = ["{SPLATS}"]', 'budget = "20steps"', "[factors]"]
        path.write_text("\n".join([*lines, '"data.train_views" = [4, 8]', "[base]", *base]))
    return path


def _scene(folder: Path) -> Path:
    path = folder / "scene.toml"
    lines = ['name = "tiny"', 'builder = "materials"', 'summary = "Small."', 'stresses = "Nothing."', "depth = 3"]
    lines += ["lo = [-1.05, -1.05, -0.8]", "hi = [1.05, 1.05, 0.7]", "size = [40, 32]"]
    lines += ['rig = { kind = "hemisphere", radius = 3.5, fov = 38.0 }', "views = { train = 6, val = 1, test = 2 }"]
    path.write_text("\n".join([*lines, "samples = { train = 16, val = 2, test = 32 }"]))
    return path


def _photos(folder: Path) -> Path:
    from photo_box import Box, orbit, shoot

    path = folder / "box" / "images"
    return path if path.is_dir() else shoot(folder / "box", Box(repeated=False), orbit(8, 160, arc=70))


def results(place: Path) -> dict[str, str]:
    """File below ``place``/out -> hash of its content, without times and the place's own name."""
    out = place / "out"
    files = (path for path in sorted(out.rglob("*")) if path.is_file() and not ASIDE.search(path.relative_to(out).as_posix()))
    return {path.relative_to(out).as_posix(): _hash(path, place) for path in files}


def _hash(path: Path, place: Path) -> str:
    content = path.read_bytes().replace(str(place).encode(), b"PLACE")
    if path.suffix == ".json":
        content = json.dumps(_timeless(json.loads(content))).encode()
    elif path.suffix == ".jsonl":
        content = json.dumps([_timeless(json.loads(line)) for line in content.splitlines()]).encode()
    return hashlib.sha256(content).hexdigest()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(item) for key, item in value.items() if key not in CLOCKS}
    return [_timeless(item) for item in value] if isinstance(value, list) else value
