"""Reports made by other recipes than today's are found; pages carry the commit."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from made_up_runs import provenance_table

from invgraphics.cli import main
from invgraphics.experiments.environment import commit
from invgraphics.recipes.recipe import load_method
from invgraphics.tools.recipe_check import check_recipes
from invgraphics.training.budget import Budget

METHOD, OVERRIDE = "volumetric/hash", "field.encoding.log2_size=11"


def write(folder: Path, **given: Any) -> None:
    folder.mkdir(parents=True)
    (folder / "provenance.json").write_text(json.dumps(provenance_table(**given)))


def current(*overrides: str) -> dict[str, str]:
    words = " ".join(f"--set {item}" for item in (*overrides, "data.train_views=5"))
    digest = load_method(METHOD, "laptop", overrides, Budget.parse("60s")).digest
    return {
        "method": METHOD,
        "recipe_sha256": digest,
        "command": f"invgraphics fit {METHOD} balls {words} --budget 60s --out x",
    }


def test_a_report_is_current_until_its_recipe_changes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "good" / "balls" / "runs" / "0-seed-0", **current(OVERRIDE))
    write(tmp_path / "good" / "balls" / "runs" / "0-seed-1", **current())
    assert check_recipes(tmp_path / "good").current
    write(tmp_path / "old" / "runs" / "0", **(current() | {"recipe_sha256": "0" * 64}))
    write(tmp_path / "gone" / "runs" / "0", **(current() | {"method": "volumetric/forgotten"}))
    assert check_recipes(tmp_path / "old").stale == {METHOD: "differs"}
    for name in ("good", "old", "gone"):
        (tmp_path / name / "index.html").write_text("")
    assert main.run(["report", "--check", str(tmp_path / "good")]) == main.DONE
    assert main.run(["report", "--check", str(tmp_path)]) == 1
    told = capsys.readouterr().out
    assert "all 2 runs were made by today's recipes" in told and f"{METHOD} (differs)" in told
    assert "volumetric/forgotten" in told and "2 of 3 reports are not current: gone and old." in told


def test_runs_of_no_recipe_alone_do_not_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Imported and converted ones, renderings of fits, and pages without runs, such as a benchmark's."""
    write(tmp_path / "mixed" / "runs" / "0", **current())
    imported = {"file": "a.ply", "sha256": "0" * 64, "bytes": 9, "format": "ply", "axes": "opencv", "world": "opencv"}
    imported |= {"gaussians": 1, "sh_degree": 0, "antialiased": None, "notes": []}
    write(tmp_path / "mixed" / "runs" / "1", **(current() | {"budget": "imported", "imported": imported}))
    shown = {"method": f"{METHOD} rendered with gaussian-volume/exact", "fitted_run": "../..", "fitted_by": METHOD}
    write(tmp_path / "mixed" / "runs" / "0" / "rendered" / "exact", **(current() | shown))
    assert check_recipes(tmp_path / "mixed").current
    assert check_recipes(tmp_path / "mixed").runs == 1
    for name in ("mixed", "bench"):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "index.html").touch()
    assert main.run(["report", "--check", str(tmp_path)]) == 0
    assert "All 1 reports are current." in capsys.readouterr().out
    assert main.run(["report", "--check", str(tmp_path / "bench")]) == 1


@pytest.mark.parametrize(
    ("scene", "options", "is_current"),
    [
        ("anything", {"size": 128}, True),
        ("anything", {"size": [160, 200]}, True),
        ("anything", {"size": [160, 400]}, False),
        ("anything", {"size": 400}, False),
        ("anything", {}, False),
        ("bricks", {}, True),  # 128 px
    ],
)
def test_keys_without_effect_at_the_size_of_a_run_are_no_difference(
    tmp_path: Path, scene: str, options: dict[str, Any], is_current: bool
) -> None:
    """Published runs of splats are older than ``start_size``, which changes no bit of them."""
    method = "splatting/gaussians"
    before = load_method(method, "laptop", ["batches.start_size=0"], Budget.parse("60s"))
    assert before.digest != load_method(method, "laptop", (), Budget.parse("60s")).digest
    command = f"invgraphics fit {method} {scene} --budget 60s --out x"
    record = {"method": method, "recipe_sha256": before.digest, "command": command, "scene": scene, "options": options}
    write(tmp_path / "runs" / "0", **record)
    assert check_recipes(tmp_path).current is is_current
    write(tmp_path / "other" / "0", **(record | {"recipe_sha256": "0" * 64}))
    assert not check_recipes(tmp_path).current


def test_runs_of_scenes_of_two_sizes_are_judged_apart(tmp_path: Path) -> None:
    """``start_size`` has no effect on ``bricks``, of 128 px, and may have one on a scene that is not here."""
    method = "splatting/gaussians"
    before = load_method(method, "laptop", ["batches.start_size=0"], Budget.parse("60s"))
    command = f"invgraphics fit {method} x --budget 60s --out x"
    for name, scene in (("0", "bricks"), ("1", "anything")):
        write(tmp_path / name, method=method, recipe_sha256=before.digest, command=command, scene=scene)
    assert check_recipes(tmp_path / "0").current
    assert check_recipes(tmp_path).stale == {method: "differs"}


def test_a_reason_as_long_as_a_digest_is_a_reason(tmp_path: Path) -> None:
    reason = f"{'x' * 44}.toml does not exist"
    assert len(reason) == len(current()["recipe_sha256"])
    write(tmp_path / "runs" / "0", **(current() | {"method": f"{'x' * 44}.toml"}))
    assert check_recipes(tmp_path).stale == {f"{'x' * 44}.toml": reason}


def test_the_commit_of_a_working_copy(tmp_path: Path) -> None:
    assert commit(tmp_path / "nowhere") == ""
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    (tmp_path / "file").write_text("one")
    for words in (["init", "-q"], ["add", "file"], ["commit", "-qm", "one"]):
        subprocess.run([*git, *words], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout.strip()
    assert commit(tmp_path) == head
    commit.cache_clear()
    (tmp_path / "file").write_text("two")
    assert commit(tmp_path) == f"{head} + changes"
