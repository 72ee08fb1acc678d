"""Mistakes of third-party parts: each is refused by name, with what was expected, before anything is fitted or scored."""

import sys
from pathlib import Path
from typing import Any

import pytest

import invgraphics as ig
from invgraphics import plugins
from invgraphics.cli import main
from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.scenes.npz_writer import save_npz
from invgraphics.scenes.open import SceneOptions, find_loader, open_scene
from invgraphics.testing import toy_scene

MODULE = '''
from dataclasses import dataclass, replace
from pathlib import Path
import torch
from torch import nn
from invgraphics.core import Field, FieldValues, Quantity, RayRenderer, Rendering, Trace
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.testing import toy_scene

class Fog(Field):
    provides = Quantity.DENSITY | Quantity.RADIANCE
    def __init__(self, mistake):
        super().__init__()
        self.mistake = mistake
        self.level = nn.Parameter(torch.tensor(0.5))
    def query(self, samples, want):
        m = len(samples)
        density, radiance = self.level.expand(m), self.level.expand(m, 3)
        if self.mistake == "tuple":
            return density, radiance
        if self.mistake == "negative":
            density = density - 0.75
        if self.mistake == "whole":
            density = density.long()
        if self.mistake == "missing":
            radiance = None
        return FieldValues(density=density, radiance=radiance)

class Silent(Fog):
    provides = None

@dataclass(frozen=True)
class FogConfig:
    """Fog with a mistake."""
    mistake: str = ""
    def build(self, scene):
        return Silent("") if self.mistake == "silent" else Fog(self.mistake)

@dataclass(frozen=True)
class UnbuiltConfig:
    """Settings alone."""

class Mistaken(RayRenderer):
    requires = Quantity.DENSITY | Quantity.RADIANCE
    def __init__(self, mistake, scene):
        super().__init__()
        self.mistake, self.right = mistake, VolumetricConfig(StratifiedConfig(8)).build(scene)
    def render_rays(self, field, rays, ctx):
        rendering, trace = self.right.render_rays(field, rays, ctx)
        if self.mistake == "lone":
            return rendering
        if self.mistake == "swapped":
            return trace, rendering
        if self.mistake == "opaque":
            return replace(rendering, alpha=rendering.alpha + 1), trace
        return replace(rendering, rgb=rendering.rgb.mean(dim=1)), trace

@dataclass(frozen=True)
class MistakenConfig:
    """Volume rendering with a mistake."""
    title = "mistaken"
    mistake: str = "lone"
    def build(self, scene):
        return Mistaken(self.mistake, scene)

@dataclass(frozen=True)
class RowsPenalty:
    """One number for each of three rows."""
    def __call__(self, field, renderer, ctx):
        return field.level.expand(3)

class Nothing:
    def matches(self, path):
        return path.name == "nothing.scene"
    def load(self, path, options):
        return None

class AsItIs:
    """Observes no option."""
    def matches(self, path):
        return path.name == "large.scene"
    def load(self, path, options):
        return toy_scene(views=12, size=16)

class Careless:
    def matches(self, path):
        return "magic" in path.read_text()
    def load(self, path, options):
        raise NotImplementedError
'''
ENTRY_POINTS = """
[invgraphics.fields]
mistaken_fog = mistaken_parts:FogConfig
mistaken_twin = mistaken_parts:FogConfig
mistaken_unbuilt = mistaken_parts:UnbuiltConfig
[invgraphics.renderers]
mistaken = mistaken_parts:MistakenConfig
[invgraphics.penalties]
mistaken_rows = mistaken_parts:RowsPenalty
[invgraphics.scenes]
careless = mistaken_parts:Careless
mistaken_nothing = mistaken_parts:Nothing
mistaken_size = mistaken_parts:AsItIs
[invgraphics.feilds]
lost = mistaken_parts:FogConfig
"""
RECIPE: dict[str, Any] = {
    "summary": "Fog",
    "paper": "none",
    "field": {"type": "mistaken_fog"},
    "renderer": {"type": "volumetric", "sampler": {"type": "stratified", "count": 8}},
    "losses": [{"type": "photometric"}],
    "batches": {"rays": 16},
    "optimiser": {"groups": {"all": {"match": "field", "lr": 0.01}}},
}


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package, for one test."""
    info = tmp_path / "site" / "mistaken_parts-2.0.dist-info"
    info.mkdir(parents=True)
    (info.parent / "mistaken_parts.py").write_text(MODULE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mistaken-parts\nVersion: 2.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(info.parent)
    monkeypatch.delitem(sys.modules, "mistaken_parts", raising=False)
    plugins.leave_out.cache_clear()


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Two balls."""
    return toy_scene(views=4, size=8)


def field(mistake: str) -> dict[str, Any]:
    """The recipe's field with a mistake."""
    return {"field": {"type": "mistaken_fog", "mistake": mistake}}


def renderer(mistake: str) -> dict[str, Any]:
    """A renderer with a mistake."""
    return {"renderer": {"type": "mistaken", "mistake": mistake}}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (field("tuple"), r"Fog.query returned tuple, no FieldValues"),
        (field("whole"), r"Fog.query returned density of type torch.int64, no floating-point numbers"),
        (field("missing"), r"Fog.query returned no radiance, which it was asked for"),
        (field("negative"), r"128 of 128 densities of Fog are negative, down to -0.25"),
        (field("silent"), r"Silent declares no quantities as 'provides'"),
        ({"field": {"type": "mistaken_unbuilt"}}, r"'mistaken_unbuilt' of the fields, UnbuiltConfig, has no method 'build'"),
        (renderer("lone"), r"Mistaken returned Rendering.\nExpected: a Rendering and its Trace, as a tuple"),
        (renderer("swapped"), r"Mistaken returned \(Trace, Rendering\)"),
        (renderer("opaque"), r"Mistaken returned opacities from 1\.\d+ to 1\.\d+.\nExpected: 'alpha' in \[0, 1\]"),
        (renderer("grey"), r"Mistaken returned 'rgb' of shape \(16,\) for pixels \(16,\).\nExpected: \(16, 3\)"),
        (
            {"penalties": [{"type": "mistaken_rows"}]},
            r"The penalty mistaken_parts.RowsPenalty returned a tensor of shape \(3,\)",
        ),
    ],
)
def test_a_part_that_returns_what_it_must_not_is_named(change: dict[str, Any], words: str, scene: Scene) -> None:
    ig.fit(RECIPE, scene, budget="1steps")
    with pytest.raises(InputError, match=words):
        ig.fit(RECIPE | change, scene, budget="1steps")


def test_a_second_name_of_a_class_is_left_out_so_that_its_runs_can_be_read(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "mistaken_twin" not in plugins.names("fields") and "lost" not in plugins.names("fields")
    ig.fit(RECIPE, scene, budget="1steps", out=tmp_path / "run")
    assert ig.load_run(tmp_path / "run").method.table["field"]["type"] == "mistaken_fog"
    lines = capsys.readouterr().err.splitlines()
    twin = "'mistaken_twin' of the fields (mistaken_parts:FogConfig, mistaken-parts): 'mistaken_fog' is the same."
    lost = "'lost' of the feilds (mistaken_parts:FogConfig, mistaken-parts): there is no group 'invgraphics.feilds'."
    assert f"Left out: {twin}" in lines and f"Left out: {lost} Did you mean 'fields'?" in lines


def test_loaders_that_return_no_scene_or_another_size_are_named(tmp_path: Path) -> None:
    nothing, large = tmp_path / "nothing.scene", tmp_path / "large.scene"
    nothing.write_text("a")
    large.write_text("a")
    with pytest.raises(InputError, match=r"mistaken_parts.Nothing.load returned NoneType, no Scene"):
        open_scene(str(nothing))
    with pytest.raises(InputError, match=r"AsItIs.load returned pictures of 16x16 pixels, though --size asks for 8"):
        open_scene(str(large), SceneOptions(8))
    whole = open_scene(str(large), SceneOptions(16, test_views=None))
    assert [view.name for view in open_scene(str(large), SceneOptions((16, 16), test_views=1)).test] == [
        whole.test[len(whole.test) // 2].name
    ]


def test_a_loader_that_fails_to_tell_its_format_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="is an empty folder"):
        find_loader(tmp_path / "empty")  # which cannot be read as text
    said = capsys.readouterr().err
    assert "Left out: 'careless' of the scenes (mistaken-parts) cannot tell whether it knows" in said and "IsADirectory" in said


def test_a_fault_may_be_of_an_imported_plug_in(scene: Scene) -> None:
    ours = "This is a fault of invgraphics, not of your input; --debug shows where it happened."
    assert main.explain(KeyError("x"))[1][1] == ours
    ig.fit(RECIPE, scene, budget="1steps")
    assert main.explain(KeyError("x"))[1][1] == ours.replace("invgraphics,", "invgraphics or mistaken-parts 2.0,")


def test_a_scene_of_python_keeps_its_name(tmp_path: Path, scene: Scene) -> None:
    path = tmp_path / "scene.npz"
    save_npz(scene, path)
    assert open_scene(str(path)).name == scene.name != "scene"
