"""docs/extending.md as a third-party package: installed by entry points, conforming, fitted, compared and reported."""

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import torch
from PIL import Image

from invgraphics import core
from invgraphics.core import Camera, Model
from invgraphics.core.transforms import look_at
from invgraphics.metrics.base import Metric, Pair
from invgraphics.renderers.samplers import StratifiedConfig
from invgraphics.renderers.volumetric import VolumetricConfig
from invgraphics.scenes.open import Loader
from invgraphics.testing import TwoBalls, toy_scene
from invgraphics.training import losses, penalties
from invgraphics.training.hooks import Hook

PAGE = (Path(__file__).parents[1] / "docs" / "extending.md").read_text()


def _blocks(language: str) -> str:
    return "\n".join(re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.S | re.M))


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A process environment in which the page's package is installed."""
    info = tmp_path_factory.mktemp("site") / "voxel_world-1.0.dist-info"
    info.mkdir()
    (info.parent / "voxel_world.py").write_text(_blocks("python"))
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: voxel-world\nVersion: 1.0\n")
    groups = tomllib.loads(_blocks("toml"))["project"]["entry-points"]
    lines = [line for group, names in groups.items() for line in (f"[{group}]", *(f"{key} = {names[key]}" for key in names))]
    (info / "entry_points.txt").write_text("\n".join(lines))
    paths = [str(info.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "200"}


@pytest.fixture(scope="module")
def turntable(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen turns of two balls, seen from a little above."""
    folder = tmp_path_factory.mktemp("turntable")
    scene, size = toy_scene(views=2, size=8), 20
    renderer, field = VolumetricConfig(StratifiedConfig(count=96)).build(scene), TwoBalls()
    for index in range(16):
        turn = torch.tensor(2 * torch.pi * index / 16)
        pose = look_at(torch.tensor([3 * turn.cos(), 3 * turn.sin(), 1.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        camera = Camera(pose, torch.full((2,), 26.0), torch.full((2,), size / 2), size, size)
        picture = Model(field, renderer, scene.bounds).render(camera)
        straight = picture.rgb / picture.alpha.clamp_min(1e-3)[..., None]
        pixels = (torch.cat([straight, picture.alpha[..., None]], dim=2).clamp(0, 1) * 255).round().to(torch.uint8)
        Image.fromarray(pixels.numpy()).save(folder / f"{index:03d}.png")
    (folder / "turntable.json").write_text(json.dumps({"distance": 3.0, "height": 1.0, "focal": 26.0}))
    return folder


LOSS = """
import torch, invgraphics as ig
from invgraphics.core import Batch, Bounds, Context, Rendering, Trace
from voxel_world import EmptyLoss
alpha = torch.tensor([0.5, 0.5, 0.25, 1.0])
batch = Batch(torch.ones(4, 3), torch.tensor([0.0, 0.5, 1.0, 1.0]), torch.ones(3))
bounds = Bounds(-torch.ones(3), torch.ones(3))
rendering = Rendering(torch.ones(4, 3), alpha, alpha)
for progress in (0.0, 0.5):
    print(float(EmptyLoss(weight=2)(rendering, Trace(), batch, Context(bounds, progress=progress))))
scene = ig.load_scene(TURNTABLE)
small = {'field.resolution': 8, 'batches.rays': 64}
names = ('volumetric/voxels', 'volumetric/voxels-empty')
plain, empty = (ig.fit(ig.load_method(name, set=small), scene, '60steps') for name in names)
print(plain.scores['halo'], empty.scores['halo'])
"""
PENALTY_AND_HOOK = """
from torch.nn.functional import softplus
penalty, hook = (ig.load_method('volumetric/voxels-smooth', set=small | {part: []}) for part in ('hooks', 'penalties'))
for fit in (plain, ig.fit(penalty, scene, '60steps'), ig.fit(hook, scene, '60steps')):
    grid = fit.model.field.grid.detach()
    rough = sum(float(grid.diff(dim=axis).square().mean()) for axis in (1, 2, 3))
    density = softplus(grid[3])
    print(rough, int(((density > 1e-3) & (density < 0.05)).sum()))
"""
SCENE = """
import numpy as np
from invgraphics.testing import toy_scene
from voxel_world import scene_of
views = toy_scene(views=9, size=12).train
pictures = np.stack([view.image.numpy() for view in views])
poses = np.stack([view.camera.cam_to_world.double().numpy() for view in views])
scene = scene_of(pictures, poses, float(views[0].camera.focal[0]))
print(len(scene.train), len(scene.test), ig.fit('splatting/gaussians', scene, '5steps').scores['psnr'])
"""


def _run(environment: dict[str, str], code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def printed(environment: dict[str, str], turntable: Path) -> dict[str, list[float]]:
    """What each of the codes above prints, one after the other in one process, which takes seconds to start."""
    parts = {"loss": LOSS, "penalty and hook": PENALTY_AND_HOOK, "scene": SCENE}
    code = "print(chr(12))".join(f"\n{part.replace('TURNTABLE', repr(str(turntable)))}\n" for part in parts.values())
    said = _run(environment, code).split("\f")
    return {name: [float(word) for word in text.split()] for name, text in zip(parts, said, strict=True)}


def test_signatures_on_the_page_are_those_of_the_contract() -> None:
    contracts = ((core.Field, "query"), (core.RayRenderer, "render_rays"), (core.Sampler, "sample"))
    for owner, name in (*contracts, (Loader, "matches"), (Loader, "load")):
        hints = owner.__dict__[name].__annotations__
        written = ", ".join(f"{key}: {hint}" for key, hint in hints.items() if key != "return")
        assert f"`{name}({written}) -> {hints['return']}`" in PAGE, name
    arguments, result = get_args(losses.Loss)
    called = zip(("rendering", "trace", "batch", "ctx"), arguments, strict=True)
    signature = ", ".join(f"{name}: {kind.__name__}" for name, kind in called)
    assert f"`__call__({signature}) -> {result.__name__}`" in PAGE and f"def __call__(self, {signature})" in PAGE
    arguments, result = get_args(penalties.Penalty)
    called = zip(("field", "renderer", "ctx"), arguments, strict=True)
    signature = ", ".join(f"{name}: {kind.__name__}" for name, kind in called)
    assert f"`__call__({signature}) -> {result.__name__}`" in PAGE and f"def __call__(self, {signature})" in PAGE
    for name in ("before_step", "after_backward", "after_step"):
        assert Hook.__dict__[name].__annotations__ == {"state": "FitState", "return": "None"} and f"`{name}`" in PAGE
    assert "`compute(pair: Pair) -> float`" in PAGE and get_type_hints(Metric)["compute"] == Callable[[Pair], float]
    owners = dict(zip(("rendering", "trace", "batch", "ctx"), get_args(losses.Loss)[0], strict=True), pair=Pair)
    named = re.findall(r"`(rendering|trace|batch|ctx|pair)\.(\w+)`", PAGE)
    assert {owner for owner, _ in named} == set(owners)
    for owner, name in named:
        assert name in {field.name for field in fields(owners[owner])} | set(vars(owners[owner])), f"{owner}.{name}"


def test_the_parts_conform_and_take_part(environment: dict[str, str], turntable: Path, tmp_path: Path) -> None:
    code = (
        "from voxel_world import VoxelsConfig, BrightestConfig, MidpointsConfig\n"
        "from invgraphics.testing import check_field, check_renderer, toy_scene\n"
        "toy = toy_scene(views=2, size=8)\n"
        "check_field(VoxelsConfig(resolution=8).build(toy), toy)\n"
        "check_renderer(BrightestConfig(count=16).build(toy), VoxelsConfig(resolution=8).build(toy), toy)\n"
        "import invgraphics as ig\n"
        "volume = ig.renderers.volumetric.VolumetricConfig(MidpointsConfig(count=16)).build(toy)\n"
        "check_renderer(volume, VoxelsConfig(resolution=8).build(toy), toy)\n"
        "from invgraphics.cli import main\n"
        "main.run(['list', 'fields', 'renderers', 'samplers', 'methods'])\n"
        f"scene = ig.load_scene({str(turntable)!r})\n"
        "small = {'field.resolution': 16, 'batches.rays': 256}\n"
        "names = ['volumetric/voxels', 'brightest/voxels']\n"
        "methods = [ig.load_method(name, set=small) for name in names]\n"
        f"out = {str(tmp_path / 'report')!r}\n"
        "report = ig.compare(scene, methods, budget='250steps', out=out, render_with=['brightest/voxels'])\n"
        "print(len(scene.train), len(scene.test), report.failures, *[report.scores(name)['psnr'] for name in report.methods])\n"
        "print((report.run(report.methods[0]).through('brightest/voxels')).render(scene.test[0].camera).rgb.shape)\n"
    )
    *listed, numbers, shape = _run(environment, code).splitlines()
    for name in ("voxel_world:VoxelsConfig", "voxel_world:BrightestConfig", "voxel_world:MidpointsConfig", "brightest/voxels"):
        assert any(name in line for line in listed), name
    train, test, failures, *psnr = numbers.split()
    assert (train, test, failures, shape) == ("14", "2", "()", "torch.Size([20, 20, 3])")
    assert float(psnr[0]) > 18 and float(psnr[1]) > 12, psnr
    assert "Dense voxel grid" in (tmp_path / "report" / "index.html").read_text()


def test_the_loss_clears_what_the_metric_sees(printed: dict[str, list[float]]) -> None:
    early, late, without, cleared = printed["loss"]
    assert (early, late) == (0.0, 2 * (0.5 + 0.25) / 4)
    assert 0 < cleared < 0.8 * without, (without, cleared)


def test_the_penalty_smooths_and_the_hook_clears(printed: dict[str, list[float]]) -> None:
    rough, hazy, smooth, _, _, clear = printed["penalty and hook"]
    assert smooth < 0.9 * rough, "by the penalty alone: corners that the hook has emptied are steps"
    assert clear == 0 < hazy, "by the hook alone"


def test_a_scene_made_in_python(printed: dict[str, list[float]]) -> None:
    train, test, psnr = printed["scene"]
    assert (train, test) == (7, 2) and psnr > 5
