"""A field from a stranger's package, found by its entry point: listed, compared, reported, without an edit to ours."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

MODULE = '''
from dataclasses import dataclass
import torch
from torch import nn
from invgraphics.core import Field, FieldValues, Quantity

@dataclass(frozen=True)
class FogConfig:
    """An even fog of one colour in the box."""
    density: float = 0.5
    def build(self, scene):
        return Fog(self.density)

class Fog(Field):
    provides = Quantity.DENSITY | Quantity.RADIANCE
    def __init__(self, density):
        super().__init__()
        self.log_density = nn.Parameter(torch.tensor(density).log())
        self.logits = nn.Parameter(torch.zeros(3))
    def query(self, samples, want):
        m = len(samples)
        return FieldValues(density=self.log_density.exp().expand(m), radiance=self.logits.sigmoid().expand(m, 3))

RECIPE = """
summary = "Even fog from a stranger"
paper = "none"
[field]
type = "fog"
[renderer]
type = "volumetric"
[renderer.sampler]
type = "stratified"
count = 8
[[losses]]
type = "photometric"
[batches]
rays = 64
[optimiser.groups.all]
match = "field"
lr = 0.05
"""
'''
ENTRY_POINTS = (
    "[invgraphics.fields]\nfog = stranger_fog:FogConfig\n\n[invgraphics.recipes]\nvolumetric/fog = stranger_fog:RECIPE\n"
)


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """A process environment in which the stranger's package is installed."""
    info = tmp_path / "site" / "stranger_fog-1.0.dist-info"
    info.mkdir(parents=True)
    (info.parent / "stranger_fog.py").write_text(MODULE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger-fog\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    return os.environ | {"PYTHONPATH": str(info.parent), "COLUMNS": "200"}


def _invgraphics(environment: dict[str, str], *arguments: str) -> str:
    command = [sys.executable, "-m", "invgraphics", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_strangers_field_takes_part(environment: dict[str, str], toy_folder: Path, tmp_path: Path) -> None:
    listed = _invgraphics(environment, "list", "fields", "methods")
    assert "stranger_fog:FogConfig" in listed and "stranger-fog" in listed and "volumetric/fog" in listed
    out = tmp_path / "report"
    shown = _invgraphics(
        environment, "compare", str(toy_folder), "--methods", "volumetric/fog", "--budget", "20steps", "--out", str(out)
    )
    assert "volumetric/fog" in shown
    scores = json.loads((out / "runs" / "volumetric-fog" / "seed-0" / "scores.json").read_text())
    assert scores["cost"]["parameters"] == 4
    page = (out / "index.html").read_text()
    assert "volumetric/fog" in page and "Even fog from a stranger" in page


def test_a_run_whose_package_is_gone_names_it(environment: dict[str, str], toy_folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    _invgraphics(environment, "fit", "volumetric/fog", str(toy_folder), "--budget", "2steps", "--out", str(run))
    brought = {"fog": "stranger-fog 1.0", "volumetric/fog": "stranger-fog 1.0"}
    assert json.loads((run / "provenance.json").read_text())["plugins"] == brought
    shutil.rmtree(tmp_path / "site")
    command = [sys.executable, "-m", "invgraphics", "evaluate", str(run)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "was made with stranger-fog 1.0, which brings 'fog', 'volumetric/fog' and is not installed here" in done.stderr


def test_a_stranger_that_fails_to_import_is_named(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "site" / "stranger_fog.py").write_text("import a_module_that_is_not_there\n")
    command = [sys.executable, "-m", "invgraphics", "fit", "volumetric/fog", "bricks", "--out", str(tmp_path / "run")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "stranger-fog" in done.stderr and "a_module_that_is_not_there" in done.stderr
    assert "Traceback" not in done.stderr
