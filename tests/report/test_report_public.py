"""A public report tells no path, no user and no host."""

from __future__ import annotations

import csv
import getpass
import re
import shlex
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image, PngImagePlugin
from pyarrow import parquet

from invgraphics.cli import main
from invgraphics.errors import InputError
from invgraphics.report.build import build_from_runs
from invgraphics.report.data.redact import HIDDEN, Redactor, redactor_for
from invgraphics.report.study import build_study_report
from invgraphics.text import slug

pytestmark = pytest.mark.usefixtures("unpainted")

USER, HOST, LOGIN, NODE = "ada_lovelace", "analyticalengine", "countess", "babbage-07"
HOME = f"/home/{USER}/My Experiments/fox"


@pytest.fixture(autouse=True)
def _names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(getpass, "getuser", lambda: LOGIN)
    monkeypatch.setattr(socket, "gethostname", lambda: f"{NODE}.example.org")


def plant_in_runs(folder: Path, edit: Callable[..., None]) -> None:
    def plant(table: dict[str, Any]) -> None:
        table["command"] = f"invgraphics fit volumetric/hash '{HOME}' --out /scratch/{LOGIN}/runs/1 --set a=/home/{USER}/b"
        table["notes"] = {"source": f"photos of {USER.upper()}", "file": f"C:\\Users\\{USER}\\fox.jpg"}

    def plant_machine(table: dict[str, Any]) -> None:
        table |= {"hostname": f"{HOST}.lab", "note": f"ran on {HOST} by {LOGIN}", "cwd": f"/work/{LOGIN}/here"}

    for run in folder.rglob("scores.json"):
        edit(run.parent / "provenance.json", plant)
        edit(run.parent / "environment.json", plant_machine)
        (run.parent / "recipe.toml").write_text(f'method = "x"\npath = "{HOME}/recipe"\n')
        edit(run, lambda table: table["skipped"].update(lpips=f"no weights in /home/{USER}/.cache/torch: not found"))
    about = PngImagePlugin.PngInfo()
    about.add_text("Author", USER)
    for picture in [*folder.glob("truth/*/*.png"), *folder.glob("runs/**/test/*.png")]:
        Image.open(picture).save(picture, pnginfo=about)


def leaks(folder: Path) -> list[str]:
    """Every file below ``folder`` that holds a planted word or an absolute path."""
    words = [word.lower().encode() for word in (USER, HOST, LOGIN, NODE, "example.org", "My Experiments", "scratch")]
    paths = re.compile(rb"(?<![\w./<])/(?:home|users|tmp|root|work|mnt|scratch|usr|var)/|file://|[a-z]:\\users", re.IGNORECASE)
    found = []
    for path in folder.rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            if path.suffix == ".parquet":  # compressed
                content += repr(parquet.read_table(path).to_pydict()).encode()
            hits = [word for word in words if word in content.lower()] + paths.findall(content)
            found += [f"{path.relative_to(folder)}: {hits}"] if hits else []
    return found


def test_public_study_tells_nothing_private(small_study: Path, tmp_path: Path, edit: Callable[..., None]) -> None:
    def plant(table: dict[str, Any]) -> None:
        table["command"] = f"invgraphics ablate /home/{USER}/studies/views.toml --out '{HOME}'"
        table["environment"] |= {"hostname": HOST, "user": LOGIN, "home": f"/home/{USER}"}
        table["question"] = f"Does {USER} need more views?"
        for cell in table["cells"]:
            cell["scene"] = f"{HOME}/{cell['scene']}"
            if cell["status"] == "failed":
                cell["error"] = f"'{HOME}/x.png' is missing on {HOST}: see /var/log/{LOGIN}/run.log"

    edit(small_study / "study.json", plant)
    plant_in_runs(small_study, edit)
    out = tmp_path / "out"
    build_study_report(small_study, out, public=True)
    assert leaks(out) == []
    page = (out / "index.html").read_text()
    assert "invgraphics ablate views.toml --out &#39;fox&#39;" in page
    assert "Scene: balls" in page
    assert "&#39;x.png&#39; is missing on …: see run.log" in page
    assert len(list(out.rglob("provenance.json"))) == 3
    assert len(leaks(small_study)) >= 3 * 5  # the same search finds what is there


def test_public_comparison_tells_nothing_private(
    comparison_folder: Path, tmp_path: Path, edit: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    def plant(table: dict[str, Any]) -> None:
        table["command"] = f"invgraphics compare {HOME.replace(' ', '_')} --out ~{LOGIN}/reports"
        table["scene_info"]["notes"] = {"photos": f"file:///home/{USER}/fox/images"}
        table["environment"]["node"] = NODE

    edit(comparison_folder / "compare.json", plant)
    plant_in_runs(comparison_folder, edit)
    assert main.run(["report", str(comparison_folder), "--public"]) == main.DONE
    out = tmp_path / "balls-public"
    assert capsys.readouterr().out.strip().endswith("index.html")
    assert leaks(out) == []
    runs = sorted(comparison_folder.glob("runs/*/seed-0"))
    assert main.run(["report", *map(str, runs), "--out", str(tmp_path / "single"), "--public"]) == main.DONE
    assert leaks(tmp_path / "single") == []
    lines = (out / "index.md").read_text().splitlines()
    places = [words[words.index("--out") + 1] for line in lines if "invgraphics fit" in line for words in [shlex.split(line)]]
    assert len(places) > 1 and len(set(places)) == len(places)  # else the second command would find the first one's run
    text = (out / "index.html").read_text()
    for attribute in ("src", "href", "srcset"):
        for part in text.split(f'{attribute}="')[1:]:
            link = part.split('"')[0]
            assert link.startswith(("#", "data:")) or (out / link).is_file(), link


def test_folders_of_runs_are_not_named(comparison_folder: Path, tmp_path: Path) -> None:
    """They may lie in two people's homes."""
    homes = [Path(shutil.copytree(comparison_folder, tmp_path / "home" / name / "balls")) for name in ("alice", "bob")]
    runs = [sorted(home.glob("runs/*/seed-0"))[index] for index, home in enumerate(homes)]
    out = tmp_path / "public"
    build_from_runs(runs, out, public=True)
    rows = list(csv.DictReader((out / "results.csv").open()))
    assert {row["run"] for row in rows if row["run"]} == {f"{slug(row['method'])}-seed-0" for row in rows if row["run"]}
    assert not [path for path in out.rglob("*") if path.suffix in (".csv", ".md", ".html") and "alice" in path.read_text()]


def test_public_report_refuses_the_folder_of_the_runs(small_study: Path) -> None:
    with pytest.raises(InputError, match="private runs lie in it"):
        build_study_report(small_study, small_study, public=True)


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        ("see /data/set/fox.png, or /x", "see fox.png, or x"),
        ("--out=/a/b:/c/d", "--out=b:d"),
        ("'/a/b c/d e' is missing", "'d e' is missing"),
        ("volumetric/hash at 3 s/view, ../truth/0", "volumetric/hash at 3 s/view, ../truth/0"),
        ("https://example.org/a/b and file:///a/b", "https://example.org/a/b and b"),
        ("/home/zoe", HIDDEN),
        ("~zoe/x and ~/y/z", "x and z"),
        (r"C:\Users\Zoe\fox.jpg", "fox.jpg"),
        ("Zoe ran it; zoetrope", f"{HIDDEN} ran it; zoetrope"),
        ("1 / 2", "1 / 2"),
        ("in /data/my set/fox/a.png and /data/my set/fox.", "in a.png and fox."),
    ],
)
def test_redaction(text: str, clean: str) -> None:
    assert Redactor(("zoe",), ("/data/my set/fox",)).text(text) == clean


def test_names_are_gathered_where_they_are_told() -> None:
    words = redactor_for([{"a": ["/home/zoe/x"], "HOST": "turing.lab"}, "/Users/kim/y"]).words
    assert {"zoe", "kim", "turing.lab", LOGIN, NODE} <= set(words)
    assert "root" not in words


def test_scenes_whose_paths_end_alike_stay_apart() -> None:
    redactor = redactor_for([], ["/a/fox", "/b/fox", "/a/fox", "bricks", "/c/owl"])
    shown = ["/a/fox", "/b/fox", "bricks", "/c/owl", "fit of '/b/fox' at 60s", "/b/fox/0.png"]
    assert redactor.value(shown) == ["fox", "fox (2)", "bricks", "owl", "fit of 'fox (2)' at 60s", "0.png"]
