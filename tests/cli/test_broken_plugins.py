"""Third-party parts that cannot be imported: what does not use them works, and what does names package and error."""

from pathlib import Path

import pytest

from invgraphics import plugins
from invgraphics.cli import main
from invgraphics.errors import InputError
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.plugins.registries import own
from invgraphics.recipes.recipe import expand, load_method, source
from invgraphics.scenes.open import find_loader

GOOD = """
PARTIAL = 'summary = "No field"'
LISTED = '''
summary = "Its own"
[field]
type = "broken"
[renderer]
type = "volumetric"
[presets.laptop]
chosen_on = 5
'''
NO_TOML = "summary ="
"""
ENTRY_POINTS = """
[invgraphics.recipes]
volumetric/broken = broken_parts:RECIPE
volumetric/absent = fine_parts:ABSENT
volumetric/no-toml = fine_parts:NO_TOML
volumetric/partial = fine_parts:PARTIAL
volumetric/listed = fine_parts:LISTED
[invgraphics.fields]
broken = broken_parts:Field
[invgraphics.scenes]
broken = broken_parts:Loader
"""
TAKEN_NAMES = """
[invgraphics.fields]
gaussians = fine_parts:Gaussians
[invgraphics.recipes]
volumetric/nerf = fine_parts:NERF
"""
RAISED = {
    "value": ("raise ValueError('needs\\na GPU.')", "ValueError: needs a GPU."),
    "import": ("import a_module_that_is_not_there", "ModuleNotFoundError: No module named 'a_module_that_is_not_there'."),
    "exit": ("import sys; sys.exit('no licence')", "SystemExit: no licence."),
}


@pytest.fixture(params=RAISED)
def said(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A package whose modules fail, installed for one test; returns what its error says."""
    info = tmp_path / "site" / "third_party_broken-1.0.dist-info"
    info.mkdir(parents=True)
    code, words = RAISED[request.param]
    (info.parent / "broken_parts.py").write_text(code)
    (info.parent / "fine_parts.py").write_text(GOOD)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party-broken\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(info.parent)
    plugins.leave_out.cache_clear()
    return words


def test_a_name_that_a_built_in_has_is_left_out_with_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    info = tmp_path / "third_party_taken-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party-taken\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(TAKEN_NAMES)
    monkeypatch.syspath_prepend(tmp_path)
    plugins.leave_out.cache_clear()
    assert plugins.names("fields")["gaussians"] == own("fields")["gaussians"] and not plugins.names("recipes")
    assert load_method("volumetric/nerf").name == "volumetric/nerf"
    assert {plugins.origin("fields", "gaussians"), plugins.origin("recipes", "volumetric/nerf")} == {"built in"}
    assert not plugins.used_plugins({"field": {"type": "gaussians"}}, "volumetric/nerf")
    assert capsys.readouterr().err.splitlines() == [
        "Left out: 'gaussians' of the fields (fine_parts:Gaussians, third-party-taken): a built-in has this name.",
        "Left out: 'volumetric/nerf' of the recipes (fine_parts:NERF, third-party-taken): a built-in has this name.",
    ]


def test_lists_leave_broken_parts_out_with_a_line_each(said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["list"]) == 0 and main.run(["list", "methods", "matrix"]) == 0
    listed = capsys.readouterr()
    assert "splatting/gaussians" in listed.out and "volumetric/listed" in listed.out and "| `volumetric/nerf`" in listed.out
    assert "volumetric/broken" not in listed.out and "volumetric/no-toml" not in listed.out
    warnings = listed.err.splitlines()
    # A line each in spite of two lists: three recipes, and in the matrix the field of one and the lack of another's.
    assert len(warnings) == len(set(warnings)) == 5 and all("third-party-broken" in line for line in warnings)
    named = "'volumetric/broken' of the recipes (broken_parts:RECIPE, third-party-broken) cannot be imported"
    assert f"Left out: {named}: {said}" in warnings


def test_other_methods_are_found_and_the_broken_one_is_explained(said: str, capsys: pytest.CaptureFixture[str]) -> None:
    names, _ = expand(["volumetric/*"])
    assert {"volumetric/nerf", "volumetric/listed"} <= set(names) and "volumetric/broken" not in names
    assert main.run(["compare", "bricks", "--methods", "volumetric/nrf"]) == main.BAD_INPUT
    assert "Did you mean 'volumetric/nerf'?" in capsys.readouterr().err
    for name in ("volumetric/broken", "volumetric/listed"):  # its own module, and that of its field
        with pytest.raises(InputError, match="third-party-broken") as caught:
            load_method(name, preset="")
        assert caught.value.sentence.endswith(said)
    with pytest.raises(InputError, match=r"volumetric/no-toml of third-party-broken is not valid TOML"):
        source("volumetric/no-toml")


def test_other_fields_and_formats_are_found(said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class Own(NeuralFieldConfig):
        """Of no registry, so that every plug-in is asked for it."""

    with pytest.raises(InputError, match="is not registered among the fields"):
        plugins.name_of("fields", Own)
    (tmp_path / "nothing").mkdir()
    with pytest.raises(InputError, match="is an empty folder"):
        find_loader(tmp_path / "nothing")
    assert capsys.readouterr().err.count(f"third-party-broken) cannot be imported: {said}") == 2
