"""What ``import-photos`` asks for, prints and returns; the work itself is tested where it is done."""

import json
from pathlib import Path

import pytest

from invgraphics.cli import main
from invgraphics.cli.arguments import parse
from invgraphics.cli.import_photos import ImportPhotos

LENS = {"model": "SIMPLE_RADIAL", "params": [1.0, 2.0, 3.0, 0.1], "size": [4, 5]}
HONEST = {
    "pairs": 100, "contradicting": 1, "share": 0.01, "suspicious": False, "sentence": "fine", "support": 0.93,
    "asked": 9, "doubtful": ["c.jpg"],
}  # fmt: skip
FIRST = {"strategy": "incremental mapper, radial lens", "outcome": "9 placed", "seconds": 4.0, "kept": True}
QUALITY = {
    "registered": 9, "used": 10, "points": 1234, "track_length": 4.25, "reprojection_error_px": 0.512, "bend_px": 1.25,
    "lenses": [LENS, LENS], "other_pieces": [], "consistency": HONEST, "usable": True, "refusal": None,
    "skipped": {"a.heic": "nothing here decodes HEIC"}, "unplaced": {"b.jpg": "blurred"}, "seconds": {"matches": 3.2},
    "attempts": [FIRST],
}  # fmt: skip


@pytest.fixture
def given(monkeypatch, tmp_path: Path):
    """Replace the work by a report; returns the requests and a way to run the command."""
    from invgraphics.tools import photos

    asked = []

    def run(quality: dict, *options: str) -> int:
        monkeypatch.setattr(photos, "import_photos", lambda *request, **_: asked.append(request) or quality)
        return main.run(["import-photos", str(tmp_path), "--out", str(tmp_path / "scene"), *options])

    return asked, run


def test_figures_are_printed_and_the_folder_last(given, capsys, tmp_path) -> None:
    _, run = given
    truth = {"source": "fox", "cameras": 9}
    truth |= {name: {"median": 0.25, "mean": 1.0, "max": 2.5} for name in ("rotation_degrees", "translation_per_cent")}
    assert run(QUALITY | {"truth": truth, "masked": 7}) == main.DONE
    text = capsys.readouterr().out
    for expected in (
        "9 of 10",
        "7 photographs have one",
        "1234",
        "4.2",
        "0.51 px",
        "2 SIMPLE_RADIAL",
        "1 of the 100",
        "1 of 9",
        "93 %",
        "0.250°",
        "2.500 %",
        "matches 3 s",
    ):
        assert expected in text
    assert "left out: a.heic: nothing here decodes HEIC" in text
    assert "not placed: b.jpg: blurred" in text
    assert "SUSPICIOUS" not in text
    assert "incremental mapper" not in text
    assert text.splitlines()[-1] == str(tmp_path / "scene")


def test_a_suspicious_scene_says_so(given, capsys) -> None:
    _, run = given
    assert run(QUALITY | {"consistency": HONEST | {"suspicious": True, "sentence": "folded"}}) == main.DONE
    assert "SUSPICIOUS: folded" in capsys.readouterr().out


def test_what_was_tried_and_what_is_kept_is_printed(given, capsys) -> None:
    _, run = given
    second = FIRST | {"strategy": "global mapper, radial lens", "outcome": "10 placed"}
    assert run(QUALITY | {"attempts": [FIRST | {"kept": False}, second]}) == main.DONE
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert any("tried" in line and "incremental mapper, radial lens: 9 placed, 4 s" in line for line in lines)
    assert any("kept" in line and "global mapper, radial lens: 10 placed, 4 s" in line for line in lines)


def test_too_few_photographs_are_refused_with_what_is_kept(given, capsys, tmp_path) -> None:
    _, run = given
    refused = QUALITY | {"usable": False, "refusal": ["Only 2 of 10 photographs could be placed.", "Take more."]}
    assert run(refused | {"registered": 2, "other_pieces": [2]}) == main.BAD_INPUT
    captured = capsys.readouterr()
    assert "a separate piece of 2" in captured.out
    kept = f"Take more. What could be placed is kept in {tmp_path / 'scene'}."
    assert captured.err == f"Only 2 of 10 photographs could be placed.\n{kept}\n"
    nothing = refused | {"registered": 0, "consistency": None, "unplaced": {f"{n}.jpg": "blurred" for n in range(25)}}
    assert run(nothing) == main.BAD_INPUT
    captured = capsys.readouterr()
    assert "kept" not in captured.err
    assert "not placed: 15 more" in captured.out


def test_a_refusal_says_that_the_earlier_scene_is_kept(given, capsys, tmp_path) -> None:
    _, run = given
    for folder, key in ((tmp_path / "scene", "earlier"), (tmp_path / "scene/refused", "later")):
        folder.mkdir()
        (folder / "quality.json").write_text(json.dumps({"key": key}))
    refused = {"usable": False, "refusal": ["Only 2 of 10 photographs could be placed.", "Take more."], "registered": 2}
    assert run(QUALITY | refused | {"key": "later"}) == main.BAD_INPUT
    scene = tmp_path / "scene"
    kept = f"What could be placed is kept in {scene / 'refused'}. {scene} keeps the usable scene of an earlier import."
    assert kept in capsys.readouterr().err


def test_options_reach_the_work(given) -> None:
    asked, run = given
    run(
        QUALITY, "--matching", "sequential", "--mapper", "global", "--lens", "opencv", "--camera-per-photo", "--max-size", "800"
    )
    run(QUALITY, "--single-camera", "--seed", "3", "--truth", "tests")
    first, second = (request[0] for request in asked)
    assert (first.matching, first.mapper, first.lens, first.cameras, first.max_size, first.seed) == (
        "sequential", "global", "opencv", "per-photo", 800, 0,
    )  # fmt: skip
    assert (second.matching, second.cameras, second.seed, asked[1][2]) == ("auto", "single", 3, Path("tests"))
    assert (second.mapper, second.lens) == ("auto", "auto")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--single-camera", "--camera-per-photo"], "exclude each other"),
        (["--truth", "no/such/place"], "no data set 'no/such/place'"),
        (["--matching", "guess"], "guess"),
        (["--max-size", "3"], "cannot be 3 pixels"),
    ],
)
def test_bad_options_are_refused(options: list[str], expected: str, capsys, tmp_path) -> None:
    assert main.run(["import-photos", str(tmp_path), *options]) == main.BAD_INPUT
    message = capsys.readouterr().err
    assert expected in message
    assert len(message.strip().splitlines()) <= main.MOST_LINES


def test_a_missing_folder_is_refused(capsys, tmp_path) -> None:
    assert main.run(["import-photos", str(tmp_path / "nowhere"), "--out", str(tmp_path / "o")]) == main.BAD_INPUT
    assert "no folder" in capsys.readouterr().err


def test_the_scene_is_named_after_the_photographs() -> None:
    command = parse(ImportPhotos, "invgraphics import-photos", ["holiday/beach"])
    assert (command.out, command.folder) == (None, Path("holiday/beach"))
