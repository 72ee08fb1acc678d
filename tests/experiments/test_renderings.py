"""A fit through other renderers: the same Gaussians, folders of their own, made once, refused where they make no sense."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from training_fixtures import SMALL

from invgraphics import kernels
from invgraphics.cli.arguments import parse
from invgraphics.cli.compare import Compare
from invgraphics.core import Context
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model
from invgraphics.experiments.compare import compare
from invgraphics.experiments.evaluate import evaluate_run
from invgraphics.experiments.fitted import open_fitted
from invgraphics.experiments.job import Job
from invgraphics.experiments.renderings import check_variants, renderings_complete
from invgraphics.experiments.request import AblateRequest, CompareRequest, FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.experiments.variants import variant_named
from invgraphics.recipes.recipe import load_method
from invgraphics.recipes.schema import Recipe
from invgraphics.renderers.gaussians.volume import GaussianSorted, GaussianSortedConfig
from invgraphics.renderers.volumetric import Volumetric
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.runs.schema import plain
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.studies.cells import make_plan
from invgraphics.studies.reading import read_study
from invgraphics.testing import toy_scene

METHOD = "splatting/gaussians"
RAY = "gaussian-volume/sorted:opacity=splat"
OTHERS = (RAY, METHOD, "gaussian-volume/exact:steps=8")


@pytest.fixture(scope="module")
def request_one(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> FitRequest:
    out = tmp_path_factory.mktemp("runs") / "a"
    shared = {"method": METHOD, "scene": str(toy_folder), "budget": "20steps", "overrides": tuple(SMALL[METHOD])}
    return FitRequest(**shared, out=str(out), existing="reuse", kernels="reference", render_with=OTHERS)


@pytest.fixture(scope="module")
def run(request_one: FitRequest) -> Path:
    return fit_run(request_one)


def _record(run: Path) -> dict:
    return json.loads((run / "renderings.json").read_text())


def test_the_record_names_every_renderer_the_own_one_first(run: Path) -> None:
    record = _record(run)
    assert record["fitted_by"] == METHOD
    assert record["renderings"] == [
        {"renderer": METHOD, "run": "."},
        {"renderer": RAY, "run": "rendered/gaussian-volume-sorted-opacity=splat"},
        {"renderer": OTHERS[2], "run": "rendered/gaussian-volume-exact-steps=8"},
    ]
    assert len(record["differences"]) == 3 and len(record["views"]) == 3


def test_differences_are_those_of_the_pictures(run: Path) -> None:
    """Within the rounding of 8-bit pictures, which the record does without."""
    places = {entry["renderer"]: entry["run"] for entry in _record(run)["renderings"]}
    for entry in _record(run)["differences"]:
        assert max(entry["rmse"]) > 1e-3
        for view, (rmse, largest) in enumerate(zip(entry["rmse"], entry["largest"], strict=True)):
            one, other = (
                np.asarray(Image.open(run / places[name] / "test" / f"{view:04d}.png"), float) / 255
                for name in entry["renderers"]
            )
            assert rmse == pytest.approx(np.sqrt(((one - other) ** 2).mean()), abs=1 / 255)
            assert largest == pytest.approx(np.abs(one - other).max(), abs=1.5 / 255)


def test_a_rendering_is_the_fitted_field_through_that_renderer(run: Path, toy_folder: Path) -> None:
    scene = open_scene(str(toy_folder), SceneOptions(test_views=16))
    field = build_model(load_method(METHOD, None, SMALL[METHOD]), scene, 0, torch.device("cpu")).field
    field.load_state_dict(checkpoint.load(run / CHECKPOINT)["field"])
    kernels.use("reference")  # as in the fit: implementations may differ by a Gaussian at the limit of 1/255
    with torch.no_grad():
        renderer = GaussianSorted(GaussianSortedConfig("splat"))
        picture, _ = renderer.render_image(field, scene.test[1].camera, Context(scene.bounds))
    with np.load(run / _record(run)["renderings"][1]["run"] / "test" / "0001.npz") as kept:
        np.testing.assert_allclose(kept["rgb"], picture.rgb.numpy(), atol=2**-11)  # half floats


def test_a_rendering_is_a_run_that_knows_what_it_shows(run: Path) -> None:
    folder = run / "rendered" / "gaussian-volume-exact-steps=8"
    provenance, scores = (json.loads((folder / name).read_text()) for name in ("provenance.json", "scores.json"))
    assert (provenance["fitted_by"], provenance["rendered_by"]) == (METHOD, OTHERS[2])
    assert scores["method"] == f"{METHOD} rendered with {OTHERS[2]}"
    assert (folder / provenance["truth"] / "0000.png").is_file()
    assert (folder / provenance["fitted_run"]).resolve() == run.resolve()
    assert not (folder / CHECKPOINT).exists()
    kernels.use("reference")  # as in the fit
    assert plain(evaluate_run(folder))["quality"] == scores["quality"]


def _stamps(run: Path) -> dict[str, int]:
    return {path.relative_to(run).as_posix(): path.stat().st_mtime_ns for path in run.rglob("scores.json")}


def test_what_is_there_is_kept(run: Path, request_one: FitRequest) -> None:
    before = _stamps(run)
    assert renderings_complete(Job.of(request_one))
    fit_run(request_one)
    assert _stamps(run) == before
    # One rendering is lost: it alone is made again, and the fit is not.
    (run / "rendered" / "gaussian-volume-exact-steps=8" / "scores.json").unlink()
    (run / "renderings.json").unlink()
    assert not renderings_complete(Job.of(request_one))
    fit_run(request_one)
    changed = {name for name, stamp in _stamps(run).items() if before[name] != stamp}
    assert changed == {"rendered/gaussian-volume-exact-steps=8/scores.json"}
    # One more is asked for.
    more = replace(request_one, render_with=(*OTHERS, "gaussian-volume/sorted"))
    assert not renderings_complete(Job.of(more))
    fit_run(more)
    assert len(_record(run)["renderings"]) == 4 and len(_record(run)["differences"]) == 6
    fit_run(request_one)
    assert len(_record(run)["renderings"]) == 3
    # The same under one more protocol: nothing is drawn again under the one that has been.
    before, other = _stamps(run), replace(request_one, protocol="float")
    assert not renderings_complete(Job.of(other))
    fit_run(other)
    assert renderings_complete(Job.of(other)) and _stamps(run) == before
    assert all((run / one["run"] / "scores.float.json").is_file() for one in _record(run)["renderings"])


def test_a_changed_renderer_is_another_one_than_the_fits_own(run: Path, request_one: FitRequest, tmp_path: Path) -> None:
    items = (*request_one.overrides, "renderer.dilation=0.1")
    other = replace(request_one, overrides=items, out=str(tmp_path / "b"), render_with=(METHOD, f"{METHOD}:dilation=0.1"))
    names = [(entry["renderer"], entry["run"]) for entry in _record(fit_run(other))["renderings"]]
    assert names == [(f"{METHOD}:dilation=0.1", "."), (METHOD, "rendered/splatting-gaussians")]


def test_constants_stand_in_for_what_another_fit_would_have_learnt(toy_folder: Path, tmp_path: Path) -> None:
    """A field fitted without an occupancy grid, marched through a full one."""
    variant = "volumetric/hash:sampler.resolution=8:sampler.steps_per_diagonal=64"
    shared = {"method": "volumetric/nerf", "scene": str(toy_folder), "budget": "4steps", "test_views": 1}
    out = str(tmp_path / "run")
    run = fit_run(FitRequest(**shared, overrides=tuple(SMALL["volumetric/nerf"]), out=out, render_with=(variant,)))
    record = _record(run)
    assert [entry["renderer"] for entry in record["renderings"]] == ["volumetric/nerf", variant]
    fitted = open_fitted(run)
    config = variant_recipe(variant).renderer.sampler
    marched = replace(fitted.model, renderer=Volumetric(config.build(fitted.scene)))
    with np.load(run / record["renderings"][1]["run"] / "test" / "0000.npz") as kept:
        picture = marched.render(fitted.scene.test[0].camera)
        np.testing.assert_allclose(kept["rgb"], picture.rgb.numpy(), atol=1e-3)
    opened = open_fitted(run / record["renderings"][1]["run"])
    opened.load(checkpoint.load(run / CHECKPOINT))  # as the viewer does, of a fit that goes on


def variant_recipe(name: str) -> Recipe:
    method, *settings = name.split(":")
    return load_method(method, None, [f"renderer.{item}" for item in settings]).recipe


@pytest.mark.parametrize(
    ("methods", "names", "sentence"),
    [
        (("volumetric/hash",), ("gaussian-volume/exact",), "volumetric/hash cannot be rendered with gaussian-volume/exact"),
        ((METHOD,), (RAY, RAY), "named twice"),
        ((METHOD,), ("gaussian-volume/sorted:ordre=ray",), "Unknown key 'renderer.ordre'"),
        ((METHOD,), ("gaussian-volume/sorted:order=up",), "cannot be 'up'"),
        ((METHOD,), ("gaussian-volume/nothing",), "no method 'gaussian-volume/nothing'"),
    ],
)
def test_what_makes_no_sense_is_refused(methods: tuple[str, ...], names: tuple[str, ...], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        check_variants(list(map(variant_named, names)), list(map(load_method, methods)), toy_scene(views=2, size=8))


def test_compare_refuses_before_the_first_fit(toy_folder: Path, tmp_path: Path) -> None:
    request = CompareRequest(
        scene=str(toy_folder), out=str(tmp_path), methods=("volumetric/hash",), render_with=("gaussian-volume/exact",)
    )
    assert all(fit.render_with == request.render_with for fit in request.fits())
    assert "--render-with gaussian-volume/exact" in request.shell()
    with pytest.raises(InputError, match="cannot be rendered with"):
        compare(request)


def test_names_are_read() -> None:
    said = {"type": "gaussian_sorted", "opacity": "splat", "order": "ray", "smallest": 1 / 1020}
    assert variant_named(RAY).table.items() >= said.items()
    changed = variant_named("gaussian-volume/exact:opacity=physical:steps=7")
    assert changed.folder == "gaussian-volume-exact-opacity=physical-steps=7"


def test_a_variant_has_the_preset_of_the_fit_or_its_own() -> None:
    """Shorter steps of a longer fit are shown as they were fitted, by whatever renderer has such a preset."""
    laptop, long = (load_method("volumetric/hash", preset).table["renderer"] for preset in ("laptop", "long"))
    assert laptop != long
    assert variant_named("volumetric/hash").table == laptop
    assert variant_named("volumetric/hash", "long").table == long
    assert variant_named("volumetric/hash:preset=laptop", "long").table == laptop
    assert variant_named("volumetric/hash:sampler.chunk=7:preset=long").table["sampler"]["chunk"] == 7
    assert variant_named("gaussian-volume/exact", "no such preset").table == variant_named("gaussian-volume/exact").table
    with pytest.raises(InputError, match="has no preset 'fine'"):
        variant_named("volumetric/hash:preset=fine")
    request = FitRequest(method="volumetric/hash", scene="bricks", budget="5min", out="x", render_with=("volumetric/hash",))
    job = Job.of(request)
    assert job.method.preset == "long" and job.variants[0].table == long


def test_the_command_line_has_it() -> None:
    words = ["bricks", "--methods", METHOD, "--render-with", f"{RAY},{METHOD}:dilation=0"]
    assert parse(Compare, "invgraphics compare", words).request().render_with == (RAY, f"{METHOD}:dilation=0")


def _study(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(f'question = "?"\nscenes = ["bricks"]\nmethods = ["{METHOD}"]\n{text}')
    return path


def test_a_study_hands_its_renderers_on(tmp_path: Path) -> None:
    pair = f'[[approximations]]\nname = "x"\nexact = "{RAY}"\napproximate = "{METHOD}"\n'
    path = _study(tmp_path, f'render_with = ["{METHOD}", "{RAY}"]\nanalyses = ["opacity-convention"]\n{pair}')
    study = read_study(path)
    plan = make_plan(study, AblateRequest(study=str(path), out=str(tmp_path / "out")))
    assert plan[0].fit.render_with == (METHOD, RAY)
    assert (study.approximations[0].exact, study.approximations[0].approximate) == (RAY, METHOD)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('analyses = ["opacity"]\n', "no analysis 'opacity'"),
        (f'[[approximations]]\nname = "x"\nexact = "{RAY}"\napproximate = "{METHOD}"\n', "not in 'render_with'"),
        ('[[approximations]]\nname = "x"\n', "'approximations.0.exact' is missing"),
    ],
)
def test_broken_studies_are_refused(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        read_study(_study(tmp_path, text))
