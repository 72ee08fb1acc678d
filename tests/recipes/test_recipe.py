"""Recipes: every built-in method builds under every preset; overrides and errors."""

import tomllib

import pytest
import torch

from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model
from invgraphics.recipes.recipe import load_method, methods, presets, resolve
from invgraphics.testing import check_field, check_renderer, toy_scene

CELLS = [(name, preset) for name in methods() for preset in (*presets(name), "")]


@pytest.mark.parametrize(("name", "preset"), CELLS)
def test_recipe_reads_and_survives_a_round_trip(name: str, preset: str) -> None:
    method = load_method(name, preset)
    again = resolve(name, preset, method.table)
    assert again.recipe == method.recipe
    assert again.digest == method.digest
    assert method.recipe.summary
    assert method.recipe.paper


@pytest.mark.parametrize("name", list(methods()))
@pytest.mark.parametrize("space", ["box", "contracted"])
def test_recipe_conforms(name: str, space: str) -> None:
    scene = toy_scene(views=3, size=8, space=space)
    model = build_model(load_method(name), scene, 0, torch.device("cpu"))
    check_field(model.field, scene)
    check_renderer(model.renderer, model.field, scene)


def test_overrides_take_toml_values() -> None:
    method = load_method("volumetric/nerf", None, ["field.width=48", "field.encoding.type=hash", "losses.0.weight=0.5"])
    assert method.recipe.field.width == 48
    assert type(method.recipe.field.encoding).__name__ == "HashConfig"
    assert method.recipe.losses[0].weight == 0.5
    assert method.digest != load_method("volumetric/nerf").digest


@pytest.mark.parametrize(
    ("name", "preset", "override", "sentence"),
    [
        ("volumetric/nerv", None, [], "There is no method 'volumetric/nerv'"),
        ("volumetric/nerf", "huge", [], "has no preset 'huge'"),
        ("volumetric/nerf", None, ["field.widht=3"], "Unknown key 'field.widht'"),
        ("volumetric/nerf", None, ["field.width"], "not of the form key=value"),
        ("volumetric/nerf", None, ["field.width=wide"], "'field.width' cannot be 'wide'"),
        ("volumetric/nerf", None, ["losses.7.weight=1"], "Unknown key 'losses.7.weight'"),
        ("missing.toml", None, [], "missing.toml does not exist"),
    ],
)
def test_bad_requests_get_a_sentence(name: str, preset: str | None, override: list[str], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        load_method(name, preset, override)
    assert sentence in str(caught.value)


def test_a_users_own_file_is_a_method(tmp_path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(
        'summary = "mine"\n[field]\ntype = "neural"\n[renderer]\ntype = "volumetric"\n[[losses]]\ntype = "photometric"\n'
        '[optimiser.groups.all]\nmatch = "field"\nlr = 1e-3\n'
    )
    assert load_method(str(own)).recipe.summary == "mine"
    own.write_text("field = [")
    with pytest.raises(InputError, match="not valid TOML"):
        load_method(str(own))
    with pytest.raises(tomllib.TOMLDecodeError):
        tomllib.loads(own.read_text())
