"""Depth has one unit wherever it is shown or stored: the data set's world, on a scene whose local unit is not the world's."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from invgraphics.experiments import evaluate as evaluation
from invgraphics.experiments.fitted import Fitted, open_fitted
from invgraphics.report.data.ray import read_ray
from invgraphics.runs.folder import RunFolder
from invgraphics.tools import explain as explaining
from invgraphics.tools import film as filming
from invgraphics.tools.colorize import colorize

METHODS = ("volumetric/hash", "splatting/gaussians")
SCALE = 3.0


def _enlarged(run: Path, scene: str | None = None) -> Fitted:
    """The run with a world in which a local unit is three long."""
    fitted = open_fitted(run, scene)
    similarity = torch.diag(torch.tensor([SCALE, SCALE, SCALE, 1.0]))
    return replace(fitted, scene=replace(fitted.scene, world_from_local=similarity))


def _range(legend: str) -> list[float]:
    return [float(word) for word in legend.replace("(", " ").replace(",", " ").split() if word.replace(".", "").isdigit()]


@pytest.mark.parametrize("method", METHODS)
def test_every_depth_is_in_world_units(toy_runs: dict[str, Path], method: str, tmp_path: Path, monkeypatch, capsys) -> None:
    run = toy_runs[method]
    fitted = _enlarged(run)
    camera = fitted.scene.test[0].camera
    rendering = fitted.model.render(camera, normals=False)
    solid = (rendering.alpha >= 0.5) & rendering.depth.isfinite()
    row, column = [int(index) for index in solid.nonzero()[len(solid.nonzero()) // 2]]
    local = float(rendering.depth[row, column])

    kept = RunFolder(tmp_path)
    kept.arrays(0).parent.mkdir()
    evaluation._save_view(kept, 0, rendering, fitted.scene)
    with np.load(kept.arrays(0)) as arrays:
        assert arrays["depth"][row, column] == pytest.approx(SCALE * local, rel=1e-5), "what the report shows"

    monkeypatch.setattr(explaining, "open_fitted", _enlarged)
    request = explaining.ExplainRequest(run, 0, (column, row), out=tmp_path / "ray")
    explanation = explaining.explain(request)
    pixel = explanation.record.pixel
    assert pixel.depth == pytest.approx(SCALE * local, rel=1e-4)
    ray = read_ray(tmp_path / "ray")
    assert ray.record.length_unit == "world"
    weight, t = ray.columns["weight"], ray.columns["t"]
    mean = float((weight * t).sum() / weight.sum())
    assert mean == pytest.approx(pixel.expected, rel=1e-5) and mean == pytest.approx(SCALE * local, rel=0.02)
    if "density" in ray.columns:  # optical depth has no unit
        length = ray.columns["end"] - ray.columns["begin"]
        assert -np.expm1(-ray.columns["density"] * length) == pytest.approx(ray.columns["alpha"], abs=1e-4)

    values = rendering.depth[solid] * SCALE
    expected = values.quantile(torch.tensor([0.01, 0.99])).tolist()
    viewer = colorize("depth", [rendering], [fitted.scene], [None]).legend
    assert _range(viewer) == pytest.approx(expected, rel=0.02) and "world units" in viewer

    monkeypatch.setattr(filming, "open_fitted", _enlarged)
    monkeypatch.setattr(filming, "PATHS", {"orbit": lambda scene, frames: [scene.test[0].camera] * frames})
    filming.film(filming.FilmRequest(run, tmp_path / "depth.mp4", "orbit", 2, show="depth"))
    told = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("Depth:"))
    assert _range(told) == pytest.approx(expected, rel=0.05) and "world units" in told


def test_older_explanations_say_local(toy_runs: dict[str, Path], tmp_path: Path) -> None:
    explaining.explain(explaining.ExplainRequest(toy_runs["volumetric/hash"], 0, (9, 9), out=tmp_path))
    facts = json.loads((tmp_path / "ray.json").read_text())
    del facts["length_unit"]
    (tmp_path / "ray.json").write_text(json.dumps(facts))
    assert read_ray(tmp_path).record.length_unit == "local"
