"""Parts registered by a script, a notebook or a module: found by recipes, and by processes that import the module."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import invgraphics as ig
from invgraphics import plugins
from invgraphics.cli import main
from invgraphics.core import Scene
from invgraphics.errors import InputError
from invgraphics.plugins import registered
from invgraphics.testing import TwoBalls, toy_scene

PAGE = (Path(__file__).parents[1] / "docs" / "extending.md").read_text()
RECIPE = re.findall(r'"""\n(    summary.*?)"""', PAGE, flags=re.S)[0]
SCRIPT = """
import json

import balls
import invgraphics as ig

done = ig.compare(SCENE, "volumetric/ball:field.radius=0.2", "3steps", out="compared")
fits = [ig.fit("volumetric/ball", SCENE, budget) for budget in ("1steps", "150steps")]
print(json.dumps([len(done.failures), len(done.record.runs), *(fit.scores["psnr"] for fit in fits)]))
"""


@pytest.fixture(autouse=True)
def _forget(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test registers is its own."""
    monkeypatch.setattr(registered, "_REGISTERED", {})
    yield
    registered._import_modules.cache_clear()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return toy_scene(views=4, size=8)


@dataclass(frozen=True)
class BallsConfig:
    """The two balls of the toy scene."""

    def build(self, scene: Scene) -> TwoBalls:
        return TwoBalls()


def test_the_page_s_module_is_fitted_and_compared(toy_folder: Path, tmp_path: Path) -> None:
    """In a process of its own, the comparison's fits in others again."""
    (tmp_path / "balls.py").write_text("\n".join(re.findall(r"^```py\n(.*?)^```", PAGE, flags=re.S | re.M)))
    (tmp_path / "script.py").write_text(SCRIPT.replace("SCENE", repr(str(toy_folder))))
    environment = {key: value for key, value in os.environ.items() if key != plugins.MODULES}
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    failures, runs, first, last = json.loads(done.stdout.splitlines()[-1])
    assert failures == 0 and runs == 1 and last > first + 0.1
    (path,) = (tmp_path / "compared").rglob("seed-0/provenance.json")
    assert json.loads(path.read_text())["plugins"] == {"ball": "module balls", "volumetric/ball": "module balls"}


def test_modules_of_the_environment_are_imported_and_what_lacks_them_says_so(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "balls_here.py").write_text("\n".join(re.findall(r"^```py\n(.*?)^```", PAGE, flags=re.S | re.M)))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(plugins.MODULES, "balls_here")
    run = tmp_path / "run"
    assert main.run(["fit", "volumetric/ball", str(toy_folder), "--budget", "1steps", "--out", str(run)]) == 0
    assert main.run(["list", "fields"]) == 0 and "module balls_here" in capsys.readouterr().out
    environment = plugins.environment()
    assert environment[plugins.MODULES] == "balls_here" and str(tmp_path) in environment["PYTHONPATH"].split(os.pathsep)
    before = plugins.plugin_sources({"field": {"type": "ball"}})
    with (tmp_path / "balls_here.py").open("a") as file:
        file.write("# edited")
    assert plugins.plugin_sources({"field": {"type": "ball"}}) != before and set(before) == {"ball"}
    monkeypatch.setenv(plugins.MODULES, "")
    registered._REGISTERED.clear()
    assert main.run(["evaluate", str(run)]) == main.BAD_INPUT
    said = capsys.readouterr().err
    assert "was made with module balls_here, which provides 'ball', 'volumetric/ball' and is not installed here" in said
    assert "INVGRAPHICS_MODULES=balls_here" in said
    monkeypatch.setenv(plugins.MODULES, "no_such_module")
    assert main.run(["list", "fields"]) == main.BAD_INPUT
    assert "The module 'no_such_module', which $INVGRAPHICS_MODULES names, cannot be imported" in capsys.readouterr().err


def test_a_cell_that_runs_again_replaces_its_part(scene: Scene) -> None:
    table = ig.load_method("volumetric/nerf").table | {"field": {"type": "balls"}, "hooks": []}
    for config in (BallsConfig, dataclass(frozen=True)(type("AgainConfig", (BallsConfig,), {}))):
        assert ig.register("fields", "balls")(config) is config
        assert plugins.load("fields", "balls") is config and plugins.name_of("fields", config) == "balls"
    assert type(ig.load_method(table).recipe.field).__name__ == "AgainConfig"
    assert plugins.origin("fields", "balls") == f"module {__name__}"


def test_names_that_are_taken_and_registries_that_do_not_exist_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"There is no registry 'field'. Did you mean 'fields'\?"):
        ig.register("field", "balls", BallsConfig)
    for registry, name in (("fields", "neural"), ("recipes", "volumetric/nerf")):
        with pytest.raises(InputError, match=f"'{name}' of the {registry} is taken"):
            ig.register(registry, name, BallsConfig)
    ig.register("fields", "balls", BallsConfig)
    with pytest.raises(InputError, match="BallsConfig is registered as 'balls' already"):
        ig.register("fields", "more-balls", BallsConfig)
    monkeypatch.setitem(globals(), "__name__", "another_module")
    with pytest.raises(InputError, match="'balls' of the fields is taken"):
        ig.register("fields", "balls", BallsConfig)


def test_parts_of_a_script_are_refused_where_others_must_import_them(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "__name__", "__main__")
    ig.register("fields", "balls", BallsConfig)
    ig.register(
        "recipes", "volumetric/balls", RECIPE.replace('"ball"', '"balls"').replace('match = "field"', 'match = "field"')
    )
    with pytest.raises(InputError, match="registered in this script or notebook, and each fit has a process of its own"):
        ig.compare(scene, ["volumetric/balls"], "1steps", out=tmp_path / "compared")
    assert plugins.environment() == {}
