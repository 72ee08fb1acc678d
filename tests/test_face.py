"""``import invgraphics as ig``: every example runs, names come lazily, fits stop, go on and show themselves."""

import doctest
import importlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image
from shared_folders import Once
from training_fixtures import SMALL

import invgraphics as ig
from invgraphics.api.keeping import reopenable_scene
from invgraphics.core import Scene, View
from invgraphics.core.transforms import look_at
from invgraphics.errors import InputError, NotComposableError
from invgraphics.experiments import compare as comparing
from invgraphics.experiments.display import ScoreTable
from invgraphics.experiments.request import AblateRequest
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.scenes.npz import Npz
from invgraphics.scenes.npz_writer import save_npz
from invgraphics.scenes.open import SceneOptions, source_of
from invgraphics.scenes.truth import POINTS as EXACT_POINTS
from invgraphics.testing import toy_scene

SPLATS = ig.load_method("splatting/gaussians", set={"field.count": 60, "field.max_init": 60, "field.sh_degree": 0})
ROOT = Path(__file__).parents[1]
EXAMPLES = (
    "load_scene",
    "save_scene",
    "load_method",
    "fit",
    "evaluate",
    "load_run",
    "compare",
    "load_study",
    "ablate",
    "Model",
)


@pytest.fixture(autouse=True)
def _toy_beside(tmp_path: Path, once: Once, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of its own for each test, with the data set that examples open."""
    made = once("toy-npz", lambda folder: save_npz(toy_scene(views=8, size=24), folder / "toy.npz"))
    shutil.copy(made / "toy.npz", tmp_path)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("thing", [*(getattr(ig, name) for name in EXAMPLES), ScoreTable], ids=[*EXAMPLES, "ScoreTable"])
def test_the_examples_hold(thing: object, request: pytest.FixtureRequest) -> None:
    """Fits of comparison and study are made in this process."""
    if thing in (ig.ablate, ig.compare):
        request.getfixturevalue("in_process")
        request.getfixturevalue("unpainted")
    (test,) = doctest.DocTestFinder(recurse=False).find(thing, name=thing.__name__)
    assert test.examples
    said = io.StringIO()
    failed, _ = doctest.DocTestRunner().run(test, out=said.write)
    assert not failed, said.getvalue()


def test_the_readme_holds(in_process, unpainted) -> None:
    """Its blocks of Python, one after the other, on the toy and with few steps."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), flags=re.S | re.M)
    assert len(blocks) == 3
    code = "\n".join(blocks).replace('"bricks"', '"toy.npz"')
    code, budgets = re.subn(r'"(?:30s|60s|500steps)"', '"4steps"', code)
    assert budgets == 3
    code = code.replace('"1000steps"', '"6steps"').replace('{"field.width": 64}', '{"field.width": 16, "batches.rays": 64}')
    names: dict = {}
    exec(code, names)
    assert names["fit"].fit.steps == 6 and len(names["frames"]) == 1
    assert names["splatted"].rgb.shape == names["integrated"].rgb.shape == (128, 128, 3)


def test_names_are_lazy_and_typed_and_packages_load_at_any_depth() -> None:
    code = (
        "import sys, invgraphics as ig\n"
        "print('torch' in sys.modules, set(ig.__all__) <= set(dir(ig)), ig.Camera.__module__)\n"
        "print(ig.fields.encodings.frequency.FrequencyConfig(octaves=2).build().width)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    # x, and sine and cosine of two octaves, of three coordinates
    assert done.stdout.split() == ["False", "True", "invgraphics.core.camera", "15"]
    for name, home in ig._HOMES.items():
        assert getattr(importlib.import_module(home), name) is getattr(ig, name)
    assert sorted(ig._HOMES) == sorted(ig.__all__)
    with pytest.raises(AttributeError, match="no attribute 'render'"):
        ig.render  # noqa: B018
    with pytest.raises(AttributeError, match=r"'invgraphics\.core' has no attribute 'optics'"):
        ig.core.optics  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'optics'"):
        from invgraphics.core import optics  # noqa: F401


def test_fits_in_memory_and_in_a_folder_are_the_same_fit() -> None:
    """A scene that no file holds is fitted as it is; a folder keeps a copy of it."""
    kept = ig.fit(SPLATS, toy_scene(views=8, size=24), budget="20steps", out="run")
    in_memory = ig.fit(SPLATS, kept.scene, budget="20steps")
    state = checkpoint.load(Path("run") / CHECKPOINT)["field"]
    assert all(torch.equal(value, state[name]) for name, value in in_memory.model.field.state_dict().items())
    assert in_memory.scores["psnr"] == kept.scores["psnr"] == kept.evaluate()["psnr"]
    assert [moment.psnr for moment in in_memory.history] == [moment.psnr for moment in kept.history]
    assert in_memory.scores.record.cost["steps"] == 20
    command = json.loads(Path("run/provenance.json").read_text())["command"]
    assert f"fit {SPLATS.name} run/scene.npz" in command
    # The folder takes its scene along.
    Path("run").rename("moved")
    assert ig.load_run("moved").evaluate()["psnr"] == kept.scores["psnr"]
    assert ig.fit(SPLATS, kept.scene, budget="20steps", out="moved").scores["psnr"] == kept.scores["psnr"]


def test_a_stopped_fit_goes_on_to_the_same_bits(capsys: pytest.CaptureFixture[str]) -> None:
    scene = ig.load_scene("toy.npz")

    def stop(fit) -> None:
        if fit.steps == 7:
            os.kill(os.getpid(), signal.SIGINT)

    whole = ig.fit(SPLATS, scene, budget="20steps")
    stopped = ig.fit(SPLATS, scene, budget="20steps", on_step=stop)
    assert (stopped.finished, stopped.fit.steps) == (False, 7)
    assert "Interrupted after 7 steps" in capsys.readouterr().err
    stopped.resume()
    assert stopped.finished
    assert torch.equal(stopped.model.field.means, whole.model.field.means)
    stopped.resume("30steps")
    assert stopped.fit.steps == 30 and stopped.history[-1].step == 30
    kept = ig.fit(SPLATS, scene, budget="20steps", out="run", on_step=stop)
    assert not kept.finished and kept.scores["psnr"] > 0 and not Path("run/scores.json").exists()
    kept = ig.fit(SPLATS, scene, budget="20steps", out="run")
    assert kept.finished and torch.equal(kept.model.field.means, whole.model.field.means)
    seen = []
    ig.fit(SPLATS, scene, budget="20steps", out="run", on_step=seen.append)
    assert not seen, "what is finished is only opened"
    with pytest.raises(InputError, match="holds another run"):
        ig.fit(SPLATS, scene, budget="21steps", out="run")
    ig.fit(SPLATS, toy_scene(views=8, size=24), budget="2steps", out="own")
    with pytest.raises(InputError, match="holds another scene"):
        ig.fit(SPLATS, toy_scene(views=9, size=24), budget="2steps", out="own")


def _of_views(scene: Scene, **parts: Callable[[View], object]) -> Scene:
    """The scene with parts of its training views made anew."""
    return scene.with_views(train=tuple(replace(v, **{name: make(v) for name, make in parts.items()}) for v in scene.train))


OTHER_SCENES: dict[str, Callable[[Scene], Scene]] = {
    "views": lambda scene: scene.with_views(train=scene.train[:-1]),
    "val": lambda scene: scene.with_views(val=scene.train[:1]),
    "pixels": lambda scene: _of_views(scene, image=lambda v: v.image.bitwise_xor(1)),
    "focal": lambda scene: _of_views(scene, camera=lambda v: replace(v.camera, focal=v.camera.focal + 0.01)),
    "middle": lambda scene: _of_views(
        scene, camera=lambda v: replace(v.camera, principal_point=v.camera.principal_point + 0.01)
    ),
    "pose": lambda scene: _of_views(scene, camera=lambda v: v.camera.moved(look_at(v.camera.position, *torch.eye(3)[1:]))),
    "bounds": lambda scene: replace(scene, bounds=replace(scene.bounds, hi=scene.bounds.hi + 0.01)),
    "near": lambda scene: replace(scene, bounds=replace(scene.bounds, near=0.5)),
    "background": lambda scene: replace(scene, background=torch.tensor([0.2, 0.4, 0.6])),
    "colour": lambda scene: replace(scene, colour="linear"),
    "points": lambda scene: replace(scene, points=replace(scene.points, position=scene.points.position + 0.01)),
    "colours of points": lambda scene: replace(scene, points=replace(scene.points, rgb=1 - scene.points.rgb)),
    "no points": lambda scene: replace(scene, points=None),
    "depth": lambda scene: _of_views(scene, depth=lambda v: v.depth + 0.01),
    "no depth": lambda scene: replace(
        _of_views(scene, depth=lambda v: None), test=tuple(replace(v, depth=None) for v in scene.test)
    ),
    "mask": lambda scene: _of_views(scene, mask=lambda v: v.opacity() > 0.5),
}


def test_a_scene_made_in_python_is_known_again(tmp_path: Path) -> None:
    reopenable_scene(toy_scene(views=6, size=16), tmp_path / "kept")
    kept, place = reopenable_scene(toy_scene(views=6, size=16), tmp_path / "kept")
    assert place["scene"] == str(tmp_path / "kept" / "scene.npz")
    reopenable_scene(replace(kept, notes={}), tmp_path / "kept")  # as read from there, poses re-orthonormalised


@pytest.mark.parametrize("change", OTHER_SCENES.values(), ids=OTHER_SCENES)
def test_another_scene_is_told_from_the_one_that_a_folder_keeps(change: Callable[[Scene], Scene], tmp_path: Path) -> None:
    """Else a run of the other scene would be opened as this one's, finished."""
    scene = toy_scene(views=6, size=16)
    reopenable_scene(scene, tmp_path / "kept")
    with pytest.raises(InputError, match="holds another scene"):
        reopenable_scene(change(scene), tmp_path / "kept")


def test_steps_can_be_watched() -> None:
    seen = []
    ig.fit(SPLATS, "toy.npz", "3steps", on_step=lambda fit: seen.append((fit.steps, fit.model.field.means.sum().item())))
    assert [step for step, _ in seen] == [0, 1, 2, 3]
    assert len({total for _, total in seen}) == 4


@pytest.mark.parametrize("out", [None, "run"])
def test_methods_come_in_every_shape(out: str | None) -> None:
    table = {"summary": "mine", "paper": "none", **SPLATS.table, "batches": {"views": 1}}
    Path("mine.toml").write_text("")
    by_table = ig.fit(table, "toy.npz", "2steps", out=out)
    assert by_table.method.recipe.field.count == 60
    assert ig.fit(SPLATS.name, "toy.npz", "2steps").method.table == SPLATS.table
    paper = ig.load_method("volumetric/nerf", preset="paper", set={"field.width": 32})
    assert (paper.preset, paper.recipe.field.width, paper.name) == ("paper", 32, "volumetric/nerf:preset=paper:field.width=32")
    with pytest.raises(InputError, match=r"Unknown key 'field\.widht'"):
        ig.load_method("volumetric/nerf", set={"field.widht": 32})


def test_a_comparison_of_a_scene_made_in_python(in_process) -> None:
    scene = toy_scene(views=8, size=24)
    lost = ig.load_method("splatting/gaussians", set={"field.init": "field", "field.source": "nowhere"})
    with pytest.raises(InputError, match="nowhere is not a run"):  # before any fit
        ig.compare(scene, [SPLATS, lost], budget="2steps", out="report")
    broken = ig.load_method("splatting/gaussians", set={"optimiser.groups.colour.lr": 1e38})
    in_process.fails = staticmethod(lambda request: "Step 1: not finite." if request.method == broken.name else "")
    report = ig.compare(scene, [SPLATS, broken], budget="2steps", seeds=(3,), out="report")
    assert report.methods == (SPLATS.name, broken.name)
    assert [(failure.method, failure.seed) for failure in report.failures] == [(broken.name, 3)]
    assert report.run(SPLATS.name, 3).scores["psnr"] == report.scores(SPLATS.name, 3)["psnr"]
    columns, rows = report.table()
    assert columns[0] == "" and any(SPLATS.name in row[0] for row in rows)
    assert SPLATS.name in report._repr_html_() and report.page.is_file()
    assert report.run(SPLATS, 3).folder == report.run(SPLATS.name, 3).folder
    with pytest.raises(InputError, match=rf"The fit of '{re.escape(broken.name)}' with seed 3 failed: "):
        report.run(broken, 3)
    with pytest.raises(InputError, match=rf"no run of 'splatting/nothing'.*\nIts runs: {SPLATS.name} with seed 3\."):
        report.run("splatting/nothing")


def test_a_scene_is_kept_as_it_is(tmp_path: Path) -> None:
    scene = toy_scene(views=8, size=24)
    save_npz(scene, tmp_path / "kept.npz")
    kept = Npz().load(tmp_path / "kept.npz", SceneOptions(test_views=None))
    for split in ("train", "test"):
        assert kept.digest(split) == scene.digest(split)
        assert torch.equal(getattr(kept, split)[0].depth, getattr(scene, split)[0].depth)
    for a, b in zip((*kept.train, *kept.test), (*scene.train, *scene.test), strict=True):
        torch.testing.assert_close(a.camera.cam_to_world, b.camera.cam_to_world, atol=1e-6, rtol=0)
        assert torch.equal(a.camera.focal, b.camera.focal) and torch.equal(a.camera.principal_point, b.camera.principal_point)
    assert torch.equal(kept.background, scene.background)
    assert torch.equal(kept.bounds.lo, scene.bounds.lo) and kept.bounds.space == "box"
    assert torch.equal(kept.points.position, scene.points.position)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda scene: replace(scene, colour="linear"), "linear colours"),
        (lambda scene: replace(scene, background=torch.zeros(3)), "a background other than the default"),
        (lambda scene: replace(scene, bounds=replace(scene.bounds, space="contracted")), "no box around it"),
        (lambda scene: replace(scene, test=(replace(scene.test[0], depth=None), *scene.test[1:])), "depth for some views only"),
    ],
)
def test_a_scene_that_cannot_be_kept_is_refused_but_fitted(change: Callable[[ig.Scene], ig.Scene], what: str) -> None:
    scene = change(toy_scene(views=8, size=24))
    with pytest.raises(InputError, match=f"cannot be kept as a data set: it has {what}"):
        ig.compare(scene, [SPLATS], budget="2steps", out="report")
    assert ig.fit(SPLATS, scene, "2steps").finished


def test_scenes_are_saved_where_they_can_be() -> None:
    with pytest.raises(InputError, match=r"Expected a file name that ends in \.npz"):
        ig.save_scene(toy_scene(views=2, size=8), "toy.zip")
    with pytest.raises(InputError, match=r"cannot be written to 'toy\.npz/kept\.npz'"):
        ig.save_scene(toy_scene(views=2, size=8), "toy.npz/kept.npz")


def test_a_study_shows_its_figures(in_process) -> None:
    head = 'question = "?"\nscenes = ["toy.npz"]\nmethods = ["splatting/gaussians"]\nseeds = [0]\nbudget = "2steps"\n'
    Path("views.toml").write_text(head + "[factors]\ndata.train_views = [4, 8]\n")
    result = ig.ablate("views.toml", out="views")
    assert ElementTree.fromstring(result.figure("effects-psnr")._repr_svg_()).tag.endswith("svg")
    with pytest.raises(InputError, match=r"no figure 'effects-nothing'.\nIt has: effects-psnr, "):
        result.figure("effects-nothing")


def test_gaussians_of_a_model_are_those_that_it_renders() -> None:
    model = ig.fit(SPLATS, "toy.npz", "2steps").model
    assert torch.allclose(model.gaussians().opacities, model.field.opacity_logits.sigmoid())
    field = ig.fit("volumetric/hash", "toy.npz", "1steps").model
    with pytest.raises(NotComposableError, match="has no gaussians"):
        field.gaussians()


def test_a_changed_scene_is_not_the_one_that_was_opened() -> None:
    scene = ig.load_scene("toy.npz", size=16)
    source = source_of(scene)
    assert source is not None and (source.spec, source.options.size) == ("toy.npz", 16)
    assert source_of(scene.with_views(train=scene.train[:4])) is None
    ig.fit(SPLATS, scene, "2steps", out="loaded")
    ig.fit(SPLATS, scene.with_views(train=scene.train[:4]), "2steps", out="changed")
    assert not Path("loaded/scene.npz").exists() and Path("changed/scene.npz").exists()
    assert len(ig.load_run("changed").scene.train) == 4


def test_a_finished_run_shows_new_views_through_other_renderers() -> None:
    ig.fit(SPLATS, "toy.npz", "20steps", out="run")
    run = ig.load_run("run")
    camera = run.scene.test[0].camera.moved(
        look_at(torch.tensor([0.0, -3.0, 1.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    )
    splatted, integrated = run.model.render(camera), run.through("gaussian-volume/exact:steps=8").render(camera)
    assert 0 < float((splatted.rgb - integrated.rgb).abs().max()) < 0.5
    with pytest.raises(InputError, match="cannot be rendered with sphere-tracing/hash"):
        run.through("sphere-tracing/hash")


def test_a_run_through_its_own_renderer_keeps_what_that_learnt_and_through_another_takes_a_constant() -> None:
    method = ig.load_method("hybrid/neus", set={"field.width": 16, "field.layers": 1, "batches.rays": 16})
    run = ig.fit(method, ig.load_scene("toy.npz"), "2steps")
    width = run.model.renderer.width
    assert run.through("hybrid/neus").renderer.width == width != run.through("hybrid/neus:sharpness_final=70").renderer.width
    assert torch.isclose(run.through("hybrid/volsdf:change=held:beta=0.03").renderer.width, torch.tensor(0.03 - 1e-4))


def test_objects_show_themselves() -> None:
    scene = ig.load_scene("toy.npz")
    fit = ig.fit(SPLATS, scene, "5steps")
    view, white = scene.test[0], torch.ones(3)
    picture = fit.model.render(view.camera)
    for shown in (view, picture):
        colours = shown.over(white)
        pixels = torch.from_numpy(np.array(Image.open(io.BytesIO(shown._repr_png_())))) / 255
        assert torch.allclose(pixels, colours.clamp(0, 1), atol=0.5 / 255 + 1e-6)
    assert picture.reshape(24 * 24)._repr_png_() is None
    assert repr(scene).startswith("Scene(scene: ") and "8 to fit, 0 to watch" in repr(scene) and len(repr(scene)) < 300
    assert "8 to fit, 0 to watch" in scene._repr_html_() and "data:image/png;base64," in scene._repr_html_()
    curve = ElementTree.fromstring(fit._repr_svg_())
    (line,) = curve.iter("{http://www.w3.org/2000/svg}polyline")
    assert len(line.attrib["points"].split()) == len(fit.history)
    assert "psnr" in fit.scores._repr_html_() and "dB" in repr(fit.scores)
    assert "finished, 5 steps" in repr(fit)


def test_small_methods_of_each_family_fit() -> None:
    scene = toy_scene(views=6, size=16)
    for name, items in SMALL.items():
        method = ig.load_method(name, set={key: json.loads(value) for key, _, value in (item.partition("=") for item in items)})
        assert ig.fit(method, scene, "2steps").finished, name


def test_training_data_can_be_changed_from_python_in_memory_and_in_a_folder() -> None:
    few = {"train_views": 4, "init": "random", "test_scales": (2,)}
    in_memory = ig.fit(SPLATS, "toy.npz", "3steps", data=few)
    kept = ig.fit(SPLATS, "toy.npz", "3steps", data=few, out="run")
    assert len(in_memory.fit.plan.scene.train) == 4 and len(in_memory.scene.train) == 8
    assert in_memory.scores["psnr_at_1_2"] == kept.scores["psnr_at_1_2"] == kept.evaluate()["psnr_at_1_2"]
    provenance = json.loads(Path("run/provenance.json").read_text())
    assert provenance["data"] == {"train_views": 4, "test_scales": [2], "init": "random"}
    assert "--set data.train_views=4" in provenance["command"]
    with pytest.raises(InputError, match=r"Unknown key 'data\.train_veiws'\. Did you mean 'train_views'"):
        ig.fit(SPLATS, "toy.npz", "3steps", data={"train_veiws": 4})
    with pytest.raises(InputError, match=r"The data cannot be 'sfm'\.\nExpected: a table"):
        ig.fit(SPLATS, "toy.npz", "3steps", data="sfm")
    with pytest.raises(InputError, match=r"changes the training data, .*\nGive it to .*: data=\{'train_views': 4\}\."):
        ig.load_method("splatting/gaussians", set={"data.train_views": 4})


def test_the_points_of_a_comparison_are_chosen_from_python(
    in_process, unpainted, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a rendered scene they are ``sfm`` unless the caller says otherwise; the hint names what ``data`` takes."""
    scene = ig.load_scene("toy.npz")
    exact = replace(scene, notes=scene.notes | {"points": EXACT_POINTS})
    monkeypatch.setattr(comparing, "open_with_progress", lambda *_: exact)
    told = ig.compare("toy.npz", [SPLATS], "2steps", out="told", data={"init": "scene", "train_views": 4})
    assert "found in the training photographs" not in capsys.readouterr().err
    assert told.record.scene_info.notes["training_data"] == "train_views = 4"
    assert "--set data.train_views=4" in told.record.command and "data.init=" in told.record.command
    with pytest.raises(InputError, match=r"Unknown key 'data\.inti'"):
        ig.compare("toy.npz", [SPLATS], "2steps", out="untold", data={"inti": "scene"})
    untold = ig.compare("toy.npz", [SPLATS], "2steps", out="untold")
    assert "(data.init=sfm)" in capsys.readouterr().err and "--set data.init=sfm" in untold.record.command
    # Fits are scored over the scene's own background, whatever they were fitted over, and so are the trivial baselines.
    black = ig.compare("toy.npz", [SPLATS], "2steps", out="black", data={"background": "black"})
    assert black.record.baselines == untold.record.baselines
    assert black.record.scene_info.background == untold.record.scene_info.background


def test_a_lone_method_renderer_or_seed_needs_no_list(in_process, unpainted) -> None:
    report = ig.compare("toy.npz", SPLATS.name, "2steps", seeds=2, out="lone", render_with="gaussian-volume/exact:steps=4")
    assert report.methods == (SPLATS.name,) and report.run(SPLATS.name, 2).finished
    assert "--seeds 2 " in report.record.command and "--render-with gaussian-volume/exact:steps=4 " in report.record.command
    again = ig.compare("toy.npz", SPLATS, "2steps", seeds=np.arange(1), out="loaded")
    assert again.run(SPLATS.name, 0).finished


def test_numpys_numbers_make_the_same_run_and_command() -> None:
    """A size of ``np.int64`` used to end in a TypeError once the folder's command was written."""
    options = {"size": np.int64(16), "test_views": np.int16(2)}
    ig.fit(SPLATS, ig.load_scene("toy.npz", **options), "2steps", seed=np.uint8(3), out="numpy", snapshots=np.int64(1))
    ig.fit(SPLATS, ig.load_scene("toy.npz", size=16, test_views=2), "2steps", seed=3, out="python", snapshots=1)
    numpys, pythons = (json.loads(Path(out, "provenance.json").read_text()) for out in ("numpy", "python"))
    assert numpys["command"] == pythons["command"].replace("python", "numpy") and "--size 16 " in numpys["command"]
    assert (numpys["options"], numpys["cell_sha256"]) == (pythons["options"], pythons["cell_sha256"])
    study = AblateRequest(study="s", out="o", size=(np.int64(8), np.int64(9)), seeds=(np.int64(1),))
    assert json.dumps([study.size, study.seeds]) == "[[8, 9], [1]]"


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: ig.compare("toy.npz", SPLATS, seeds=()), "There are no seeds."),
        (lambda: ig.compare("toy.npz", SPLATS, seeds=["a"]), "A seed cannot be 'a'."),
        (lambda: ig.compare("toy.npz", SPLATS, seeds=[-1]), "A seed cannot be -1."),
        (lambda: ig.compare("toy.npz", SPLATS, seeds=None), "A seed cannot be None."),
        (lambda: ig.fit(SPLATS, "toy.npz", seed=2**63), "A seed cannot be 9223372036854775808."),
        (lambda: ig.fit(SPLATS, "toy.npz", seed=1.5), "A seed cannot be 1.5."),
        (lambda: ig.ablate("training-views", seeds=()), "There are no seeds."),
        (lambda: ig.ablate("training-views", size=(10,)), "The size cannot be (10,)."),
        (lambda: ig.load_scene("toy.npz", size=(10,)), "The size cannot be (10,)."),
        (lambda: ig.load_scene("toy.npz", size="10"), "The size cannot be '10'."),
        (lambda: ig.load_run("none"), "none is not a run: it has no recipe.toml."),
        (lambda: ig.fit(SPLATS, "toy.npz", out="run", snapshots=-1), "The number of snapshots cannot be -1."),
        (lambda: ig.fit(SPLATS, "toy.npz", snapshots=2), "Snapshots are files of a run's folder, and this fit has none."),
        (lambda: ig.evaluate("run", "toy.npz"), "A str cannot be scored."),
    ],
)
def test_python_refuses_what_the_command_line_refuses(call: Callable[[], object], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.sentence == sentence and "\n" not in caught.value.remedy
    assert not list(Path().glob("run/*")), "nothing is left behind"


def test_a_misspelt_argument_is_one_that_fit_does_not_have() -> None:
    with pytest.raises(TypeError, match=r"fit\(\) got an unexpected keyword argument 'snapshot'"):
        ig.fit(SPLATS, "toy.npz", "2steps", out="run", snapshot=2)


def test_fits_are_scored_on_scenes_and_runs_opened_with_them() -> None:
    fit = ig.fit(SPLATS, "toy.npz", "5steps", out="run")
    scene = ig.load_scene("toy.npz")
    assert ig.evaluate(fit, scene)["psnr"] == ig.evaluate(fit.model, scene)["psnr"] == fit.scores["psnr"]
    small = ig.load_scene("toy.npz", size=12)
    run = ig.load_run("run", small)
    assert run.scene is small and run.evaluate()["psnr"] == ig.evaluate(fit, small)["psnr"] != fit.scores["psnr"]


def test_patterns_name_what_nothing_else_does_in_the_order_given(tmp_path: Path) -> None:
    from invgraphics.api.comparing import _names

    table = ig.load_method(SPLATS.name, set={"field.count": 7})
    names, optional = _names(["planes/mpi", "planes/mp*"], tmp_path)
    assert (names, optional) == (("planes/mpi",), frozenset())
    names, optional = _names([table, "planes/*", "planes/mpi", "planes/mp*"], tmp_path)
    assert names[0].startswith(SPLATS.name) or names[0].startswith(str(tmp_path))
    assert names[-1] == "planes/mpi" and len(set(names)) == len(names)
    assert optional == set(names[1:-1]) and "planes/nex" in optional


def test_refined_poses_are_scored_on_their_own_photographs_only() -> None:
    scene = ig.testing.toy_scene(views=5, size=12)
    method = ig.load_method("splatting/gaussians", set={"field.count": 30, "training.poses.optimise": True})
    fit = ig.fit(method, scene, "2steps")
    assert fit.poses is not None and ig.evaluate(fit, scene)["psnr"] > 0
    with pytest.raises(InputError, match="has refined poses of other photographs"):
        ig.evaluate(fit, scene.with_views(train=scene.train[1:]))
