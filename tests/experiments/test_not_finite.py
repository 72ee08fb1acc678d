"""Values that are not finite: named where a fit meets them, refused where a run is opened, never scored."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from training_fixtures import SMALL

import invgraphics as ig
from invgraphics.core import Context, Rendering
from invgraphics.errors import InputError, NumericalError
from invgraphics.experiments.evaluate import evaluate_run, score_model
from invgraphics.experiments.fitted import open_fitted
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run, make_run
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT, RunFolder
from invgraphics.tools.export import ExportRequest, export_run
from invgraphics.tools.film import FilmRequest, film
from invgraphics.training.fit import Fit
from invgraphics.viewer.loaded_run import open_run

METHODS = {"nerf": "volumetric/nerf", "hash": "volumetric/hash", "splats": "splatting/gaussians"}


def request_of(toy_folder: Path, out: Path, family: str, **more) -> FitRequest:
    method = METHODS[family]
    base = {"method": method, "scene": str(toy_folder), "out": str(out), "budget": "12steps", "overrides": tuple(SMALL[method])}
    return FitRequest(**base | {"snapshots": 2} | more)


@pytest.fixture(scope="module", params=list(METHODS))
def fitted(request: pytest.FixtureRequest, toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A family and a finished run of it."""
    out = tmp_path_factory.mktemp(request.param) / "run"
    return request.param, fit_run(request_of(toy_folder, out, request.param))


@pytest.fixture
def run(fitted: tuple[str, Path], tmp_path: Path) -> tuple[str, Path]:
    """The same in a folder that may be damaged."""
    return fitted[0], Path(shutil.copytree(fitted[1], tmp_path / "run"))


def floats(tensors: dict[str, torch.Tensor]) -> list[str]:
    """Keys of the tensors of several floating-point numbers."""
    return [key for key, value in tensors.items() if value.is_floating_point() and value.numel() > 1]


def poison(path: Path, key: Callable[[str], bool], value: float = torch.nan) -> str:
    """Put a number into the middle of the first tensor of floats whose key qualifies; returns its name in sentences."""
    tensors = load_file(path)
    name = min(filter(key, floats(tensors)))
    tensors[name].view(-1)[tensors[name].numel() // 2] = value
    save_file(tensors, path)
    return name.replace("|", ".")


def test_a_poisoned_checkpoint_is_refused_wherever_a_run_is_opened(run, toy_folder: Path, tmp_path: Path) -> None:
    family, folder = run
    name = poison(folder / CHECKPOINT, lambda key: key.startswith("field|") and key[-2:] not in ("lo", "hi"))
    (folder / "scores.json").unlink()
    before = sorted(tmp_path.rglob("*"))
    readers = {
        "evaluate": lambda: evaluate_run(folder),
        "load_run": lambda: ig.load_run(folder),
        "render": lambda: film(FilmRequest(folder, tmp_path / "a.mp4", "orbit", frames=1)),
        "export": lambda: export_run(ExportRequest(folder, "ply" if family == "splats" else "mesh", tmp_path / "a.ply")),
        "view": lambda: open_run(folder, None, False, print),
        "resume": lambda: fit_run(request_of(toy_folder, folder, family, existing="resume")),
    }
    for what, read in readers.items():
        with pytest.raises(InputError, match=r"1 of [\d,]+ values of '") as caught:
            read()
        assert f"'{name}' is not finite" in caught.value.sentence and caught.value.remedy, what
    assert {path.name for path in set(tmp_path.rglob("*")) - set(before)} <= {".lock"}


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("section", ["optimiser|", "renderer|", "hooks|"])
def test_every_section_of_a_checkpoint_is_looked_at(run, section: str, value: float) -> None:
    path = run[1] / CHECKPOINT
    if not any(key.startswith(section) for key in floats(load_file(path))):
        pytest.skip(f"{run[0]} keeps no numbers in {section}")
    name = poison(path, lambda key: key.startswith(section), value)
    with pytest.raises(InputError, match="is not finite") as caught:
        checkpoint.load(path)
    assert f"'{name}'" in caught.value.sentence


def test_a_poisoned_snapshot_makes_no_film(run, tmp_path: Path) -> None:
    poison(RunFolder(run[1]).snapshots[1], lambda key: key.startswith("field|"))
    with pytest.raises(InputError, match=r"0001\.safetensors cannot be used"):
        film(FilmRequest(run[1], tmp_path / "a.mp4", "timelapse"))


@pytest.mark.parametrize("family", METHODS)
def test_a_fit_stops_where_it_leaves_the_finite_numbers_and_keeps_its_checkpoint(
    toy_folder: Path, tmp_path: Path, family: str
) -> None:
    """A renderer may show nothing of it: splats at NaN are culled, and no ray meets an unused entry of a hash table."""
    folder, kept = RunFolder(tmp_path / "run"), []

    def disturb(fit: Fit) -> None:
        if fit.steps == 4:
            kept.append(folder.checkpoint.read_bytes())
            with torch.no_grad():
                next(fit.model.field.parameters()).view(-1)[-1] = torch.nan

    job = Job.of(request_of(toy_folder, folder.root, family, budget="100steps", checkpoint_every="2steps"))
    with pytest.raises(NumericalError, match=r"^Step [456]: 1 of [\d,]+ values of 'field\.\w.*the fit stops here\.$"):
        make_run(job, None, disturb)
    assert kept == [folder.checkpoint.read_bytes()]
    assert not folder.finished
    assert int(checkpoint.load(folder.checkpoint)["fit"]["steps"]) == 4


def test_nothing_that_is_not_finite_is_written_over_a_checkpoint(tmp_path: Path) -> None:
    path, good = tmp_path / "a.safetensors", {"field": {"means": torch.zeros(4)}}
    checkpoint.save(path, good)
    before = path.read_bytes()
    with pytest.raises(NumericalError, match=r"2 of 4 values of 'field\.means' are not finite \(and 1 more tensor\)"):
        checkpoint.save(path, {"field": {"means": torch.tensor([1, torch.nan, torch.inf, 2]), "sh": torch.tensor([torch.nan])}})
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_a_model_in_memory_is_looked_at_before_it_is_scored(fitted) -> None:
    opened = open_fitted(fitted[1])
    with torch.no_grad():
        next(opened.model.field.parameters()).view(-1)[0] = torch.nan
    with pytest.raises(NumericalError, match=r"cannot be scored: 1 of [\d,]+ values of 'field\."):
        score_model(opened.model, opened.scene, "default", "mine")


def test_scales_that_overflow_are_not_scored(toy_folder: Path, tmp_path: Path) -> None:
    """Finite parameters, infinite Gaussians, which the rasteriser culls."""
    opened = open_fitted(fit_run(request_of(toy_folder, tmp_path / "run", "splats", budget="1steps")))
    with torch.no_grad():
        opened.model.field.log_scales[0] = 1000.0
    with pytest.raises(NumericalError, match=r"values of 'gaussians\.scales' are not finite"):
        score_model(opened.model, opened.scene, "default", "mine")


def test_pixels_that_are_not_finite_are_counted_for_their_view(fitted, monkeypatch, capsys) -> None:
    opened, shown = open_fitted(fitted[1]), []
    render = type(opened.model.renderer).render_image

    def broken(self, field, camera, ctx: Context) -> tuple[Rendering, object]:
        picture, trace = render(self, field, camera, ctx)
        shown.append(camera)
        if camera.width > 16 and torch.equal(camera.cam_to_world, opened.scene.test[1].camera.cam_to_world):
            picture.rgb[3, 4:6] = torch.nan
        return picture, trace

    monkeypatch.setattr(type(opened.model.renderer), "render_image", broken)
    scores = score_model(opened.model, opened.scene, "default", "mine")
    view = opened.scene.test[1]
    sentence = f"view {view.name}: the predicted colour or alpha is not finite at 2 of {view.camera.width * view.camera.height}"
    assert shown and "psnr" not in scores.quality
    assert scores.skipped["psnr"].startswith(sentence)
    assert f"Warning: {sentence}" in capsys.readouterr().err
