"""A field and a renderer from a third-party package, found by entry points: they take part without an edit to ours."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from invgraphics import plugins
from invgraphics.cli import main
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT

MODULE = '''
from dataclasses import dataclass, field, replace
from typing import Annotated, Any
import torch
from torch import nn
from invgraphics.config import Slot
from invgraphics.core import Field, FieldValues, Quantity, RayRenderer
from invgraphics.renderers.quadrature import integrate
from invgraphics.renderers.samplers import StratifiedConfig

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

@dataclass(frozen=True)
class ExposedConfig:
    """Volume rendering with an exposure that is learnt."""
    title = "exposed volume rendering"
    sampler: Annotated[Any, Slot("samplers")] = field(default_factory=StratifiedConfig)
    def build(self, scene):
        return Exposed(self.sampler.build(scene))

class Exposed(RayRenderer):
    requires = Quantity.DENSITY | Quantity.RADIANCE
    def __init__(self, sampler):
        super().__init__()
        self.sampler = sampler
        self.log_exposure = nn.Parameter(torch.zeros(()))
    def render_rays(self, field, rays, ctx):
        samples, levels = self.sampler.sample(ctx.bounds.clip(rays), field, ctx)
        values = field.query(samples, self.requires)
        values = replace(values, radiance=values.radiance * self.log_exposure.exp())
        return integrate(rays, samples, values, values.density * samples.delta, levels)
    def untrained(self):
        return Exposed(self.sampler.untrained())

RECIPE = """
summary = "Even fog of a third party"
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

EXPOSED = RECIPE.replace("volumetric", "exposed").replace("Even fog", "Exposed fog") + """
[optimiser.groups.exposure]
match = "renderer"
lr = 0.05
"""
'''
ENTRY_POINTS = (
    "[invgraphics.fields]\nfog = third_party_fog:FogConfig\n\n"
    "[invgraphics.renderers]\nexposed = third_party_fog:ExposedConfig\n\n"
    "[invgraphics.recipes]\nvolumetric/fog = third_party_fog:RECIPE\nexposed/fog = third_party_fog:EXPOSED\n"
)


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A process environment in which the third-party package is installed."""
    info = tmp_path_factory.mktemp("site") / "third_party_fog-1.0.dist-info"
    info.mkdir()
    (info.parent / "third_party_fog.py").write_text(MODULE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party-fog\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    paths = [str(info.parent), str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "200"}


COMMANDS = """
import json, sys
from training_fixtures import InProcess
from invgraphics.cli.main import run
from invgraphics.experiments import compare
compare.LocalExecutor, InProcess.made, InProcess.fails = InProcess, [], lambda request: ""
for words in json.loads(sys.argv[1]):
    assert run(words) == 0, words
    print("\\f")
"""


@dataclass(frozen=True)
class Commands:
    """What commands printed in a process that has the third-party package, and the folders that they wrote."""

    listed: str
    compared: str
    explained: tuple[str, ...]
    report: Path
    ours: Path
    theirs: Path
    shown: Path
    lone: Path


@pytest.fixture(scope="module")
def commands(environment: dict[str, str], toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Commands:
    """All commands in one process, comparisons' fits too: starting one takes longer than they do."""
    out = tmp_path_factory.mktemp("commands") / "report"
    methods = "volumetric/fog,exposed/fog"
    words = ["--budget", "20steps", "--out", str(out), "--methods", methods, "--render-with", "exposed/fog"]
    ours, theirs = (out / "runs" / name / "seed-0" for name in ("volumetric-fog", "exposed-fog"))
    shown, lone = ours / "rendered" / "exposed-fog", out.with_name("lone")
    commands = [
        ["list", "matrix", "renderers", "fields", "methods"],
        ["compare", str(toy_folder), *words],
        *(["explain", str(run), "--view", "0", "--pixel", "12,12"] for run in (theirs, shown)),
        ["fit", "volumetric/fog", str(toy_folder), "--budget", "2steps", "--out", str(lone)],
    ]
    command = [sys.executable, "-c", COMMANDS, json.dumps(commands)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    listed, compared, *explained, _, _ = done.stdout.split("\f")
    return Commands(listed, compared, tuple(explained), out, ours, theirs, shown, lone)


def test_a_field_and_a_renderer_with_state_take_part(commands: Commands) -> None:
    """Listed, fitted, compared with ours, shown beside it for a field that ours fitted, reported and explained."""
    ours, theirs, shown = commands.ours, commands.theirs, commands.shown
    listed = commands.listed
    assert "| exposed volume rendering |" in listed and "third_party_fog:ExposedConfig" in listed
    assert "third_party_fog:FogConfig" in listed and "third-party-fog" in listed and "volumetric/fog" in listed
    assert "exposed/fog" in commands.compared
    page = (commands.report / "index.html").read_text()
    assert "Even fog of a third party" in page and "Exposed fog of a third party" in page
    assert [json.loads((run / "scores.json").read_text())["cost"]["parameters"] for run in (ours, theirs)] == [4, 5]
    state = checkpoint.load(theirs / CHECKPOINT)
    assert abs(float(state["renderer"]["log_exposure"])) > 0.01, "the renderer has learnt nothing"
    # An exposure of 1 stands in, under which our renderer's field looks as it did.
    assert json.loads((shown / "scores.json").read_text())["method"] == "volumetric/fog rendered with exposed/fog"
    with np.load(ours / "test" / "0000.npz") as own, np.load(shown / "test" / "0000.npz") as other:
        np.testing.assert_allclose(own["rgb"], other["rgb"], atol=1e-3)
    assert len(commands.explained) == 2 and all("8 samples" in text for text in commands.explained)
    for run in (theirs, shown):
        pixel = json.loads((run / "explained" / "test-0000-12-12" / "ray.json").read_text())["pixel"]
        assert pixel["composited"] == pytest.approx(pixel["rendered"], abs=1e-5)


def test_a_run_whose_package_is_gone_names_it(commands: Commands, capsys: pytest.CaptureFixture[str]) -> None:
    plugins = {"fog": "third-party-fog 1.0", "volumetric/fog": "third-party-fog 1.0"}
    assert json.loads((commands.lone / "provenance.json").read_text())["plugins"] == plugins
    # Only that process had the package.
    assert main.run(["evaluate", str(commands.lone)]) == main.BAD_INPUT
    said = capsys.readouterr().err
    assert "was made with third-party-fog 1.0, which provides 'fog', 'volumetric/fog' and is not installed here" in said


def test_a_package_that_fails_to_import_is_named(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "third_party_fog.py").write_text("import a_module_that_is_not_there\n")
    environment = environment | {"PYTHONPATH": os.pathsep.join([str(tmp_path), environment["PYTHONPATH"]])}
    command = [sys.executable, "-m", "invgraphics", "fit", "volumetric/fog", "bricks", "--out", str(tmp_path / "run")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "third-party-fog" in done.stderr and "a_module_that_is_not_there" in done.stderr
    assert "Traceback" not in done.stderr


def test_its_code_is_part_of_a_runs_identity_and_named_where_it_fails(
    environment: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Edited, or in another version, it makes other runs; an exception in it is no fault of ours."""
    site = Path(shutil.copytree(environment["PYTHONPATH"].split(os.pathsep)[0], tmp_path / "site"))
    monkeypatch.syspath_prepend(str(site))
    table = {"field": {"type": "fog"}, "renderer": {"type": "volumetric"}}
    before = plugins.plugin_sources(table, "volumetric/fog")
    assert set(before) == {"fog", "volumetric/fog"} and before == plugins.plugin_sources(table, "volumetric/fog")
    assert plugins.plugin_sources({"field": {"type": "neural"}}, "volumetric/hash") == {}
    with (site / "third_party_fog.py").open("a") as file:
        file.write("\n# faster\n")
    assert plugins.plugin_sources(table, "volumetric/fog")["fog"] != before["fog"]
    fog = plugins.load("fields", "fog")(0.5).build(None)
    monkeypatch.delitem(sys.modules, "third_party_fog")
    with pytest.raises(TypeError) as caught:
        fog.query(None, None)
    assert plugins.raised_in(caught.value) == "third_party_fog.Fog.query (third-party-fog 1.0)"
    assert main.explain(caught.value)[1][1].startswith("It was raised in third_party_fog.Fog.query (third-party-fog 1.0)")
    with pytest.raises(ZeroDivisionError) as own:
        raise ZeroDivisionError
    assert main.explain(own.value)[1][1].startswith("This is a fault of invgraphics")
