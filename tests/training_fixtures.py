"""Small plans that fit the toy scene in a moment."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import pytest
import torch
from PIL import Image
from shared_folders import Once
from torch import Tensor

from invgraphics.core import Scene
from invgraphics.core.transforms import opencv_to_opengl
from invgraphics.experiments.build import build_plan
from invgraphics.experiments.executors.base import Outcome, Resources
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.recipes.recipe import Method, load_method
from invgraphics.runs import checkpoint
from invgraphics.runs.folder import CHECKPOINT
from invgraphics.testing import toy_scene
from invgraphics.training.budget import Budget
from invgraphics.training.fit import Fit

SMALL = {
    "volumetric/nerf": [
        "field.width=32",
        "field.layers=2",
        "field.geometry_features=8",
        "batches.rays=256",
        "renderer.sampler.coarse=16",
        "renderer.sampler.fine=16",
    ],
    "volumetric/hash": [
        "field.encoding.levels=6",
        "field.encoding.log2_size=12",
        "field.encoding.finest=48",
        "renderer.sampler.resolution=24",
        "renderer.sampler.steps_per_diagonal=96",
        "batches.rays=128",
        "batches.samples=4096",
    ],
    "splatting/gaussians": [
        "field.count=150",
        "field.max_init=150",
        "field.sh_degree=1",
        "hooks.1.every=10",
        "hooks.1.start=0.1",
    ],
}


class InProcess:
    """An executor that fits here and now, and fails with a text that a test wants."""

    made: ClassVar[list[str]]
    fails: Callable[[FitRequest], str]

    def __init__(self, resources: Resources | None = None) -> None:
        assert resources is None or resources.threads == torch.get_num_threads()

    def run(self, requests: Sequence[FitRequest], jobs: Path) -> Iterator[Outcome]:
        for request in requests:
            if error := type(self).fails(request):
                yield Outcome(request, 1, error, 0.5)
                continue
            fit_run(request)
            self.made.append(request.out)
            yield Outcome(request, 0, "", 1.5)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> type[InProcess]:
    """Fits of studies and comparisons run in this process: starting one takes longer than a fit of a few steps."""
    InProcess.made, InProcess.fails = [], staticmethod(lambda request: "")
    for module in ("invgraphics.experiments.executors.local", "invgraphics.experiments.compare"):
        monkeypatch.setattr(f"{module}.LocalExecutor", InProcess)
    return InProcess


@pytest.fixture(scope="session")
def scene() -> Scene:
    return toy_scene()


@pytest.fixture(scope="session")
def small() -> Callable[..., Method]:
    """A built-in method, shrunk for the toy scene."""
    return lambda name, *more: load_method(name, None, [*SMALL.get(name, []), *more])


@pytest.fixture(scope="session")
def make_fit(small: Callable[..., Method]) -> Callable[..., Fit]:
    """A fit of a shrunk method."""

    def make(name: str, scene: Scene, steps: int, seed: int = 0, *more: str) -> Fit:
        return Fit(build_plan(small(name, *more), scene, Budget(steps=steps), seed, torch.device("cpu")))

    return make


State = dict[str, dict[str, Tensor]]


def run_whole(fit: Fit, steps: int, path: Path, left: int = 12) -> State:
    """Final state of a fit that nothing interrupts; its checkpoint at ``path`` is of ``left`` steps before the last."""

    def save(loss: float) -> bool:
        if fit.steps == steps - left:
            checkpoint.save(path, fit.state())
        return False

    fit.run(save)
    return {part: {key: value.clone() for key, value in content.items()} for part, content in fit.state().items()}


def resume(fit: Fit, path: Path) -> State:
    """Final state of a new fit that goes on from a checkpoint, whatever torch's random state was."""
    torch.manual_seed(99)
    fit.load(checkpoint.load(path), seconds=1.0)
    fit.run(lambda loss: False)
    return fit.state()


def same_state(one: State, other: State) -> bool:
    """Whether two states are equal bit by bit."""
    return one.keys() == other.keys() and all(
        one[part].keys() == other[part].keys() and all(torch.equal(one[part][key], other[part][key]) for key in one[part])
        for part in one
    )


class ToyScores(NamedTuple):
    """PSNR over test views, and where prediction and truth show something, mean error of depth and overlap (IoU)."""

    psnr: float
    depth: float
    overlap: float


@torch.no_grad()
def toy_scores(fit: Fit) -> ToyScores:
    """Score a fit's test views without the project's own metrics."""
    scene, errors, depths, overlaps = fit.plan.scene, [], [], []
    for view in scene.test:
        assert view.alpha is not None and view.depth is not None
        picture = fit.plan.model.render(view.camera, normals=False)
        errors.append((picture.over(scene.background).clamp(0, 1) - view.over(scene.background)).square().mean())
        ours, true = picture.alpha >= 0.5, view.opacity() >= 0.5
        depths.append((picture.depth - view.depth)[ours & true].abs())
        overlaps.append(float((ours & true).sum() / (ours | true).sum()))
    psnr = -10 * math.log10(float(torch.stack(errors).mean()))
    return ToyScores(psnr, float(torch.cat(depths).mean()), sum(overlaps) / len(overlaps))


class Learnt(NamedTuple):
    """A fit at its end, with a checkpoint of some steps before."""

    name: str
    fit: Fit
    before: ToyScores
    checkpoint: Path
    final: State


def learn(name: str, fit: Fit, steps: int, folder: Path) -> Learnt:
    """Run a fit whole."""
    path = folder / CHECKPOINT
    before = toy_scores(fit)
    return Learnt(name, fit, before, path, run_whole(fit, steps, path))


def write_blender(scene: Scene, folder: Path) -> Path:
    """Write a scene's views as a Blender data set, the way NeRF's authors do."""
    for split, views in (("train", scene.train), ("test", scene.test)):
        (folder / split).mkdir(parents=True)
        frames = []
        for index, view in enumerate(views):
            assert view.alpha is not None
            rgba = torch.cat([view.image, view.alpha[..., None]], dim=2)
            Image.fromarray(rgba.numpy()).save(folder / split / f"r_{index}.png")
            pose = opencv_to_opengl(view.camera.cam_to_world).tolist()
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose})
        camera = views[0].camera
        angle = 2 * math.atan(camera.width / 2 / float(camera.focal[0]))
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return folder


@pytest.fixture(scope="session")
def toy_folder(once: Once) -> Path:
    """The toy scene on disk, the same folder for all test processes; to be read only."""
    return once("toy", lambda folder: write_blender(toy_scene(), folder))


TOY_STEPS = {"volumetric/hash": 400, "splatting/gaussians": 200}


@pytest.fixture(scope="session")
def toy_runs(toy_folder: Path, once: Once) -> dict[str, Path]:
    """Fits of the toy scene: method -> run folder, to be read only."""

    def fit(folder: Path) -> None:
        for method, steps in TOY_STEPS.items():
            out, budget = str(folder / method.replace("/", "-")), f"{steps}steps"
            fit_run(FitRequest(method=method, scene=str(toy_folder), out=out, budget=budget, overrides=tuple(SMALL[method])))

    folder = once("toy-runs", fit)
    return {method: folder / method.replace("/", "-") for method in TOY_STEPS}
