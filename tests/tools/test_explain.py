"""One pixel taken apart adds up to the pixel, by hand for few things and against the renderer for all."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from training_fixtures import SMALL

from invgraphics.cli import main
from invgraphics.core import Bounds, Camera, Context
from invgraphics.experiments.fitted import open_fitted
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.fields.analytic import Sphere
from invgraphics.renderers.gaussians.volume import GaussianExact, GaussianExactConfig, GaussianSorted, GaussianSortedConfig
from invgraphics.renderers.samplers import HierarchicalConfig, HierarchicalSampler, StratifiedConfig, StratifiedSampler
from invgraphics.renderers.splatting import Splatting, SplattingConfig
from invgraphics.renderers.volumetric import MAX_SKIPPED_WEIGHT, Volumetric
from invgraphics.studies.approximations import field_of, isotropic_gaussians
from invgraphics.tools.explain import ExplainRequest, explain

METHODS = ("volumetric/nerf", "volumetric/hash", "splatting/gaussians", "gaussian-volume/exact", "gaussian-volume/sorted")
CTX = Context(Bounds(-2 * torch.ones(3), 2 * torch.ones(3)))
HEAD_ON = Camera(torch.eye(4), torch.tensor([50.0, 50.0]), torch.tensor([10.5, 10.5]), 21, 21)
"""Looks along +z from the origin; the ray of pixel (10, 10) is the axis."""


@pytest.fixture(scope="module")
def runs(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("explained")
    found = {}
    for method in METHODS:
        small = SMALL.get(method, [item for item in SMALL["splatting/gaussians"] if not item.startswith("hooks")])
        out = str(root / method.replace("/", "-"))
        request = FitRequest(method=method, scene=str(toy_folder), out=out, budget="4steps", overrides=tuple(small))
        found[method] = fit_run(request)
    return found


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("split", ["test", "train"])
def test_what_is_listed_adds_up_to_the_rendered_pixel(runs: dict[str, Path], tmp_path: Path, method: str, split) -> None:
    fitted = open_fitted(runs[method])
    camera = getattr(fitted.scene, split)[1].camera
    picture = fitted.model.render(camera).over(fitted.scene.background)
    for column, row in ((9, 12), (14, 10), (0, 0)):
        explained = explain(ExplainRequest(runs[method], 1, (column, row), split, tmp_path))
        with (tmp_path / "ray.csv").open() as file:
            table = {name: np.array(column, float) for name, *column in zip(*csv.reader(file), strict=True)}
        rgb = np.stack([table[name] for name in ("red", "green", "blue")], axis=1)
        light = (table["weight"] * table["counted"])[:, None] * rgb
        through = 1 - table["weight"].sum()
        total = light.sum(axis=0) + through * fitted.scene.background.numpy()
        assert total == pytest.approx(picture[row, column].numpy(), abs=2e-5)
        assert explained.composited.numpy() == pytest.approx(total, abs=2e-5)
        shown = np.asarray(Image.open(tmp_path / "picture.png"))[row, column]
        rendered = explained.rendered.numpy()
        assert np.abs(shown / 255 - rendered.clip(0, 1)).max() <= 0.5 / 255 + 2e-5
        # The hash grid's kernel may leave out colours of samples whose weights sum to no more than this; others leave out none.
        assert rendered == pytest.approx(total, abs=MAX_SKIPPED_WEIGHT if method == "volumetric/hash" else 2e-5)
        if method != "gaussian-volume/exact":  # whose Gaussians share what they overlap in
            assert table["weight"] == pytest.approx(table["transmittance"] * table["alpha"], abs=2e-6)
            left = np.cumprod(1 - table["alpha"])
            assert table["transmittance"][1:] == pytest.approx(left[:-1], abs=2e-5)


def test_two_splats_by_hand() -> None:
    """A red one of opacity 1/2 in front of a blue one of opacity 4/5, both on the axis."""
    means, rgb = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 1.0]]), torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    field = field_of(isotropic_gaussians(means, torch.tensor([0.1, 0.1]), torch.tensor([0.8, 0.5]), rgb)).float()
    found = Splatting(SplattingConfig(dilation=0.0)).contributions(field, HEAD_ON, (10, 10), CTX)
    assert found.kind == "splats"
    for name, expected in {
        "t": [1.0, 3.0],
        "begin": [0.9, 2.9],
        "end": [1.1, 3.1],
        "alpha": [0.5, 0.8],
        "transmittance": [1.0, 0.5],
        "weight": [0.5, 0.4],
    }.items():
        assert getattr(found, name).tolist() == pytest.approx(expected, abs=1e-5), name
    assert found.rgb.flatten().tolist() == pytest.approx([1, 0, 0, 0, 0, 1], abs=1e-5)
    assert found.colour.tolist() == pytest.approx([0.5, 0, 0.4], abs=1e-5)
    assert (found.opacity, found.expected_depth) == pytest.approx((0.9, (0.5 * 1 + 0.4 * 3) / 0.9), abs=1e-5)
    assert found.median_depth == pytest.approx(1.0, abs=1e-5)
    # Marched, each of them has lost half of its optical depth at its centre: sqrt(1 - a).
    t, light = found.marched.t.numpy(), found.marched.transmittance.numpy()
    assert np.interp([1, 3], t, light) == pytest.approx([math.sqrt(0.5), 0.5 * math.sqrt(0.2)], abs=1e-3)
    assert light[-1] == pytest.approx(0.1, abs=1e-4)
    density = found.marched.density.numpy()
    assert np.trapezoid(density, t) == pytest.approx(-math.log(0.1), rel=1e-3)


@pytest.mark.parametrize(
    "renderer",
    [
        Splatting(SplattingConfig(shape="disc", dilation=0.5)),
        Splatting(SplattingConfig(dilation=0.1, antialiased=True)),
        Splatting(SplattingConfig(max_grad_splats=3)),
        GaussianSorted(GaussianSortedConfig("splat", "centre")),
        GaussianSorted(GaussianSortedConfig("physical", "ray")),
        GaussianExact(GaussianExactConfig("physical")),
    ],
    ids=lambda renderer: str(renderer.config)[:60],
)
def test_every_way_to_show_gaussians_adds_up(renderer) -> None:
    """A cloud so dense that splatting stops before its end."""
    generator = torch.Generator().manual_seed(1)
    means = torch.rand(400, 3, generator=generator) * 1.6 - 0.8 + torch.tensor([0.0, 0.0, 3.0])
    some = isotropic_gaussians(means, torch.full((400,), 0.1), torch.full((400,), 0.6), torch.rand(400, 3, generator=generator))
    turned = torch.randn(400, 4, generator=generator).double()
    scales = 0.05 + 0.2 * torch.rand(400, 3, generator=generator).double()
    field = field_of(type(some)(some.means, turned, scales, some.opacities, some.sh)).float()
    with torch.no_grad():
        picture, _ = renderer.render_image(field, HEAD_ON, CTX)
    for column, row in ((10, 10), (3, 7), (20, 0)):
        found = renderer.contributions(field, HEAD_ON, (column, row), CTX)
        assert found.colour.tolist() == pytest.approx(picture.rgb[row, column].tolist(), abs=2e-5)
        assert found.opacity == pytest.approx(float(picture.alpha[row, column]), abs=2e-5)
        assert bool((found.alpha > 0).all())
    assert len(found) > 3


@pytest.mark.parametrize("sampler", ["stratified", "hierarchical"])
def test_a_ball_of_fog_in_closed_form(sampler: str) -> None:
    """Density 3 over a chord of length 1 from distance 1.5: T = exp(-3 (t - 1.5)) inside."""
    ball = Sphere(density=3.0, radius=0.5, centre=(0.0, 0.0, 2.0), colour=(0.2, 0.6, 0.4))
    chosen = (
        StratifiedSampler(StratifiedConfig(400))
        if sampler == "stratified"
        else HierarchicalSampler(HierarchicalConfig(coarse=200, fine=200))
    )
    bounds = Bounds(-3 * torch.ones(3), 3 * torch.ones(3))
    found = Volumetric(chosen).contributions(ball, HEAD_ON, (10, 10), Context(bounds))
    assert found.opacity == pytest.approx(1 - math.exp(-3), abs=2e-3)
    t, light = found.profile.t.numpy(), found.profile.transmittance.numpy()
    at = np.array([1.0, 1.75, 2.0, 2.25, 2.8])
    assert np.interp(at, t, light) == pytest.approx(np.exp(-3 * (at - 1.5).clip(0, 1)), abs=1e-2)
    assert np.interp(found.end[:-1].numpy(), t, light) == pytest.approx(found.transmittance[1:].numpy(), abs=1e-5)
    halfway = found.transmittance * (1 - found.alpha).sqrt()
    assert np.interp(found.t.numpy(), t, light) == pytest.approx(halfway.numpy(), abs=2e-3)
    assert found.median_depth == pytest.approx(1.5 + math.log(2) / 3, abs=1e-2)
    inside = (found.begin > 1.51) & (found.end < 2.49)
    assert found.density[inside].unique().tolist() == [3.0]
    assert np.interp([1.0, 2.0], t, found.profile.density.numpy()).tolist() == [0.0, 3.0]
    assert len(found.passes) == (sampler == "hierarchical")
    for one in found.passes:
        assert len(one.weight) == 200
        assert float(one.weight.sum()) == pytest.approx(1 - math.exp(-3), abs=1e-2)


def test_overlapping_gaussians_share_their_light() -> None:
    """Two equal Gaussians at one place: half of the light each when integrated, unequal when one comes first."""
    twins = isotropic_gaussians(torch.tensor([[0.0, 0.0, 2.0]] * 2), torch.tensor([0.1, 0.1]), torch.tensor([0.6, 0.6])).means
    field = field_of(isotropic_gaussians(twins, torch.tensor([0.1, 0.1]), torch.tensor([0.6, 0.6]))).float()
    exact = GaussianExact(GaussianExactConfig()).contributions(field, HEAD_ON, (10, 10), CTX)
    ordered = GaussianSorted(GaussianSortedConfig()).contributions(field, HEAD_ON, (10, 10), CTX)
    assert exact.weight.tolist() == pytest.approx([0.42, 0.42], abs=1e-4)
    assert ordered.weight.tolist() == pytest.approx([0.6, 0.24], abs=1e-4)
    assert exact.transmittance.tolist() == pytest.approx([0.4, 0.4], abs=1e-4)  # half of the optical depth of alpha 0.84
    assert ordered.transmittance.tolist() == pytest.approx([1, 0.4], abs=1e-4)
    assert exact.opacity == pytest.approx(ordered.opacity, abs=1e-4)


def test_the_order_of_centres_is_shown_where_it_is_wrong() -> None:
    """A long Gaussian whose centre is nearer, but which the ray meets behind another one."""
    turn = math.pi / 4
    gaussians = isotropic_gaussians(
        torch.tensor([[-1.0, 0.0, 1.9], [0.0, 0.0, 2.0]]), torch.tensor([0.05] * 2), torch.tensor([0.5] * 2)
    )
    quaternion = torch.tensor([[math.cos(-turn / 2), 0.0, math.sin(-turn / 2), 0.0], [1.0, 0, 0, 0]]).double()
    scales = torch.tensor([[1.2, 0.05, 0.05], [0.05, 0.05, 0.05]]).double()
    field = field_of(type(gaussians)(gaussians.means, quaternion, scales, gaussians.opacities, gaussians.sh)).float()
    found = Splatting(SplattingConfig(dilation=0.0)).contributions(field, HEAD_ON, (10, 10), CTX)
    assert found.t[0] > found.t[1] + 0.3


def test_a_ray_that_meets_nothing(tmp_path: Path) -> None:
    field = field_of(isotropic_gaussians(torch.tensor([[0.0, 0.0, -3.0]]), torch.tensor([0.1]), torch.tensor([0.8]))).float()
    for renderer in (
        Splatting(SplattingConfig()),
        GaussianExact(GaussianExactConfig()),
        GaussianSorted(GaussianSortedConfig()),
    ):
        found = renderer.contributions(field, HEAD_ON, (10, 10), CTX)
        assert (len(found), found.opacity, found.expected_depth, found.median_depth) == (0, 0, math.inf, math.inf)
        assert found.colour.tolist() == [0, 0, 0]
    away = Bounds(torch.tensor([5.0, 5, 5]), torch.tensor([6.0, 6, 6]))
    found = Volumetric(StratifiedSampler(StratifiedConfig(4))).contributions(Sphere(1.0, 0.5), HEAD_ON, (10, 10), Context(away))
    assert len(found) == 0
    assert found.profile is None


def test_command(runs: dict[str, Path], capsys) -> None:
    run = runs["volumetric/nerf"]
    assert main.run(["explain", str(run), "--view", "0", "--pixel", "9,12"]) == main.DONE
    said = capsys.readouterr().out
    assert "pixel 9,12 of test view 0: 32 samples, the 24 heaviest" in said
    figure = Path(said.splitlines()[-1])
    assert figure == run / "explained" / "test-0000-9-12" / "ray.png"
    assert sorted(path.name for path in figure.parent.iterdir()) == [
        "picture.png", "ray.csv", "ray.json", "ray.png", "ray.svg", "truth.png",
    ]  # fmt: skip
    facts = json.loads((figure.parent / "ray.json").read_text())
    assert str(run) not in json.dumps(facts), "an explanation names no private path"
    assert f"the truth ({', '.join(f'{value:.3f}' for value in facts['pixel']['true'])})" in said


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--view", "0", "--pixel", "24,3"], "The pixel 24,3 lies outside test view 0, of 24x24 pixels."),
        (["--view", "3", "--pixel", "2,3"], "--view cannot be 3.\nExpected a test view, 0 to 2."),
        (["--view", "12", "--pixel", "2,3", "--split", "train"], "Expected a train view, 0 to 11."),
        (["--view", "-1", "--pixel", "2,3"], "--view cannot be -1."),
        (["--view", "0", "--pixel", "2x3"], "--pixel cannot be '2x3'."),
    ],
)
def test_bad_requests_get_a_sentence(runs: dict[str, Path], capsys, words: list[str], told: str) -> None:
    assert main.run(["explain", str(runs["volumetric/hash"]), *words]) == main.BAD_INPUT
    assert told in capsys.readouterr().err


def test_what_is_no_run_gets_a_sentence(tmp_path: Path, capsys) -> None:
    assert main.run(["explain", str(tmp_path), "--view", "0", "--pixel", "1,1"]) == main.BAD_INPUT
    assert "is not a run" in capsys.readouterr().err
