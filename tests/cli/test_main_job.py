"""The main job on a toy data set: compare, then evaluate and report what it left."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from invgraphics.cli import main
from invgraphics.cli.report import failures_in, runs_in
from invgraphics.errors import InputError
from invgraphics.runs.comparison import ComparisonRecord, Failure
from invgraphics.runs.folder import RunFolder

SIZE = 16


def write_blender_scene(folder: Path) -> None:
    """A grey disc before nothing, seen by cameras on a ring; Blender's axes: the camera looks along its -z."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    disc = ((x**2 + y**2) < 25)[..., None]
    rgba = (np.concatenate([np.full((SIZE, SIZE, 3), 0.5) * disc, disc], axis=-1) * 255).astype(np.uint8)
    for split, angles in {"train": [0.0, 1.0, 2.0, 3.0], "val": [5.0], "test": [4.0, 0.5]}.items():
        frames = []
        for index, angle in enumerate(angles):
            back = np.array([math.cos(angle), math.sin(angle), 0.0])
            up = np.array([0.0, 0.0, 1.0])
            pose = np.eye(4)
            pose[:3, :3] = np.stack([np.cross(up, back), up, back], axis=1)
            pose[:3, 3] = 4 * back
            name = f"{split}_{index}"
            Image.fromarray(rgba, "RGBA").save(folder / f"{name}.png")
            frames.append({"file_path": f"./{name}", "transform_matrix": pose.tolist()})
        content = {"camera_angle_x": 0.7, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))


def test_compare_then_evaluate_and_report(tmp_path, capsys, request) -> None:
    data, out = tmp_path / "disc", tmp_path / "out"
    data.mkdir()
    write_blender_scene(data)
    words = ["--methods", "splatting/gaussians", "--budget", "2steps", "--kernels", "reference", "--out", str(out)]
    assert main.run(["compare", str(data), *words]) == main.DONE
    text = capsys.readouterr().out
    assert "splatting/gaussians" in text
    assert "mean image" in text
    assert text.splitlines()[-1] == str(out / "index.html")
    assert (out / "index.html").is_file()

    table = json.loads((out / "compare.json").read_text())
    assert (table["preset"], table["preset_choice"]) == ("laptop", "as for every budget in steps")
    assert "preset: laptop, as for every budget in steps" in (out / "index.md").read_text()

    for quicker in ("in_process", "unpainted"):  # one fit in a process of its own is enough, and so is one page with plots
        request.getfixturevalue(quicker)
    cell = out / "runs" / "splatting-gaussians" / "seed-0"
    assert runs_in(out) == runs_in(cell) == [cell]
    assert main.run(["evaluate", str(cell), "--protocol", "float"]) == main.DONE
    assert "protocol float" in capsys.readouterr().out
    assert json.loads((cell / "scores.float.json").read_text())["protocol"] == "float"
    # Of other code: kept with --keep, fitted again without.
    provenance = json.loads((cell / "provenance.json").read_text())
    (cell / "provenance.json").write_text(json.dumps(provenance | {"cell_sha256": "0" * 64}))
    scored = (cell / "scores.json").stat().st_mtime_ns
    assert main.run(["compare", str(data), *words, "--keep"]) == main.DONE
    assert (cell / "scores.json").stat().st_mtime_ns == scored
    again = json.loads((out / "compare.json").read_text())
    assert again["command"] == table["command"] and "wall_seconds" in table and "wall_seconds" not in again
    (cell / "scores.float.json").unlink()
    assert main.run(["compare", str(data), *words, "--keep", "--protocol", "float"]) == main.DONE
    assert json.loads((cell / "scores.float.json").read_text())["protocol"] == "float"
    assert (cell / "scores.json").stat().st_mtime_ns == scored
    assert main.run(["compare", str(data), *words]) == main.DONE
    assert (cell / "scores.json").stat().st_mtime_ns > scored
    assert main.run(["evaluate", str(cell), "--protocol", "float"]) == main.DONE
    for name in ("scores.json", "scores.float.json", "provenance.json"):  # of the fit, and of the later evaluation
        assert json.loads((cell / name).read_text())["preset_choice"] == "as for every budget in steps"

    # What cannot fit the scene is known before the first fit, and what the folder holds beside the report is named.
    capsys.readouterr()
    other = ["compare", str(data), "--methods", "volumetric/hash,surface/mesh:field.source=none", "--budget", "1steps"]
    assert main.run([*other, "--out", str(out)]) == main.BAD_INPUT
    assert "surface/mesh:field.source=none: none is not a run" in capsys.readouterr().err
    assert not list(out.glob("runs/volumetric-hash*"))
    assert main.run(["compare", str(data), "--methods", "volumetric/nerf", *words[2:]]) == main.DONE
    assert "Not part of this report" in capsys.readouterr().err
    assert main.run(["compare", str(data), *words]) == main.DONE

    assert main.run(["report", str(cell)]) == main.BAD_INPUT
    assert "--out" in capsys.readouterr().err
    assert main.run(["report", str(cell), "--out", str(tmp_path / "page")]) == main.DONE
    assert capsys.readouterr().out.strip() == str(tmp_path / "page" / "index.html")

    assert main.run(["fit", "splatting/gaussians", str(data), "--out", str(cell)]) == main.BAD_INPUT
    assert "holds another run: its budget is 2 steps, not 60 s" in capsys.readouterr().err


def test_folders_without_runs_are_told_apart(tmp_path) -> None:
    with pytest.raises(InputError, match="no finished run"):
        runs_in(tmp_path)
    for seed in (0, 1):
        (tmp_path / "runs" / "a" / f"seed-{seed}").mkdir(parents=True)
        (tmp_path / "runs" / "a" / f"seed-{seed}" / "scores.json").write_text("{}")
    assert len(runs_in(tmp_path)) == 2
    lost = Failure(method="a", seed=2, error="Boom.")
    record = ComparisonRecord(scene="s", methods=("a",), runs=("runs/a/seed-1",), failures=(lost,))
    RunFolder(tmp_path).write(record)
    assert runs_in(tmp_path) == [tmp_path / "runs" / "a" / "seed-1"]  # seed 0 is of another command
    assert [(one.seed, one.error) for one in failures_in(tmp_path)] == [(2, "Boom.")]
    RunFolder(tmp_path).write(replace(record, runs=()))
    assert runs_in(tmp_path) == []  # a comparison all of whose fits failed has a report as well
