"""The figure of a ray is drawn from its folder alone, for all kinds and for rays that meet nothing."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from invgraphics.errors import InputError
from invgraphics.report.data.ray import close_up, read_ray, whole_ray
from invgraphics.report.figures.ray import draw_ray

KEYS = ("t", "begin", "end", "alpha", "transmittance", "weight", "red", "green", "blue", "counted")


PROFILE = {"t": [1.0, 2.0, 3.0], "density": [0.0, 4.0, 0.0], "transmittance": [1.0, 0.5, 0.1]}


def _write(folder: Path, rows: list[tuple[float, ...]], **more) -> Path:
    folder.mkdir(exist_ok=True)
    for name in ("picture", "truth"):
        Image.new("RGB", (20, 12), (40, 90, 160)).save(folder / f"{name}.png")
    columns = {key: [row[index] for row in rows] for index, key in enumerate(KEYS)}
    pixel = {"column": 3, "row": 4, "alpha": 0.9, "depth": 2.0, "expected": 2.1, "median": 2.0, "true_depth": 1.9}
    facts = {
        "method": "volumetric/nerf",
        "scene": "toy",
        "split": "test",
        "view": 1,
        "colour": "srgb",
        "background": [1.0, 1.0, 1.0],
        "kind": "samples",
        "near": 1.0,
        "far": 9.0,
        "space": "box",
        "pixel": pixel | {"rendered": [0.2, 0.3, 0.4], "true": [0.9, 0.9, 0.9]},
        "contributions": columns | {"density": None},
        "profile": PROFILE if rows else None,
        "marched": None,
        "passes": [],
    }
    (folder / "ray.json").write_text(json.dumps(facts | more))
    return folder


ROWS = [(1.5, 1.0, 2.0, 0.5, 1.0, 0.5, 1, 0, 0, 1), (2.5, 2.0, 3.0, 0.8, 0.5, 0.4, 0, 0, 1, 1)]


@pytest.mark.parametrize("kind", ["samples", "splats", "gaussians"])
@pytest.mark.parametrize("rows", [ROWS, []])
def test_every_kind_is_drawn(tmp_path: Path, kind: str, rows: list) -> None:
    coarse = [{"t0": [1.0, 2.0], "t1": [2.0, 3.0], "weight": [0.4, 0.3]}] if kind == "samples" and rows else []
    folder = _write(tmp_path / "ray", rows, kind=kind, passes=coarse, profile=None if kind == "splats" or not rows else PROFILE)
    picture = np.asarray(Image.open(draw_ray(folder)).convert("RGB"))
    assert picture.shape == (1280, 2240, 3)
    assert picture.std() > 10
    text = (folder / "ray.svg").read_text()
    words = ["volumetric/nerf on toy, test view 1, pixel (3, 4)", "true depth 1.900", "rendered", "0.200, 0.300, 0.400"]
    if rows:
        words += ["distance along the ray", "transmittance T" if kind != "splats" else "in the order of centres"]
    words += [] if rows else ["nothing on this ray"]
    for word in [*words, *(["weights of pass 1"] if coarse else [])]:
        assert word in text, word


def test_colours_of_the_strips(tmp_path: Path) -> None:
    """Below the axis, what the pixel would show up to each place: white, then half red, then mostly red and blue."""
    folder = _write(tmp_path / "ray", ROWS, near=1.0, far=3.0)
    picture = np.asarray(Image.open(draw_ray(folder)).convert("RGB"), int)
    found = {tuple(colour) for colour in picture[-140:-60].reshape(-1, 3)}
    half, end = (255, 128, 128), (153, 26, 128)
    for wanted in (half, end):
        assert min(sum(abs(np.subtract(wanted, colour))) for colour in found) <= 4, wanted


def test_close_up_holds_the_light(tmp_path: Path) -> None:
    rows = [(t, t - 0.01, t + 0.01, 0.3, 0.7**i, 0.3 * 0.7**i, 1, 1, 1, 1) for i, t in enumerate(np.linspace(4, 4.3, 12))]
    ray = read_ray(_write(tmp_path / "ray", rows))
    whole = whole_ray(ray)
    assert whole == (1.0, 9.0)
    low, high = close_up(ray, whole)
    assert 3.5 < low < 4
    assert 4.1 < high < 4.6
    assert close_up(read_ray(_write(tmp_path / "wide", ROWS, far=3.0)), (1.0, 3.0)) is None
    unbounded = read_ray(_write(tmp_path / "far", rows, far=1000.0, space="contracted"))
    assert whole_ray(unbounded)[1] < 10


def test_broken_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ray\.json' is missing"):
        draw_ray(tmp_path)
    folder = _write(tmp_path / "ray", ROWS, contributions={"t": [1.0]})
    with pytest.raises(InputError, match=r"lacks the key 'contributions\.begin'"):
        draw_ray(folder)
