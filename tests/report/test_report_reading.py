"""Folders that cannot be reported are refused with a sentence that names the file."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from invgraphics.errors import InputError
from invgraphics.report.build import build_from_runs, build_report
from invgraphics.report.data.comparison import read_comparison
from invgraphics.runs.run import read_run

pytestmark = pytest.mark.usefixtures("unpainted")

RUN = "runs/volumetric-hash/seed-0"


@pytest.mark.parametrize(
    "name",
    [
        "compare.json",
        f"{RUN}/scores.json",
        f"{RUN}/provenance.json",
        f"{RUN}/environment.json",
        f"{RUN}/history.jsonl",
        f"{RUN}/test/0000.png",
        f"{RUN}/test/0000.npz",
    ],
)
@pytest.mark.parametrize("damage", ["removed", "truncated", "garbage"])
def test_damaged_file_is_named(comparison_folder: Path, name: str, damage: str) -> None:
    path = comparison_folder / name
    if damage == "removed":
        path.unlink()
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        path.write_bytes(b"\xff\x00garbage\n\xfe")
    if name.endswith(".jsonl") and damage == "truncated":
        assert build_report(comparison_folder).is_file()  # a killed fit leaves half a line
        return
    with pytest.raises(InputError) as caught:
        build_report(comparison_folder)
    assert path.name in caught.value.sentence


def test_missing_truth_is_named(comparison_folder: Path) -> None:
    picture = next(comparison_folder.glob("truth/*/0000.png"))
    picture.unlink()
    with pytest.raises(InputError, match=r"truth/.*/0000\.png"):
        build_report(comparison_folder)


def test_folder_without_runs(tmp_path: Path, comparison_folder: Path, edit: Callable[..., None]) -> None:
    with pytest.raises(InputError, match=r"compare\.json"):
        build_report(tmp_path)
    edit(comparison_folder / "compare.json", lambda table: table.update(runs=[]))
    with pytest.raises(InputError, match="lists no runs"):
        build_report(comparison_folder)
    with pytest.raises(InputError, match="no runs"):
        build_from_runs([], tmp_path / "out")
    with pytest.raises(InputError, match="There is no run at"):
        build_from_runs([tmp_path / "nowhere"], tmp_path / "out")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda table: table["quality"]["psnr"].update(mean="high"), "'quality.psnr.mean' cannot be 'high'"),
        (lambda table: table["quality"]["psnr"].update(per_view=[1.0]), "1 values for 6 views"),
        (lambda table: table["quality"]["psnr"].pop("higher_is_better"), "lacks the key 'quality.psnr.higher_is_better'"),
        (lambda table: table.update(seed="zero"), "'seed' cannot be 'zero'"),
        (lambda table: table["cost"].update(fit_seconds=1e300), "'cost.fit_seconds' cannot be 1e+300"),
        (lambda table: table.pop("views"), "lacks the key 'views'"),
    ],
)
def test_wrong_scores_are_explained(
    comparison_folder: Path, edit: Callable[..., None], change: Callable[[dict[str, Any]], None], words: str
) -> None:
    edit(comparison_folder / RUN / "scores.json", change)
    with pytest.raises(InputError) as caught:
        read_comparison(comparison_folder)
    assert words in caught.value.sentence
    assert "scores.json" in caught.value.sentence


def test_runs_against_different_truth_are_refused(comparison_folder: Path, tmp_path: Path, edit: Callable[..., None]) -> None:
    edit(comparison_folder / RUN / "provenance.json", lambda table: table.update(truth_sha256="0" * 64))
    other = comparison_folder / "runs/volumetric-nerf/seed-0"
    with pytest.raises(InputError, match="different ground truth"):
        build_from_runs([other, comparison_folder / RUN], tmp_path / "out")
    with pytest.raises(InputError, match="different ground truth"):
        build_report(comparison_folder)
    assert not (tmp_path / "out").exists()


def test_pictures_of_another_size_are_refused(comparison_folder: Path) -> None:
    from PIL import Image

    path = comparison_folder / RUN / "test" / "0000.png"
    Image.open(path).resize((10, 10)).save(path)
    with pytest.raises(InputError, match="differ in size"):
        build_report(comparison_folder)


def test_other_protocols_are_read_from_their_own_scores(comparison_folder: Path, edit: Callable[..., None]) -> None:
    run = comparison_folder / RUN
    shutil.copy(run / "scores.json", run / "scores.float.json")
    edit(run / "scores.float.json", lambda table: table["quality"]["psnr"].update(mean=12.5))
    assert read_run(run, "float").scores.quality["psnr"].mean == 12.5
    assert read_run(run).scores.quality["psnr"].mean != 12.5


def test_runs_from_anywhere_give_a_folder_that_can_be_moved(comparison_folder: Path, tmp_path: Path) -> None:
    runs = [comparison_folder / RUN, comparison_folder / "runs/volumetric-nerf/seed-1"]
    page = build_from_runs(runs, tmp_path / "out")
    shutil.rmtree(comparison_folder)
    moved = Path(shutil.move(page.parent, tmp_path / "elsewhere"))
    text = (moved / "index.html").read_text()
    assert str(tmp_path) not in text
    for attribute in ("src", "href", "srcset"):
        for part in text.split(f'{attribute}="')[1:]:
            link = part.split('"')[0]
            assert link.startswith(("#", "data:")) or (moved / link).is_file(), link


def test_unequal_budgets_are_told_and_times_that_they_fix_are_not_ranked(
    comparison_folder: Path, tmp_path: Path, edit: Callable[..., None]
) -> None:
    runs = [comparison_folder / RUN, comparison_folder / "runs/volumetric-nerf/seed-0"]
    equal = build_from_runs(runs, tmp_path / "equal").read_text()
    edit(runs[1] / "provenance.json", lambda table: table.update(budget="2m"))
    page = build_from_runs(runs, tmp_path / "out").read_text()
    budgets = "60 s (volumetric/hash); 2 min (volumetric/nerf)"
    assert f"The budgets are not equal: {budgets}. A lead may be that of the longer fit." in page
    assert f"<dt>budget per fit</dt><dd>{budgets}</dd>" in page
    assert "Fit (s) ↓" not in (tmp_path / "out" / "index.md").read_text()
    assert "budgets are not equal" not in equal and "Given 60 s each" in equal
    assert "The grey rows" not in page, "without baselines none are explained"


def test_same_method_and_seed_twice_is_told_apart(comparison_folder: Path, tmp_path: Path, edit: Callable[..., None]) -> None:
    longer = tmp_path / "longer"
    shutil.copytree(comparison_folder / RUN, longer)
    truth = next((comparison_folder / "truth").iterdir())
    edit(longer / "provenance.json", lambda table: table.update(budget="120s", truth=str(truth)))
    page = build_from_runs([comparison_folder / RUN, longer], tmp_path / "out").read_text()
    assert "volumetric/hash (60s)" in page
    assert "volumetric/hash (120s)" in page


@pytest.mark.parametrize(
    "change",
    [{"recipe_sha256": "0" * 64}, {"budget": "120s"}, {"data": {"data.train_views": 6}}],
    ids=["another recipe", "another budget", "other training data"],
)
def test_other_experiments_are_no_seeds_of_a_method(
    comparison_folder: Path, tmp_path: Path, edit: Callable[..., None], change: dict[str, Any]
) -> None:
    """Two settings of one method with two seeds each are two methods with two seeds each, whatever the settings' names."""
    seeds = [comparison_folder / f"runs/volumetric-nerf/seed-{seed}" for seed in (0, 1)]
    others = [tmp_path / "other" / f"seed-{seed}" for seed in (0, 1)]
    truth = next((comparison_folder / "truth").iterdir())
    for run, other in zip(seeds, others, strict=True):
        shutil.copytree(run, other)
        edit(other / "provenance.json", lambda table: table.update(change, truth=str(truth)))

    def reported(runs: Sequence[Path]) -> dict[str, set[int]]:
        table = pd.read_csv(build_from_runs(runs, tmp_path / "out").parent / "results.csv").dropna(subset=["seed"])
        return {str(method): set(rows["seed"]) for method, rows in table.groupby("method")}

    assert sorted(reported([seeds[0], others[1]]).values(), key=min) == [{0}, {1}], "no repetitions of one experiment"
    assert list(reported([*seeds, *others]).values()) == [{0, 1}, {0, 1}]
    assert reported(seeds) == {"volumetric/nerf": {0, 1}}
