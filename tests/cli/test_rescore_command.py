"""``invgraphics rescore`` as a person meets it: tables, files, and one sentence for each mistake."""

import json
from pathlib import Path

import numpy as np
import pytest
from made_up_runs import provenance_table
from PIL import Image

from invgraphics.cli.main import run
from invgraphics.cli.rescore import parse_colour
from invgraphics.errors import InputError
from invgraphics.metrics.conventions import PROTOCOLS


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Three predictions in 3DGS's layout."""
    rng = np.random.default_rng(5)
    for side in ("renders", "gt"):
        (tmp_path / "model" / side).mkdir(parents=True)
        for index in range(3):
            Image.fromarray(rng.integers(0, 256, (16, 20, 3), dtype=np.uint8)).save(tmp_path / "model" / side / f"{index}.png")
    return tmp_path / "model"


def refused(capsys, *arguments: str) -> str:
    assert run(["rescore", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and 1 <= len(err.strip().splitlines()) <= 4
    return err


def test_a_folder_of_pictures_is_scored_and_written_elsewhere(pictures: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    before = sorted(pictures.rglob("*"))
    assert run(["rescore", str(pictures), "--allow-8bit", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "model: 3 views of 20x16" in text and "spread" in text and "scored as photographs" in text
    assert sorted(pictures.rglob("*")) == before
    scores = json.loads((out / "model" / "scores.nerf-pytorch.json").read_text())
    assert scores["protocol"] == "nerf-pytorch" and len(scores["quality"]["psnr"]["per_view"]) == 3
    assert scores["conventions"]["source"] == PROTOCOLS["nerf-pytorch"].source
    assert (out / "rescore.md").is_file() and (out / "rescore.csv").is_file()


def test_one_named_protocol_and_what_it_lacks(pictures: Path, capsys) -> None:
    assert run(["rescore", str(pictures), "--protocol", "gsplat"]) == 0
    out = capsys.readouterr().out
    assert (
        "Skipped: gsplat (psnr, ssim, lpips): needs unrounded predictions" in " ".join(out.split()) and "multinerf" not in out
    )


def test_each_mistake_gets_a_sentence(pictures: Path, tmp_path: Path, capsys) -> None:
    renders, truth = pictures / "renders", pictures / "gt"
    (tmp_path / "empty").mkdir()
    assert "no folder" in refused(capsys, str(tmp_path / "missing"))
    assert "nothing to score" in refused(capsys)
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "study.json").write_text("{}")
    assert "is a study, whose runs do not share their truth" in refused(capsys, str(tmp_path / "study"))
    assert "Name them with --truth" in refused(capsys, str(tmp_path / "empty"))
    assert "no picture in" in refused(capsys, str(tmp_path / "empty"), "--truth", str(truth))
    assert "no folder" in refused(capsys, str(renders), "--truth", str(tmp_path / "missing"))
    assert "no protocol 'psnr'" in refused(capsys, str(pictures), "--protocol", "psnr")
    assert "No protocol is named" in refused(capsys, str(pictures), "--protocol", ",")
    assert "--background cannot be 'pink'" in refused(capsys, str(pictures), "--background", "pink")
    (truth / "2.png").rename(tmp_path / "2.png")
    assert "holds 3 predictions" in refused(capsys, str(pictures))
    Image.new("RGB", (8, 8)).save(truth / "2.png")
    assert "is 20x16 pixels, its truth" in refused(capsys, str(pictures))
    (truth / "2.png").write_bytes((tmp_path / "2.png").read_bytes()[:200])
    assert "2.png is damaged" in refused(capsys, str(pictures))
    (truth / "2.png").write_text("no picture")
    assert "cannot be read as a picture" in refused(capsys, str(pictures))


def test_a_damaged_prediction_leaves_nothing_half_written(pictures: Path, tmp_path: Path, capsys) -> None:
    path = pictures / "renders" / "1.png"
    path.write_bytes(path.read_bytes()[:200])
    assert "1.png is damaged" in refused(capsys, str(pictures), "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_an_unfinished_run_is_refused(tmp_path: Path, capsys) -> None:
    (tmp_path / "provenance.json").write_text("{}")
    assert "lacks the key 'cell_sha256'" in refused(capsys, str(tmp_path))
    (tmp_path / "provenance.json").write_text(json.dumps(provenance_table(truth="truth/0")))
    assert "no saved predictions" in refused(capsys, str(tmp_path))
    (tmp_path / "test").mkdir()
    (tmp_path / "test" / "0000.npz").write_bytes(b"PK broken")
    assert "no folder" in refused(capsys, str(tmp_path))
    (tmp_path / "truth" / "0").mkdir(parents=True)
    Image.new("RGB", (16, 16)).save(tmp_path / "truth" / "0" / "0000.png")
    assert "0000.npz cannot be read" in refused(capsys, str(tmp_path))


def test_protocols_are_listed_with_their_sources(capsys) -> None:
    assert run(["list", "protocols"]) == 0
    text = capsys.readouterr().out
    assert all(f" {name} " in text for name in PROTOCOLS)
    assert "metrics.py" in text


def test_colours() -> None:
    assert parse_colour("white") == (1, 1, 1) and parse_colour("0.1, 0.2,1") == (0.1, 0.2, 1)
    for text in ("0.1,0.2", "2,0,0", "a,b,c", "nan,0,0"):
        with pytest.raises(InputError, match="cannot be"):
            parse_colour(text)
