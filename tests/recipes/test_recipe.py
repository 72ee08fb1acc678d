"""Recipes: every built-in method builds under every preset; overrides and errors."""

import copy
import hashlib
import json
import tomllib

import pytest
import torch

from invgraphics.cli.arguments import parse_list
from invgraphics.core import Conditional
from invgraphics.data import find
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model
from invgraphics.recipes.recipe import load_method, methods, presets, resolve, split_name
from invgraphics.testing import as_class, check_field, check_renderer, toy_scene
from invgraphics.text import slug

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
    scene = toy_scene(views=3, size=8, space=space, facing="forward")
    method = load_method(name)
    scene = as_class(scene) if isinstance(method.recipe.field.build(scene), Conditional) else scene
    model = build_model(method, scene, 0, torch.device("cpu"))
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


@pytest.mark.parametrize(
    ("hook", "words"),
    [
        ("density_control", "Gaussians"),
        ("relocation", "Gaussians"),
        ("smoothing", "Gaussians"),
        ("limits", "Gaussians"),
        ("sh_degree", "spherical harmonics"),
    ],
)
def test_hooks_that_the_field_cannot_serve_are_refused_before_anything_is_built(hook: str, words: str) -> None:
    table = load_method("volumetric/hash").table
    with pytest.raises(InputError, match=f"hook '{hook}' needs {words}, which NeuralField does not have"):
        resolve("mine", "", table | {"hooks": [{"type": hook}]})


def test_a_cap_reaches_the_field_and_the_hooks_that_make_primitives() -> None:
    recipe = load_method("splatting/gaussians", overrides=["max_primitives=123"]).recipe
    assert recipe.field.max_init == recipe.field.count == 123
    assert [hook.max_primitives for hook in recipe.hooks if hasattr(hook, "max_primitives")] == [123]
    assert load_method("volumetric/hash", overrides=["max_primitives=123"]).recipe.field.layers == 1


LATER_IN_BATCHES = ("foreground_until", "foreground_least", "start_size", "start_until")
LATER_IN_OPTIMISER = ("muon", "muon_weight_decay")


def test_recipes_of_earlier_versions_open_under_the_same_digest() -> None:
    """With the keys as they were first called; the digest, by which runs are found again, is over those names."""
    method = load_method("splatting/gaussians", "long", ["batches.start_size=0", "batches.start_until=0.5"])
    table = copy.deepcopy(method.table)
    (hook,) = [hook for hook in table["hooks"] if hook["type"] == "density_control"]
    for new, old in {"revised_opacity": "share_opacity", "cap_ramp": "pace", "latest_start_step": "start_steps"}.items():
        hook[old] = hook.pop(new)
    for new, old in {"antialiased": "compensate", "max_grad_splats": "receivers"}.items():
        table["renderer"][old] = table["renderer"].pop(new)
    for key in LATER_IN_BATCHES:
        del table["batches"][key]
    for key in ("dropout", "dropout_views"):
        del table["field"][key]
    del hook["reset_spacing"], hook["split_threshold"]
    for key in LATER_IN_OPTIMISER:
        del table["optimiser"][key]
    assert hook["share_opacity"] is True and hook["pace"] == 0.5 and hook["start_steps"] == 500
    again = resolve(method.name, "long", table)
    assert again.recipe == method.recipe and again.table == method.table
    assert again.digest == method.digest == hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()
    with pytest.raises(InputError, match=r"Unknown key 'hooks\.1\.pace'"):
        resolve(method.name, "", table | {"hooks": [table["hooks"][0], {"type": "density_control", "pace": 1, "cap_ramp": 1}]})


@pytest.mark.parametrize("preset", ["laptop", "paper"])
def test_keys_that_came_later_leave_the_digest_alone(preset: str) -> None:
    """While they have the values that change nothing; neural fields and the volumetric renderer had these keys first."""
    fields = "type encoding geometry layers width skip geometry_features colour_layers colour_width direction direction_degree"
    known = {*fields.split(), "density_activation", "density_bias", "density_per"}
    changed = ["batches.foreground_least=0", "batches.foreground_until=1"]
    unset = [*changed, *(f"optimiser.{key}=0" for key in LATER_IN_OPTIMISER)]
    method = load_method("volumetric/nerf", preset, unset)
    table = copy.deepcopy(method.table)
    parts = [table["field"], *([table["renderer"]["sampler"]["proposal"]] if preset == "paper" else [])]
    for part in parts:
        assert part.keys() > known
        for key in part.keys() - known:
            del part[key]
    for key in table["renderer"].keys() - {"type", "sampler", "gradient_reach"}:
        del table["renderer"][key]
    for key in LATER_IN_BATCHES:
        del table["batches"][key]
    for key in LATER_IN_OPTIMISER:
        del table["optimiser"][key]
    assert resolve(method.name, preset, table).digest == method.digest
    text = json.dumps(table, sort_keys=True)
    assert method.digest == hashlib.sha256(text.encode()).hexdigest()
    assert load_method(method.name, preset, ["field.density_scale=2.0"]).digest != method.digest
    assert load_method(method.name, preset, ["renderer.colour_threshold=0.1"]).digest != method.digest
    for key in LATER_IN_OPTIMISER:
        assert load_method(method.name, preset, [f"optimiser.{key}=1.0"]).digest != method.digest
    for key in LATER_IN_BATCHES:
        assert load_method(method.name, preset, [f"batches.{key}={0.3 if key != 'start_size' else 7}"]).digest != method.digest


def test_renderers_of_older_runs_still_resolve() -> None:
    now = load_method("splatting/gaussians-mip", None, ["renderer.max_grad_splats=10"])
    renderer = {key: value for key, value in now.table["renderer"].items() if key not in ("antialiased", "max_grad_splats")}
    older = now.table | {"renderer": renderer | {"compensate": True, "receivers": 10}}
    assert resolve(now.name, now.preset, older).table == now.table
    hashed = load_method("volumetric/hash").table
    sampler = {("wave" if key == "chunk" else key): value for key, value in hashed["renderer"]["sampler"].items()}
    assert resolve("mine", "", hashed | {"renderer": hashed["renderer"] | {"sampler": sampler}}).table == hashed


def test_a_name_may_carry_changes() -> None:
    """Its own changes come last, and its own preset first; the name stays whole, so that it makes the method again."""
    name = "volumetric/nerf:preset=paper:field.width=96:batches.rays=77"
    assert split_name(name) == ("volumetric/nerf", "paper", ("field.width=96", "batches.rays=77"))
    method = load_method(name, "laptop", ["field.width=8", "field.layers=7"])
    assert (method.name, method.preset) == (name, "paper")
    assert (method.recipe.field.width, method.recipe.field.layers, method.recipe.batches.rays) == (96, 7, 77)
    assert split_name("C:/mine.toml") == ("C:/mine.toml", None, ())
    assert slug(name) == "volumetric-nerf-preset=paper-field.width=96-batches.rays=77"
    listed = "splatting/gaussians:batches.resolution=[0.5,1.0],volumetric/hash"
    assert parse_list(listed, "--methods") == tuple(listed.replace("],", "]|").split("|"))


@pytest.mark.parametrize("name", [name for name in methods() if "paper" in presets(name)])
def test_a_recipe_with_published_values_says_what_differs_from_the_paper(name: str) -> None:
    assert "what differs" in (find("renderers") / f"{name}.toml").read_text().lower().replace("\n# ", " ")


def test_colours_weigh_as_much_beside_the_mask_in_both_recipes_of_idr() -> None:
    """Its loss sums a pixel's three channels and divides by the pixels; a photometric loss is a mean over channels, too."""
    for name in ("sphere-tracing/mlp", "sphere-tracing/hash"):
        photometric, mask = load_method(name, "paper").recipe.losses[:2]
        assert (photometric.weight, mask.weight) == (3.0, 100.0), name


@pytest.mark.parametrize(
    ("name", "layer"), [("hybrid/neus", 4), ("hybrid/volsdf", 4), ("sphere-tracing/mlp", 4), ("volumetric/nerf", 5)]
)
def test_the_skip_enters_the_layer_that_the_papers_have_it_in(name: str, layer: int) -> None:
    """Counted from 0: ``lin4`` of IDR, NeuS and VolSDF; ``pts_linears[5]`` of NeRF."""
    field = load_method(name, "paper").recipe.field.build(toy_scene(views=2, size=8))
    shapes = [tensor.shape for key, tensor in field.named_parameters() if "geometry" in key and tensor.dim() == 2]
    assert [index for index, (_, inputs) in enumerate(shapes) if index and inputs > shapes[0][0]] == [layer]
