"""Codes of unseen instances: found again from pictures that they made, networks frozen; and the whole way to the page."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from invgraphics.cli.main import run as command
from invgraphics.core import Context, Model, Rendering, Scene, View
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model
from invgraphics.experiments.subjects import UnseenInstances
from invgraphics.fields.conditional.field import ConditionalFieldConfig
from invgraphics.fields.neural import NeuralFieldConfig
from invgraphics.recipes.recipe import load_method
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.report.inference import build_inference_report, inference_sentences
from invgraphics.report.statistics.instances import mean_of, paired, table_of
from invgraphics.runs.inference import Inference, InstanceScores
from invgraphics.runs.study import CellRecord, StudyRecord
from invgraphics.scenes.npz_writer import save_npz
from invgraphics.testing import toy_scene
from invgraphics.tools import infer as module
from invgraphics.tools import infer_photo, inference_pictures
from invgraphics.tools.infer import InferRequest
from invgraphics.tools.infer_photo import PhotoRequest
from invgraphics.tools.recipe_check import check_recipes
from invgraphics.training.codes.inference import CodeInference, infer_codes
from invgraphics.training.codes.penalty import CodePenalty

CPU = torch.device("cpu")


def of(views: tuple[View, ...], subjects: list[int]) -> tuple[View, ...]:
    return tuple(replace(view, subject=subject) for view, subject in zip(views, subjects, strict=True))


@pytest.fixture(scope="module")
def toy_class() -> Scene:
    """Two training instances and two unseen ones, with two observed views and a test view each."""
    toy, more = toy_scene(views=8, size=12), toy_scene(views=7, size=12).train
    return replace(
        toy,
        train=of(toy.train[:4], [0, 0, 1, 1]),
        val=of(toy.train[4:5], [1]),
        observed=of(more[:4], [2, 3, 2, 3]),
        test=of(more[4:6], [2, 3]),
    )


def test_codes_are_found_again_and_nothing_else_changes(toy_class: Scene) -> None:
    torch.manual_seed(0)
    config = ConditionalFieldConfig(conditioning="film", code=2, hidden=16, layers=2, width=16, features=16, head="density")
    field = config.build(toy_class)
    with torch.no_grad():
        for layer in field.network.layers:
            layer.film[2].weight.mul_(8)  # pyright: ignore[reportIndexIssue, reportCallIssue]  # codes that matter
    model = Model(field, VolumetricConfig(StratifiedConfig(12)).build(toy_class), toy_class.bounds)
    true = torch.tensor([[0.4, 0.5], [-0.6, 0.8]])
    seen = []
    for code, view in zip(true, toy_class.observed[:2], strict=True):
        picture = replace(model, field=field.at(code)).render(view.camera, normals=False)
        image = picture.rgb / picture.alpha.clamp_min(1e-3)[..., None]
        seen.append([replace(view, image=image, alpha=picture.alpha)])
    before = {name: value.clone() for name, value in field.state_dict().items()}
    quick = CodeInference(steps=120, rays=128, lr=5e-2, weight=0.0)
    found = infer_codes(model, toy_class, seen, quick)
    assert float((found - true).abs().max()) < 0.1 < float((field.mean_code().detach() - true).abs().max())
    assert torch.equal(found, infer_codes(model, toy_class, seen, quick))
    assert all(torch.equal(value, before[name]) for name, value in field.state_dict().items())
    assert all(parameter.requires_grad for parameter in field.parameters())
    pulled = infer_codes(model, toy_class, seen, replace(quick, weight=1e3))
    assert float(pulled.abs().max()) < 0.1  # the prior's mean


def test_the_penalty_is_the_mean_square_and_needs_codes(toy_class: Scene) -> None:
    field = ConditionalFieldConfig().build(toy_class)
    renderer = VolumetricConfig().build(toy_class)
    value = CodePenalty(0.5)(field, renderer, Context(toy_class.bounds))
    assert float(value.detach()) == pytest.approx(0.5 * float((field.codes.detach() ** 2).sum()) / field.codes.numel())
    with pytest.raises(InputError, match="codes of a class"):
        CodePenalty.requires.check("penalty 'code'", NeuralFieldConfig().build(toy_class))


def test_methods_and_scenes_that_disagree_about_classes_are_refused(toy_class: Scene) -> None:
    with pytest.raises(InputError, match="volumetric/nerf fits one subject, and 'toy' is a class of 2"):
        build_model(load_method("volumetric/nerf"), toy_class, 0, CPU)
    with pytest.raises(InputError, match=r"prior/srn learns a prior .* 'toy' shows one subject") as refusal:
        build_model(load_method("prior/srn"), toy_scene(views=2, size=8), 0, CPU)
    assert "chairs, mugs" in refusal.value.remedy


def _quickly(model: Model, scene: Scene, views: Sequence[Sequence[View]], _: object) -> torch.Tensor:
    return infer_codes(model, scene, views, CodeInference(steps=3, rays=16))


@pytest.fixture(scope="module")
def fitted_study(toy_class: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a study of two tiny priors that differ in how the code chooses the field."""
    folder = tmp_path_factory.mktemp("priors")
    save_npz(toy_class, folder / "things.npz")
    small = [f"field.{key}=8" for key in ("code", "hidden", "width", "features")] + ["renderer.features=8", "renderer.width=8"]
    fit = ["fit", "prior/srn", str(folder / "things.npz"), "--budget", "4steps", "--preset", "laptop"]
    cells = []
    for conditioning in ("hypernetwork", "film"):
        sets = [*small, "batches.rays=64", "renderer.steps=3", f"field.conditioning={conditioning}"]
        words = [word for item in sets for word in ("--set", item)]
        with pytest.MonkeyPatch.context() as patch:  # its scores are not looked at
            patch.setattr("invgraphics.experiments.subjects.infer_codes", _quickly)
            assert command([*fit, *words, "--out", str(folder / "runs" / conditioning)]) == 0
        run = f"runs/{conditioning}"
        cells.append(CellRecord(id=conditioning, scene="things", method="prior/srn", seed=0, run=run, status="done"))
    missing = replace(cells[0], id="missing", run="runs/missing", status="missing")
    record = StudyRecord(name="priors", scenes=("things",), methods=("prior/srn",), cells=(*cells, missing))
    record.write(folder / StudyRecord.FILE)
    return folder


def test_from_a_study_to_a_page(fitted_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["infer", str(fitted_study), "--steps", "2", "--test-views", "1", "--no-prior", "2steps", "--out", "inferred"]
    assert command([*words, "--views", "1,2"]) == 0
    said = capsys.readouterr().out
    record = Inference.read(Path("inferred") / Inference.FILE)
    ways = ("prior/srn, hypernetwork", "prior/srn, film", "class mean", "nearest training instance", "no prior")
    made = [(one.subject, one.observed, one.how) for one in record.instances]
    assert made == [(s, n, way) for s in (2, 3) for n in (1, 2) for way in ways]
    assert all(f"against {way}:" in said for way in ways[1:])
    assert [fit.steps for fit in record.fits.values()] == [4, 4]
    page = (tmp_path / "inferred/index.html").read_text()
    for name in [f"{n}/{s:04d}.png" for s in (2, 3) for n in (1, 2)]:
        assert f"pictures/{name}" in page
        with Image.open(tmp_path / "inferred/pictures" / name) as picture:
            assert picture.size == (12 * (1 + len(ways)), 12 * 3)
    assert "psnr-over-views.svg" in page and (tmp_path / "inferred/figures/psnr-over-views.svg").is_file()
    assert check_recipes(Path("inferred")).runs == 2
    assert command([*words, "--views", "3"]) == 2 and "has 2 observed views, not 3" in capsys.readouterr().err
    assert command([*words, "--views", "1", "--steps", "3"]) == 2 and "another inference" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("azimuth", "elevation", "position", "forward"),
    [
        (0.0, 0.0, (3.5, 0.0, 0.0), (-1.0, 0.0, 0.0)),
        (90.0, 0.0, (0.5, 3.0, 0.0), (0.0, -1.0, 0.0)),
        (180.0, 30.0, (0.5 - 3 * 0.75**0.5, 0.0, 1.5), (0.75**0.5, 0.0, -0.5)),
    ],
)
def test_a_viewpoint_by_angles(toy_class: Scene, azimuth: float, elevation: float, position, forward) -> None:
    """On the sphere around the box's middle whose radius is the training cameras' mean distance, here of 2 and 4; upright."""
    views = []
    for view, place in zip(toy_class.train, ((2.5, 0.0, 0.0), (0.5, 4.0, 0.0)), strict=False):
        pose = view.camera.cam_to_world.clone()
        pose[:3, 3] = torch.tensor(place)
        views.append(replace(view, camera=view.camera.moved(pose)))
    bounds = replace(toy_class.bounds, lo=torch.tensor([-0.5, -1, -1]), hi=torch.tensor([1.5, 1, 1]))
    request = PhotoRequest(Path("run"), Path("a.png"), Path("b.png"), azimuth=azimuth, elevation=elevation)
    camera = infer_photo._camera(request, replace(toy_class, train=tuple(views), bounds=bounds))
    torch.testing.assert_close(camera.position, torch.tensor(position), atol=1e-5, rtol=0)
    torch.testing.assert_close(camera.cam_to_world[:3, 2], torch.tensor(forward), atol=1e-5, rtol=0)
    assert float(camera.cam_to_world[2, 0]) == pytest.approx(0, abs=1e-6)  # its +x is level
    assert float(camera.cam_to_world[2, 1]) < 0  # and its +y points down
    assert torch.equal(camera.focal, toy_class.train[0].camera.focal)


class OnGpu(torch.Tensor):
    """Numbers that NumPy cannot read where they are; what is computed from them is on the CPU, as pictures are."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    def numpy(self, **options):
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def cpu(self):
        return self.as_subclass(torch.Tensor)


def test_a_code_on_another_device_is_written(fitted_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(infer_photo, "infer_codes", lambda *_: [torch.full((8,), 0.5).as_subclass(OnGpu)])
    picture = str(next(fitted_study.glob("runs/film/truth/*/0000.png")))
    assert command(["infer", str(fitted_study / "runs/film"), picture, "--view", "0002-00", "--out", "photo.png"]) == 0
    assert np.load("photo.npz")["code"].tolist() == [0.5] * 8


def test_the_instance_in_a_photograph(fitted_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    picture = str(next(fitted_study.glob("runs/film/truth/*/0000.png")))
    assert command(["infer", str(fitted_study), picture]) == 2 and "holds 2 runs" in capsys.readouterr().err
    run = str(fitted_study / "runs/film")
    assert command(["infer", run, picture, "--view", "0002-00", "--steps", "2", "--out", "photo.png"]) == 0
    assert Path("photo.png").is_file() and Path("photo.npz").is_file()
    assert command(["infer", run, picture, "--view", "nowhere"]) == 2 and "no view 'nowhere'" in capsys.readouterr().err


def test_an_interrupted_inference_loses_at_most_one_instance(
    fitted_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fitted_study / "runs/hypernetwork"
    request = InferRequest(run, tmp_path / "whole", views=(1, 2), tests=1, no_prior="2steps", steps=2)
    assert "--scene '/other place/chairs'" in replace(request, scene="/other place/chairs").shell()
    whole = module.infer(request)
    drawn: list[Path] = []

    def draw(path: Path, *rest: object) -> None:
        drawn.append(path)
        if len(drawn) == 3:
            raise KeyboardInterrupt
        inference_pictures.draw_instance(path, *rest)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(module, "draw_instance", draw)
    again = replace(request, out=tmp_path / "again")
    with pytest.raises(KeyboardInterrupt):
        module.infer(again)
    kept = Inference.read(again.out / Inference.FILE)
    assert [(one.subject, one.observed) for one in kept.instances] == [(2, 1)] * 4 + [(2, 2)] * 4
    found = module.infer(again)
    assert [path.name for path in drawn] == ["0002.png", "0002.png", "0003.png", "0003.png", "0003.png"]
    assert [replace(one, seconds=None) for one in found.instances] == [replace(one, seconds=None) for one in whole.instances]
    assert module.infer(replace(again, views=(1,), instances=1)).instances == found.instances and len(drawn) == 5


def test_unseen_instances_need_their_views(toy_class: Scene) -> None:
    model = build_model(load_method("prior/srn", "laptop"), toy_class, 0, CPU)
    with pytest.raises(InputError, match="fewer than 3 observed"):
        UnseenInstances.infer(model, toy_class, views=3)
    unseen = UnseenInstances.infer(model, toy_class, config=CodeInference(steps=1, rays=16))
    assert set(unseen.models) == {2, 3} and unseen.of(toy_class.test[0]) is unseen.models[2]


def test_intervals_are_those_of_paired_instances() -> None:
    """Against scipy's paired t-test over the instances' means."""
    from scipy.stats import ttest_rel

    values = {"a": [(20.0, 22.0), (25.0, None), (30.0, 31.0)], "b": [(19.0, 20.0), (24.5, None), (27.0, 28.0)]}
    scores = tuple(
        InstanceScores(subject=s, observed=1, how=how, quality={"psnr": row}, input_psnr=0.0)
        for how, rows in values.items()
        for s, row in enumerate(rows)
    )
    record = Inference(scene="x", runs={}, command="", date="", pictures=(), columns={}, instances=scores)
    gain = paired(record, "psnr", 1, ("a", "b"))
    test = ttest_rel([21.0, 25.0, 30.5], [19.5, 24.5, 27.5])
    assert gain is not None and gain.p == pytest.approx(test.pvalue) and gain.mean == pytest.approx(5 / 3)
    assert (gain.low, gain.high) == pytest.approx(tuple(test.confidence_interval()))
    cell = table_of(record, "psnr", ["b", "a"])["a"][1]
    assert cell.gain == gain and cell.mean == pytest.approx(76.5 / 3) and cell.certain == (test.pvalue < 0.05)


def inferred(values: dict[str, dict[str, list[tuple[float | None, ...]]]], counts: tuple[int, ...] = (1,)) -> Inference:
    """Record of made-up scores: method -> metric -> instance -> test views, the first method a prior."""
    scores = tuple(
        InstanceScores(
            subject=s, observed=n, how=how, quality={metric: rows[s] for metric, rows in metrics.items()}, input_psnr=20.0
        )
        for how, metrics in values.items()
        for s in range(len(metrics["psnr"]))
        for n in counts
    )
    runs, given = {next(iter(values)): "runs/x"}, {"command": "", "date": "", "pictures": (), "columns": {}}
    return Inference(scene="chairs", runs=runs, instances=scores, **given)


@pytest.mark.parametrize(("loser", "bold"), [("prior", True), ("B", False), (None, True)])
def test_who_lacks_instances_is_not_called_better(tmp_path: Path, loser: str | None, bold: bool) -> None:
    """B is a decibel and five degrees better where both have scores; the three hard instances are not among them."""
    easy = {"prior": {"psnr": 20.0, "normal_deg": 25.0}, "B": {"psnr": 21.0, "normal_deg": 20.0}}
    values = {
        how: {
            metric: [(None, None) if how == loser and s >= 5 else (value + 0.01 * s * (how == "B"), value) for s in range(8)]
            for metric, value in metrics.items()
        }
        for how, metrics in easy.items()
    }
    record = inferred(values, (1, 2))
    for metric in ("psnr", "normal_deg"):
        cell = table_of(record, metric, ["prior", "B"])["B"][1]
        assert cell.gain is not None and cell.gain.p is not None and cell.gain.p < 1e-3 and cell.certain is bold
    record.write(tmp_path / Inference.FILE)
    (sentence,), page = inference_sentences(tmp_path), build_inference_report(tmp_path)
    if loser == "B":
        assert sentence == "From 1 view, prior against B: not compared, since B lacks scores of 3 instances."
        assert "21.01 (5 of 8)" in page.read_text()
    else:
        assert "dB of PSNR on other views" in sentence and ("where prior lacks scores of 3 instances" in sentence) == bool(
            loser
        )
    text = page.with_suffix(".md").read_text()
    assert ("3 instances incomplete" in text) == (loser is not None) and ("**+1.0" in text) is bold


def test_a_single_view_that_is_lost_is_lost_and_a_perfect_one_counts() -> None:
    rows = [(20.0, 21.0), (22.0, 23.0), (24.0, 25.5)]
    record = inferred({"prior": {"psnr": rows}, "B": {"psnr": [(26.0, 27.0), (28.0, 29.1), (30.0, None)]}})
    assert not table_of(record, "psnr", ["prior", "B"])["B"][1].certain
    record = inferred({"prior": {"psnr": rows}, "B": {"psnr": []}})
    assert table_of(record, "psnr", ["prior", "B"])["B"] == {1: replace(table_of(record, "psnr", ["B"])["B"][1], lost=(3, 0))}
    perfect = mean_of(inferred({"prior": {"psnr": [(np.inf, 20.0)]}}), "psnr", 1, "prior")
    assert perfect is not None and perfect.mean == 60.0  # equal pictures count as 100 dB


def test_a_picture_that_is_not_finite_ends_no_inference(toy_class: Scene) -> None:
    class Broken:
        def render(self, camera, normals: bool = True) -> Rendering:
            rgb = torch.full((camera.height, camera.width, 3), torch.nan)
            return Rendering(rgb, torch.ones(rgb.shape[:2]), torch.ones(rgb.shape[:2]))

    methods = SimpleNamespace(scene=toy_class, _request=SimpleNamespace(tests=1))
    views = [view for view in toy_class.observed if view.subject == 2]
    found = module._InferenceMethods.score(methods, Broken(), views, "prior", 1.0)  # pyright: ignore[reportArgumentType]
    assert found.input_psnr is None and found.quality["psnr"] == (None,)
