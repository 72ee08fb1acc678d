"""Saved pictures scored again: equal to the first scores where they should be, else skipped or refused in words."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio
from training_fixtures import SMALL

from invgraphics.errors import InputError
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.metrics.conventions import PROTOCOLS
from invgraphics.metrics.protocols import protocol_named
from invgraphics.report.data.comparison import check_comparable
from invgraphics.runs.run import read_run
from invgraphics.tools.predictions import open_pictures
from invgraphics.tools.rescore import check_same_truth, protocols_named, rescore, why_unsuited
from invgraphics.tools.rescoring import Rescored, best_sets, labels, rows_of, spread_of, write_scores, write_tables

METHOD = "splatting/gaussians"
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def fitted(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    request = {"method": METHOD, "scene": str(toy_folder), "budget": "30steps", "overrides": tuple(SMALL[METHOD])}
    return fit_run(FitRequest(out=str(tmp_path_factory.mktemp("runs") / "a"), **request))


@pytest.fixture
def run(fitted: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(fitted, tmp_path / "run"))


@pytest.fixture
def folders(tmp_path: Path):
    """Make folders of predictions and truth: random pictures of the given modes."""
    rng = np.random.default_rng(3)

    def make(modes: tuple[str, str] = ("RGB", "RGB"), names: tuple[str, str] = ("pred", "truth"), count: int = 2) -> list[Path]:
        made = []
        for mode, name in zip(modes, names, strict=True):
            folder = tmp_path / name
            folder.mkdir(parents=True)
            for index in range(count):
                pixels = rng.integers(0, 256, (16, 20, len(mode)), dtype=np.uint8)
                Image.fromarray(pixels, mode).save(folder / f"{index:03d}.png")
            made.append(folder)
        return made

    return make


def scores_of(folder: Path, name: str, **more) -> dict:
    return rescore([open_pictures(folder, **more)], protocols_named(name))[0].scores[name]


def read(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def test_our_protocol_gives_the_very_scores_of_the_fit(run: Path) -> None:
    first = json.loads((run / "scores.json").read_text())["quality"]
    again = scores_of(run, "default").quality
    assert set(again) == {"psnr", "ssim"}  # the others stand in the run's own scores
    for metric, entry in again.items():
        assert entry.per_view == pytest.approx(first[metric]["per_view"], abs=1e-9)


def test_a_run_keeps_what_other_backgrounds_need(run: Path) -> None:
    """Truth over black from the saved arrays equals that from the data set's own RGBA files."""
    pictures = open_pictures(run)
    assert pictures.transparency == "open" and pictures.background == WHITE
    scene = Path(json.loads((run / "provenance.json").read_text())["scene"])
    for index, name in enumerate(pictures.names):
        rgba = read(scene / "test" / f"{Path(name).name}.png")
        view = pictures.truth(index)
        assert np.array_equal(view.image.numpy(), rgba[..., :3]) and np.array_equal(view.alpha.numpy(), rgba[..., 3])
    assert pictures.sha256 == json.loads((run / "provenance.json").read_text())["truth_sha256"]


def test_a_tools_convention_from_the_files_alone(run: Path) -> None:
    """3DGS's metrics.py on a run, from its arrays by hand."""
    got = scores_of(run, "3dgs-metrics").quality["psnr"].per_view
    truth_folder = run / json.loads((run / "provenance.json").read_text())["truth"]
    assert len(got) == 3
    for index, value in enumerate(got):
        saved, truth = (np.load(folder / f"{index:04d}.npz") for folder in (run / "test", truth_folder))
        image = (saved["rgb"].astype(np.float64) * 255).clip(0, 255).round()
        colour, alpha = truth["rgb"] / 255.0, (truth["alpha"].astype(np.float64) * 255).round()[..., None] / 255
        expected = peak_signal_noise_ratio((colour * alpha * 255.0).astype(np.uint8), image.astype(np.uint8), data_range=255)
        assert value == pytest.approx(expected, abs=1e-4)


def test_all_protocols_stand_in_one_table_with_their_spread(run: Path, tmp_path: Path) -> None:
    result = rescore([open_pictures(run)], protocols_named("all"))[0]
    assert set(result.scores) == set(PROTOCOLS)
    assert all("psnr" in scores.quality for scores in result.scores.values())
    assert spread_of(result, "psnr") > 0.1
    columns, rows = rows_of(result)
    assert columns == ["protocol", "PSNR (dB)", "SSIM", "background", "prediction", "truth"]
    assert rows[-1][:2] == ["spread", f"{spread_of(result, 'psnr'):.3f}"]
    page, numbers = write_tables([result], tmp_path / "out")
    assert f"| spread | {spread_of(result, 'psnr'):.3f} |" in page.read_text()
    assert PROTOCOLS["multinerf"].source in page.read_text()
    lines = list(csv.DictReader(numbers.open()))
    found = {line["protocol"]: float(line["mean"]) for line in lines if line["metric"] == "psnr"}
    assert found == {name: scores.quality["psnr"].mean for name, scores in result.scores.items()}
    assert any("lpips" in line["skipped"] for line in lines)


def test_scores_go_into_the_run_and_never_replace_its_own(run: Path) -> None:
    before = (run / "scores.json").read_bytes()
    result = rescore([open_pictures(run)], protocols_named("default,float,gsplat"))[0]
    assert {path.name for path in write_scores(result, None)} == {"scores.float.json", "scores.gsplat.json"}
    assert (run / "scores.json").read_bytes() == before
    as_read = read_run(run, "gsplat")
    assert as_read.scores.quality["psnr"].mean == result.scores["gsplat"].quality["psnr"].mean
    assert {"flip", "alpha_iou"} <= set(read_run(run, "float").scores.quality)


def test_a_run_that_was_interrupted_before_its_scores_stays_unfinished(run: Path) -> None:
    """The default protocol's scores mark a run as finished; these would lack its costs."""
    (run / "scores.json").unlink()
    result = rescore([open_pictures(run)], protocols_named("default,float"))[0]
    assert [path.name for path in write_scores(result, None)] == ["scores.float.json"]
    assert not (run / "scores.json").exists()


def test_pictures_of_another_tool_score_like_the_run_they_came_from(run: Path, tmp_path: Path) -> None:
    truth_folder = run / json.loads((run / "provenance.json").read_text())["truth"]
    theirs = tmp_path / "model" / "test" / "ours_30000"
    for side, folder in (("renders", run / "test"), ("gt", truth_folder)):
        (theirs / side).mkdir(parents=True)
        for path in folder.glob("*.png"):
            shutil.copy(path, theirs / side / f"0{path.name}")
    assert open_pictures(run, background=WHITE).background == WHITE
    with pytest.raises(InputError, match=r"has the background 1,1,1\.\nLeave --background out"):
        open_pictures(run, background=(0.0, 0.0, 0.0))
    got = scores_of(tmp_path / "model", "default", background=WHITE)
    expected = json.loads((run / "scores.json").read_text())["quality"]
    for metric in ("psnr", "ssim", "flip"):
        assert got.quality[metric].per_view == pytest.approx(expected[metric]["per_view"], abs=1e-9)
    result = rescore([open_pictures(theirs, background=WHITE)], protocols_named("multinerf,instant-ngp,3dgs-metrics"))[0]
    assert write_scores(result, None) == []  # nothing is written into a folder of somebody else's
    assert "psnr" in result.scores["multinerf"].quality
    assert "in front of black; here it is in front of white already" in result.scores["3dgs-metrics"].skipped["psnr"]
    assert "unrounded predictions" in result.scores["instant-ngp"].skipped["ssim"]


def test_eight_bits_stand_in_for_floats_only_when_allowed(folders) -> None:
    pictures = open_pictures(*folders())
    assert "--allow-8bit" in why_unsuited(pictures, PROTOCOLS["gsplat"])
    assert why_unsuited(pictures, PROTOCOLS["multinerf"]) == ""
    scores = rescore([pictures], protocols_named("gsplat,float,default"), allow_8bit=True)[0].scores
    assert scores["gsplat"].quality["psnr"].mean == pytest.approx(scores["default"].quality["psnr"].mean, abs=1e-6)
    assert any("8-bit pictures were used" in note for note in scores["gsplat"].notes)
    assert not any("8-bit" in note for note in scores["default"].notes)


def test_backgrounds_are_never_guessed(folders) -> None:
    predictions, truth = folders(("RGB", "RGBA"))
    with pytest.raises(InputError, match=r"pictures of the predictions have no alpha channel.*\n.*--background white"):
        open_pictures(predictions, truth)
    assert "in front of black" in why_unsuited(open_pictures(predictions, truth, WHITE), PROTOCOLS["3dgs-metrics"])
    clear = open_pictures(*folders(("RGBA", "RGBA"), ("clear", "clear_truth")))
    assert "needs the data set's background" in why_unsuited(clear, PROTOCOLS["default"])
    assert why_unsuited(clear, PROTOCOLS["3dgs-metrics"]) == ""
    opaque = open_pictures(*folders(names=("photos", "photos_truth")))
    assert opaque.transparency == "opaque" and "scored as photographs" in opaque.notes[0]


def test_a_run_whose_truth_keeps_one_background_only_says_so(run: Path) -> None:
    """As runs were before the straight colours were kept."""
    folder = run / json.loads((run / "provenance.json").read_text())["truth"]
    for path in folder.glob("*.npz"):
        arrays = dict(np.load(path))
        del arrays["rgb"]
        np.savez_compressed(path, **arrays)
    result = rescore([open_pictures(run)], protocols_named("default,gsplat,multinerf"))[0].scores
    assert "already, without alpha" in result["gsplat"].skipped["psnr"]
    first = json.loads((run / "scores.json").read_text())["quality"]["psnr"]["per_view"]
    assert result["default"].quality["psnr"].per_view == pytest.approx(first, abs=1e-9)
    assert "psnr" in result["multinerf"].quality


def test_wide_runs_are_not_what_3dgs_would_have_fitted(run: Path) -> None:
    wide = replace(open_pictures(run), size=(1601, 900))
    assert "wider than 1600 pixels" in why_unsuited(wide, PROTOCOLS["3dgs-metrics-white"])
    assert why_unsuited(replace(wide, size=(1600, 900)), PROTOCOLS["3dgs-metrics-white"]) == ""


def test_only_the_same_truth_is_compared(run: Path, folders) -> None:
    one = open_pictures(run)
    check_same_truth([one, replace(one, folder=Path("b"))])
    for changes, expected in (
        ({"names": one.names[:1]}, "different numbers of views"),
        ({"size": (640, 480)}, r"different sizes \(24x24 and 640x480\)"),
        ({"background": BLACK}, r"different backgrounds \(white and black\)"),
        ({"sha256": "0" * 64}, "different true pixels"),
    ):
        with pytest.raises(InputError, match=expected):
            rescore([one, replace(one, **changes)], protocols_named("default"))


def test_reports_refuse_runs_over_different_backgrounds(run: Path) -> None:
    one = read_run(run)
    other = replace(one, provenance=replace(one.provenance, background=(0.0, 0.0, 0.0)))
    check_comparable((one, one))
    with pytest.raises(InputError, match="different backgrounds"):
        check_comparable((one, other))


def test_fits_are_told_where_other_tools_protocols_belong() -> None:
    with pytest.raises(InputError, match=r"protocol of another tool.*\n.*rescore RUN --protocol gsplat"):
        protocol_named("gsplat")


def test_names_decide_and_else_the_natural_order(folders, tmp_path: Path) -> None:
    predictions, truth = folders(count=12)
    for index in range(12):
        (truth / f"{index:03d}.png").rename(truth / f"r_{index}.png")
    pictures = open_pictures(predictions, truth)
    assert "matched in order, from 000.png with r_0.png to 011.png with r_11.png" in pictures.notes[0]
    assert np.array_equal(pictures.truth(10).image.numpy(), read(truth / "r_10.png"))
    for index in range(12):
        (truth / f"r_{index}.png").rename(truth / f"{11 - index:03d}.png")
    by_name = open_pictures(predictions, truth)
    assert np.array_equal(by_name.truth(0).image.numpy(), read(truth / "000.png")) and len(by_name.notes) == 1


def _gain(rescored: Rescored, protocol: str, gain: float) -> None:
    scores = rescored.scores[protocol]
    psnr = scores.quality["psnr"]
    better = replace(psnr, mean=psnr.mean + gain)
    rescored.scores[protocol] = replace(scores, quality=scores.quality | {"psnr": better})


def test_the_winner_may_depend_on_the_protocol(run: Path) -> None:
    results = [
        replace(one, label=label) for label in "ab" for one in rescore([open_pictures(run)], protocols_named("float,gsplat"))
    ]
    _gain(results[1], "float", 1)
    _gain(results[0], "gsplat", 1)
    assert best_sets(results, "psnr") == "Best psnr depends on the protocol: b under float; a under gsplat."
    _gain(results[1], "gsplat", 2)
    assert best_sets(results, "psnr") == "Best psnr: b, whatever the protocol."
    assert best_sets(results[:1], "psnr") == best_sets(results, "lpips") == ""


def test_labels_are_the_shortest_ends_that_differ(tmp_path: Path) -> None:
    assert labels([tmp_path / "a" / "seed-0"]) == ["seed-0"]
    assert labels([tmp_path / "a" / "seed-0", tmp_path / "b" / "seed-0"]) == ["a/seed-0", "b/seed-0"]
    assert labels([tmp_path, tmp_path]) == [f"{tmp_path.name} 1", f"{tmp_path.name} 2"]
