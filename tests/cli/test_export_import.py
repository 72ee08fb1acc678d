"""A run leaves as a file and comes back as a run; what a format loses is said."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
import torch
from plyfile import PlyData
from scipy.spatial.transform import Rotation
from training_fixtures import SMALL

from invgraphics.cli import main
from invgraphics.core import Gaussians, Scene, harmonics
from invgraphics.errors import InputError
from invgraphics.experiments import build, fitted
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.fields.similarity import transform_gaussians
from invgraphics.formats.base import read_gaussians, write_gaussians
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.runs.run import read_run
from invgraphics.tools import EXPORTERS
from invgraphics.tools.export import ExportRequest, decibels, export_run
from invgraphics.tools.file_frames import file_from_world
from invgraphics.tools.import_gaussians import ImportRequest, import_run

METHOD = "splatting/gaussians"


@pytest.fixture(scope="module")
def run(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "fitted"
    overrides = tuple(SMALL[METHOD])
    return fit_run(FitRequest(method=METHOD, scene=str(toy_folder), out=str(out), budget="60steps", overrides=overrides))


def _quality(folder: Path) -> dict[str, float]:
    return {name: entry["mean"] for name, entry in json.loads((folder / "scores.json").read_text())["quality"].items()}


def test_gaussians_that_are_shown_as_a_density_are_exported(toy_folder: Path, tmp_path: Path) -> None:
    """Compared with the run's own pictures, which march rays through them."""
    small = ("field.count=40", "field.max_init=40", "field.sh_degree=0", "renderer.sampler.resolution=16", "batches.rays=32")
    request = {"method": "volumetric/gaussians", "scene": str(toy_folder), "budget": "2steps", "overrides": small}
    run = fit_run(FitRequest(**request, out=str(tmp_path / "run")))
    exported = export_run(ExportRequest(run, "ply", tmp_path / "model.ply"))
    assert any("PSNR" in name for name in exported.facts), exported.facts
    assert "plain splatting" in exported.facts["drawn by"]


def test_discs_are_exported_as_flat_ellipsoids_and_compared_as_viewers_show_them(toy_folder: Path, tmp_path: Path) -> None:
    """The loss is that between the run's pictures and those of a run that the file is imported as."""
    request = {"method": METHOD, "scene": str(toy_folder), "budget": "30steps"}
    small = (*SMALL[METHOD], "renderer.shape=disc", "renderer.dilation=0.5")
    run = fit_run(FitRequest(**request, out=str(tmp_path / "run"), overrides=small))
    opened = fitted.open_fitted(run)
    with torch.no_grad():
        opened.model.field.log_scales[:, 2] = 0.0  # drawn by no disc, but as long as the scene in an ellipsoid
    checkpoint.save(run / CHECKPOINT, opened.model.state_dict())
    exported = export_run(ExportRequest(run, "ply", tmp_path / "a.ply"))
    written = read_gaussians(tmp_path / "a.ply")[1].gaussians.scales
    assert bool((written[:, 2] < 0.01 * written[:, :2].amin(dim=1)).all())
    imported = FitRequest(**request, out=str(tmp_path / "b"), overrides=("renderer.dilation=0.5",))
    back = fitted.open_fitted(import_run(ImportRequest(file=str(tmp_path / "a.ply"), run=imported)))
    scene, psnr = opened.scene, []
    for view in scene.test:
        ours, theirs = (one.model.render(view.camera).over(scene.background).clamp(0, 1) for one in (opened, back))
        psnr.append(-10 * float((ours - theirs).square().mean().log10()))
    said = float(exported.facts["PSNR to the run's own pictures"].split()[0])
    assert said == pytest.approx(sum(psnr) / len(psnr), abs=0.1) and 10 < said < 60
    assert "0.5 px²" in exported.facts["drawn by"]


@pytest.mark.parametrize(("to", "least"), [("ply", 120.0), ("splat", 50.0), ("spz", 50.0)])  # measured: 157, 57, 55
def test_there_and_back(run: Path, toy_folder: Path, tmp_path: Path, capsys, to: str, least: float) -> None:
    file, back = tmp_path / f"model.{to}", tmp_path / "back"
    assert main.run(["export", str(run), "--to", to, "--out", str(file)]) == main.DONE
    said = capsys.readouterr().out
    loss = float(re.search(r"PSNR to the run's own pictures +([\d.]+) dB on average", said).group(1))
    assert loss > least
    assert str(file.stat().st_size) in said and said.splitlines()[-1] == str(file)
    assert [one.name for one in tmp_path.iterdir()] == [file.name]

    assert main.run(["import", str(file), "--scene", str(toy_folder), "--out", str(back)]) == main.DONE
    assert "test views" in capsys.readouterr().out
    ours, theirs = _quality(run), _quality(back)
    assert set(ours) == set(theirs)
    assert abs(ours["psnr"] - theirs["psnr"]) < {"ply": 1e-4, "splat": 0.1, "spz": 0.1}[to]


def test_a_perfect_view_does_not_make_the_average_infinite() -> None:
    """Squared errors of 0, 1e-9 and 1e-10 are 3.67e-10 in the mean."""
    assert decibels([math.inf, 90.0, 100.0]) == "94.4 dB on average over 3 test views, 90.0 dB at worst"
    assert decibels([50.0, 50.0]) == "50.0 dB on average over 2 test views, 50.0 dB at worst"
    assert decibels([math.inf, math.inf]) == "equal"


@pytest.mark.parametrize(("option", "degree"), [([], 3), (["--sh-degree", "1"], 1), (["--sh-degree", "0"], 0)])
def test_ply_has_the_bands_that_other_loaders_insist_on(run: Path, tmp_path: Path, capsys, option, degree: int) -> None:
    """3DGS's own loader asserts 45 properties f_rest_*, channel by channel; the run has degree 1."""
    file = tmp_path / "new folder" / "model.ply"
    assert main.run(["export", str(run), "--to", "ply", "--out", str(file), *option]) == main.DONE
    vertex = PlyData.read(str(file))["vertex"].data
    rest = [name for name in vertex.dtype.names if name.startswith("f_rest_")]
    per_channel = (degree + 1) ** 2 - 1
    assert len(rest) == 3 * per_channel
    filled = {index for index, name in enumerate(rest) if vertex[name].any()}
    assert filled == {channel * per_channel + i for channel in range(3) for i in range(min(3, per_channel))}
    assert f"SH degree                        {degree}" in capsys.readouterr().out
    assert main.run(["export", str(run), "--to", "ply", "--out", str(file), "--sh-degree", "4"]) == main.BAD_INPUT


def test_an_imported_run_is_a_run(run: Path, toy_folder: Path, tmp_path: Path, capsys) -> None:
    file, back = tmp_path / "model.ply", tmp_path / "back"
    export_run(ExportRequest(run, "ply", file))
    words = ["--scene", str(toy_folder), "--out", str(back), "--set", "renderer.dilation=0.2", "--test-views", "2"]
    assert main.run(["import", str(file), *words]) == main.DONE
    provenance = json.loads((back / "provenance.json").read_text())
    assert provenance["imported"]["sha256"] == sha256(file.read_bytes()).hexdigest()
    assert (provenance["imported"]["format"], provenance["imported"]["sh_degree"]) == ("ply", 1)
    assert provenance["budget"] == "imported" and "dilation = 0.2" in (back / "recipe.toml").read_text()
    missing = {one.name for one in run.iterdir()} - {one.name for one in back.iterdir()}
    assert not missing, "an imported run has the files of a fitted one"
    assert read_run(back).history[0].step == 0

    scores = (back / "scores.json").read_text()
    assert main.run(["evaluate", str(back)]) == main.DONE
    assert json.loads((back / "scores.json").read_text())["quality"] == json.loads(scores)["quality"]
    command = provenance["command"].replace(str(back), str(tmp_path / "again"))
    capsys.readouterr()
    assert main.run(command.split()[1:]) == main.DONE, "the recorded command makes the same run"
    assert _quality(tmp_path / "again") == _quality(back)


def _import(file: Path, scene: Path, out: Path, **placed: str) -> ImportRequest:
    return ImportRequest(file=str(file), run=FitRequest(scene=str(scene), method=METHOD, out=str(out)), **placed)


def test_reports_show_it_beside_fits(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    export_run(ExportRequest(run, "spz", tmp_path / "model.spz"))
    back = import_run(_import(tmp_path / "model.spz", toy_folder, tmp_path / "b"))
    assert main.run(["report", str(run), str(back), "--out", str(tmp_path / "page")]) == main.DONE
    text = (tmp_path / "page" / "index.md").read_text()
    assert "splatting/gaussians (laptop)" in text and "splatting/gaussians (imported)" in text


def test_exports_are_in_the_world(run: Path, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene whose local frame is half the size of its world, turned and shifted, leaves and comes back."""
    local = read_gaussians(_exported(run, tmp_path / "local.ply"))[1].gaussians
    similarity = torch.eye(4)
    turn = torch.from_numpy(Rotation.random(random_state=4).as_matrix()).float()
    similarity[:3, :3], similarity[:3, 3] = 2 * turn, torch.tensor([1.0, -2.0, 3.0])

    def moved(open_scene: Callable[..., Scene]) -> Callable[..., Scene]:
        return lambda *words: replace(open_scene(*words), world_from_local=similarity)

    for module in (fitted, build):
        monkeypatch.setattr(module, "open_scene", moved(module.open_scene))
    world = read_gaussians(_exported(run, tmp_path / "world.ply"))[1].gaussians
    expected = 2 * local.means @ turn.T + similarity[:3, 3]
    assert torch.allclose(world.means, expected, atol=1e-5)
    assert torch.allclose(world.scales, 2 * local.scales, rtol=1e-5)
    # What the file is seen to be, by scipy's rotations: shapes and colours turn along, which a round trip would not show.
    ours, theirs = (_covariances(gaussians) for gaussians in (world, local))
    assert torch.allclose(ours, 4 * turn.double() @ theirs @ turn.double().T, atol=1e-6)
    directions = torch.nn.functional.normalize(torch.randn(len(local), 3, generator=torch.Generator().manual_seed(0)), dim=1)
    seen, expected = harmonics.evaluate(world.sh, directions @ turn.T), harmonics.evaluate(local.sh, directions)
    assert torch.allclose(seen, expected, atol=1e-4)
    assert float(expected.std(dim=0).min()) > 0.01
    back = import_run(_import(tmp_path / "world.ply", toy_folder, tmp_path / "b"))
    assert _quality(back)["psnr"] == pytest.approx(_quality(run)["psnr"], abs=1e-3)


def _covariances(gaussians: Gaussians) -> torch.Tensor:
    rotations = Rotation.from_quat(gaussians.quaternions.double().roll(-1, 1).numpy()).as_matrix()  # scipy's have w last
    factors = torch.from_numpy(rotations) * gaussians.scales.double()[:, None]
    return factors @ factors.mT


def _exported(run: Path, out: Path, to: str = "ply", **more: str) -> Path:
    return export_run(ExportRequest(run, to, out, **more)).path


def test_axes(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    """SPZ is right, up, back: of a z-up world (x, z, -y), of one that counts as right, down, forward (x, -y, -z)."""
    x, y, z = read_gaussians(_exported(run, tmp_path / "a.ply"))[1].gaussians.means.unbind(dim=1)
    for world, expected in (("z-up", [x, z, -y]), ("opencv", [x, -y, -z]), ("opengl", [x, y, z])):
        file = _exported(run, tmp_path / "a.spz", "spz", world=world)
        assert torch.allclose(read_gaussians(file)[1].gaussians.means, torch.stack(expected, dim=1), atol=1e-4)
        request = _import(file, toy_folder, tmp_path / world, world=world)
        assert abs(_quality(import_run(request))["psnr"] - _quality(run)["psnr"]) < 0.3
    splats = read_gaussians(tmp_path / "a.spz")[1]
    write_gaussians(tmp_path / "b.ply", "ply", splats)  # a file that does not say that it is right, up, back
    request = _import(tmp_path / "b.ply", toy_folder, tmp_path / "b")
    assert _quality(import_run(replace(request, frame="opencv")))["psnr"] == pytest.approx(_quality(run)["psnr"], abs=0.3)
    turned = import_run(_import(tmp_path / "b.ply", toy_folder, tmp_path / "c", frame="opengl"))
    assert _quality(turned)["psnr"] < _quality(run)["psnr"] - 0.5


def test_the_comment_says_where_a_ply_came_from(run: Path, tmp_path: Path) -> None:
    comments = PlyData.read(_exported(run, tmp_path / "a.ply")).comments
    assert len(comments) == 1 and "axes of the data set's world" in comments[0]


@pytest.mark.parametrize(("to", "kept", "told"), [("ply", True, True), ("splat", None, True), ("spz", True, False)])
def test_an_antialiased_model_says_so_where_its_format_can(
    toy_folder: Path, tmp_path: Path, capsys, to: str, kept: bool | None, told: bool
) -> None:
    fitted = ["fit", "splatting/gaussians-mip", str(toy_folder), "--budget", "1steps", "--out", str(tmp_path / "run")]
    small = [word for change in SMALL[METHOD] for word in ("--set", change)]
    assert main.run([*fitted, *small, "--kernels", "reference"]) == main.DONE
    assert main.run(["export", str(tmp_path / "run"), "--to", to, "--out", str(tmp_path / f"model.{to}")]) == main.DONE
    said = capsys.readouterr().out
    assert ("opacity compensation" in said) == told and "0.1 px² where it is shown" in said
    assert read_gaussians(tmp_path / f"model.{to}")[1].antialiased == kept
    back = ["import", str(tmp_path / f"model.{to}"), "--scene", str(toy_folder), "--out", str(tmp_path / "back")]
    assert main.run(back) == main.DONE
    advice = capsys.readouterr().err
    assert ("--set renderer.antialiased=true" in advice) == bool(kept)
    assert ("--set renderer.dilation=0.1" in advice) == (to == "ply")
    if to == "ply":
        same = [word for setting in re.findall(r"--set (\S+)", advice) for word in ("--set", setting)]
        assert main.run([*back[:-1], str(tmp_path / "same"), *same]) == main.DONE
        assert not capsys.readouterr().err.count("The file says")
        assert _quality(tmp_path / "same")["psnr"] == pytest.approx(_quality(tmp_path / "run")["psnr"], abs=1e-3)


def test_what_cannot_be_exported(run: Path, toy_folder: Path, tmp_path: Path, capsys) -> None:
    neural = tmp_path / "neural"
    (tmp_path / "file").touch()
    overrides = tuple(SMALL["volumetric/hash"])
    fit_run(FitRequest(method="volumetric/hash", scene=str(toy_folder), out=str(neural), budget="1steps", overrides=overrides))
    capsys.readouterr()
    for words, sentence in (
        ([str(neural), "--to", "ply", "--out", str(tmp_path / "a.ply")], "has no Gaussians to write as ply"),
        ([str(neural), "--to", "spz", "--out", str(tmp_path / "a.spz")], f"convert {neural} --to gaussians --out RUN"),
        ([str(run), "--to", "obj", "--out", str(tmp_path / "a.obj")], "--to cannot be 'obj'"),
        ([str(tmp_path), "--to", "ply", "--out", str(tmp_path / "a.ply")], "is not a run"),
        ([str(run), "--to", "ply", "--out", str(tmp_path / "file" / "a.ply")], "cannot be made"),
        ([str(run), "--to", "spz", "--out", str(tmp_path / "a.spz"), "--world", "up"], "'up' names no axes"),
    ):
        assert main.run(["export", *words]) == main.BAD_INPUT
        said = capsys.readouterr().err.splitlines()
        assert any(sentence in line for line in said) and len(said) <= main.MOST_LINES
    assert not list(tmp_path.glob("a.*"))


def test_what_cannot_be_imported(run: Path, toy_folder: Path, tmp_path: Path, capsys) -> None:
    file = _exported(run, tmp_path / "a.ply")
    broken = tmp_path / "broken.ply"
    broken.write_bytes(file.read_bytes()[:-9])
    out = ["--out", str(tmp_path / "b")]
    scene = ["--scene", str(toy_folder)]
    capsys.readouterr()
    for words, sentence in (
        ([str(broken), *scene, *out], "is cut off"),
        ([str(tmp_path / "none.ply"), *scene, *out], "There is no file"),
        ([str(file), *scene, "--out", str(run)], "already holds a run"),
        ([str(file), *scene, *out, "--method", "volumetric/hash"], "fits no Gaussians"),
        ([str(file), *scene, *out, "--method", "none/such"], "There is no method"),
        ([str(file), *scene, *out, "--frame", "RUF"], "no right-handed frame"),
        ([str(file), "--scene", "no-such-scene", *out], "neither a built-in scene nor"),
        ([str(file), *scene, *out, "--set", "renderer.none=1"], "none"),
        ([str(file), *scene, *out, "--protocol", "none"], "protocol"),
    ):
        assert main.run(["import", *words]) == main.BAD_INPUT, sentence
        said = capsys.readouterr().err.splitlines()
        assert any(sentence in line for line in said) and len(said) <= main.MOST_LINES
    assert not (tmp_path / "b").exists()


def test_a_gaussian_too_far_for_a_format_is_refused(run: Path, tmp_path: Path) -> None:
    splats = read_gaussians(_exported(run, tmp_path / "a.ply"))[1]
    far = replace(splats.gaussians, means=splats.gaussians.means + 1e8)
    with pytest.raises(InputError, match="SPZ holds up to"):
        write_gaussians(tmp_path / "a.spz", "spz", replace(splats, gaussians=far))
    assert set(EXPORTERS) == {"ply", "splat", "spz", "mesh", "mpi"}


def test_a_file_in_nerfstudio_s_frame_is_placed_by_its_transform(
    run: Path, toy_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Turned, shifted and scaled as nerfstudio does; without the similarity a warning says that little of it can be seen."""
    file, placed = tmp_path / "model.ply", tmp_path / "splat.ply"
    export_run(ExportRequest(run, "ply", file))
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix())
    matrix[:3, 3] = torch.tensor([40.0, -20.0, 70.0])
    scaled = matrix.clone()
    scaled[:3] *= 0.125
    splats = read_gaussians(file)[1]
    write_gaussians(placed, "ply", replace(splats, gaussians=transform_gaussians(splats.gaussians, scaled.float())))
    table = {"transform": matrix[:3].tolist(), "scale": 0.125}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(table))
    words = ["--scene", str(toy_folder), "--test-views", "2"]
    assert main.run(["import", str(file), *words, "--out", str(tmp_path / "own")]) == main.DONE
    assert "Warning" not in capsys.readouterr().err
    transform = ["--transform", str(tmp_path / "dataparser_transforms.json")]
    assert main.run(["import", str(placed), *words, *transform, "--out", str(tmp_path / "theirs")]) == main.DONE
    assert "Warning" not in capsys.readouterr().err
    own, theirs = (_quality(tmp_path / name)["psnr"] for name in ("own", "theirs"))
    assert theirs == pytest.approx(own, abs=0.05)
    notes = json.loads((tmp_path / "theirs" / "provenance.json").read_text())["imported"]["notes"]
    assert any("0.125" in note for note in notes)
    assert main.run(["import", str(placed), *words, "--out", str(tmp_path / "lost")]) == main.DONE
    assert re.search(r"Warning: \d% of the Gaussians lie in a training picture; it may be in a frame", capsys.readouterr().err)
    assert _quality(tmp_path / "lost")["psnr"] < own - 3
    mirrored = {"transform": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}
    wrong = (({"scale": 1}, "is no finite matrix"), (table | {"scale": 0}, "is 0, no positive number"), (mirrored, "mirrors"))
    for bad, said in wrong:
        (tmp_path / "bad.json").write_text(json.dumps(bad))
        assert main.run(["import", str(placed), *words, "--transform", str(tmp_path / "bad.json")]) == main.BAD_INPUT
        assert said in capsys.readouterr().err
    assert main.run(["import", str(placed), *words, *transform, "--frame", "z-up"]) == main.BAD_INPUT


def test_a_data_set_s_applied_transform_is_taken_out_of_nerfstudio_s(tmp_path: Path) -> None:
    """A point of the world in which COLMAP placed the photographs goes to one place along both ways."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.0, 0.5, 1.0]).as_matrix())
    applied = torch.eye(4, dtype=torch.float64)[[1, 0, 2, 3]]
    applied[2, 2] = -1
    rest = turn.clone()
    rest[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    (tmp_path / "transforms.json").write_text(json.dumps({"applied_transform": applied[:3].tolist(), "applied_scale": 0.5}))
    saved = {"transform": (rest @ applied)[:3].tolist(), "scale": 4.0 * 0.5}
    (tmp_path / "saved.json").write_text(json.dumps(saved))
    expected = rest.clone()
    expected[:3] *= 4.0
    torch.testing.assert_close(file_from_world(tmp_path / "saved.json", str(tmp_path)), expected)
