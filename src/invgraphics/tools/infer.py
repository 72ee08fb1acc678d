"""Inference of unseen instances of a class of objects from few views, scored beside baselines."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import torch

from invgraphics.core import Conditional, Model, Scene, View
from invgraphics.errors import InputError
from invgraphics.experiments.evaluate import display
from invgraphics.experiments.fitted import Fitted, load_fitted
from invgraphics.experiments.progress import Reporter
from invgraphics.files import write_picture
from invgraphics.metrics.protocols import protocol_named, score
from invgraphics.recipes.recipe import Method
from invgraphics.runs.folder import RunFolder, output_folder
from invgraphics.runs.inference import Inference, InstanceScores
from invgraphics.runs.provenance import Provenance
from invgraphics.scenes.layout import evenly
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.text import slug
from invgraphics.tools.inference_baselines import Observed, class_mean, nearest_instance, without_prior
from invgraphics.training.budget import Budget
from invgraphics.training.codes.inference import CodeInference, infer_codes

METRICS = ("psnr", "ssim", "normal_deg", "depth_abs_rel", "alpha_iou")
MEAN, NEAREST, NO_PRIOR = "class mean", "nearest training instance", "no prior"
INPUT, TRUTH = "input", "truth"

Models = Mapping[int, Model]
"""Instance -> its model."""


@dataclass(frozen=True)
class InferRequest:
    """What to infer.

    Attributes:
        run: folder of a fit to a class; its baselines are those of this run.
        out: folder to write.
        against: folders of other fits to the same class.
        views: numbers of observed views, one after another.
        tests: test views of each instance that are scored, evenly spaced.
        instances: how many unseen instances, the first ones; ``None`` for all.
        no_prior: budget of each fit without a prior (``600steps``); ``None`` for none. As the nearest instance, for the fewest
            views only: both take longer than all the rest.
        steps: of the inference.
        scene: another copy of the class.
    """

    run: Path
    out: Path
    against: tuple[Path, ...] = ()
    views: tuple[int, ...] = (1,)
    tests: int = 4
    instances: int | None = None
    no_prior: str | None = None
    steps: int = CodeInference.steps
    scene: str | None = None

    def __post_init__(self) -> None:
        if not self.views or min(self.views) < 1 or len(set(self.views)) < len(self.views):
            raise InputError("--views must be different numbers of at least 1.", "Example: --views 1,2,4,8.")
        if self.tests < 1 or self.steps < 1 or (self.instances is not None and self.instances < 1):
            raise InputError("--test-views, --steps and --instances must be at least 1.")

    def shell(self) -> str:
        """Shell command that repeats this inference."""
        words = [
            "invgraphics",
            "infer",
            str(self.run),
            "--views",
            ",".join(map(str, self.views)),
            "--test-views",
            str(self.tests),
        ]
        words += ["--against", ",".join(map(str, self.against))] if self.against else []
        words += ["--instances", str(self.instances)] if self.instances is not None else []
        words += ["--no-prior", self.no_prior] if self.no_prior else []
        return shlex.join([*words, "--steps", str(self.steps), "--out", str(self.out)])


def infer(request: InferRequest) -> Inference:
    """Infer, score and draw; writes and returns the record, beside which the pictures lie.

    Raises:
        InputError: a folder holds no run of a class, the runs show different classes, or views are missing.
    """
    if request.no_prior is not None:
        Budget.parse(request.no_prior)  # a mistake is found before anything is opened
    fitted = open_class_runs([request.run, *request.against], request.scene)
    scene = fitted[0].scene
    subjects = sorted({view.subject for view in scene.test if view.subject is not None})[: request.instances]
    scores: list[InstanceScores] = []
    seconds: dict[str, dict[str, float]] = {}
    shown: dict[str, tuple[str, ...]] = {}
    with output_folder(request.out), Reporter("infer") as reporter:
        for place, count in enumerate(request.views):
            observed = observed_views(scene, subjects, count)
            columns: dict[str, Models] = {}
            for how, make in _candidates(fitted, observed, request, count == min(request.views)):
                reporter.show(place / len(request.views), f"{how}, {count} observed views")
                began = time.perf_counter()
                columns[how] = make()
                seconds.setdefault(how, {})[str(count)] = time.perf_counter() - began
                scores += [
                    _score(scene, columns[how], subject, observed[subject], (how, request.tests)) for subject in subjects
                ]
            shown[str(count)] = (INPUT, TRUTH, *columns)
            for subject in subjects:
                path = request.out / "pictures" / str(count) / f"{subject:04d}.png"
                draw_instance(path, scene, {how: models[subject] for how, models in columns.items()}, observed[subject][0])
        record = Inference(
            scene=scene.name,
            runs={how: str(one.folder.root) for how, one in _names(fitted).items()},
            command=request.shell(),
            date=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
            pictures=request.views,
            columns=shown,
            seconds=seconds,
            instances=tuple(scores),
        )
        record.write(request.out / Inference.FILE)
        for how, one in _names(fitted).items():  # by which `report --check` knows the recipes
            copy = RunFolder(request.out / "runs" / slug(how))
            copy.create()
            copy.write(one.folder.read(Provenance))
    return record


def open_class_runs(folders: list[Path], scene_spec: str | None = None) -> list[Fitted]:
    """Open runs on one class, with all of its views.

    Raises:
        InputError: one is no run of a class, or shows another one.
    """
    provenance = RunFolder(folders[0]).read(Provenance)
    options = SceneOptions(provenance.options.size, None, spp=None if scene_spec else provenance.options.spp)
    scene = open_scene(scene_spec or provenance.scene, options)
    if not scene.is_class:
        raise InputError(
            f"{folders[0]} is a fit to '{scene.name}', which shows one subject.", "Give a fit to a class, such as chairs."
        )
    digest, fitted = scene.digest("train"), []
    for path in folders:
        folder = RunFolder(path)
        if folder.read(Provenance).train_sha256 != digest:
            raise InputError(f"{path} was fitted to other pictures than '{scene.name}'.", "Give runs on the same class.")
        fitted.append(load_fitted(folder, scene))
    return fitted


def observed_views(scene: Scene, subjects: list[int], count: int) -> dict[int, list[View]]:
    """The first ``count`` observed views of each instance.

    Raises:
        InputError: an instance has fewer.
    """
    observed = {subject: [view for view in scene.observed if view.subject == subject][:count] for subject in subjects}
    for subject, views in observed.items():
        if len(views) < count:
            raise InputError(f"Instance {subject} of '{scene.name}' has {len(views)} observed views, not {count}.")
    return observed


def with_prior(model: Model, scene: Scene, observed: Observed, config: CodeInference) -> dict[int, Model]:
    """Infer the codes of all instances; the rest of the model is shared."""
    assert isinstance(model.field, Conditional)
    codes = infer_codes(model, scene, list(observed.values()), config)
    return {subject: replace(model, field=model.field.at(code)) for subject, code in zip(observed, codes, strict=True)}


def _names(fitted: list[Fitted]) -> dict[str, Fitted]:
    """Runs by their methods' names; by their folders' too where those are equal."""
    names = [one.method.name for one in fitted]
    return {
        name if names.count(name) == 1 else f"{name} ({one.folder.root.name})": one
        for name, one in zip(names, fitted, strict=True)
    }


def _candidates(
    fitted: list[Fitted], observed: Observed, request: InferRequest, fewest: bool
) -> Iterator[tuple[str, Callable[[], Models]]]:
    """Name and maker of the instances' models, each way."""
    first = fitted[0]
    model, scene, method = first.model, first.scene, _without_penalties(first.method)
    config = CodeInference(steps=request.steps)
    for name, one in _names(fitted).items():
        yield name, lambda one=one: with_prior(one.model, scene, observed, config)
    yield MEAN, lambda: class_mean(model, observed)
    if fewest:
        yield NEAREST, lambda: nearest_instance(model, scene, observed)
    if fewest and request.no_prior is not None:
        budget = Budget.parse(request.no_prior)
        yield NO_PRIOR, lambda: without_prior(method, scene, observed, budget)


def _without_penalties(method: Method) -> Method:
    """The method for a class of one, whose code needs no prior."""
    return replace(method, recipe=replace(method.recipe, penalties=()))


def _score(scene: Scene, models: Models, subject: int, observed: list[View], how: tuple[str, int]) -> InstanceScores:
    """Scores of an instance on its test views, rounded to 8 bits as everywhere."""
    rules, model = protocol_named("default"), models[subject]
    views = evenly([view for view in scene.test if view.subject == subject], how[1])
    found = [score(model.render(view.camera), view, scene, rules, METRICS) for view in views]
    seen = [score(model.render(view.camera, normals=False), view, scene, rules, ("psnr",)) for view in observed]
    return InstanceScores(
        subject=subject,
        observed=len(observed),
        how=how[0],
        quality={metric: tuple(one.values.get(metric) for one in found) for metric in METRICS},
        input_psnr=sum(one.values["psnr"] for one in seen) / len(seen),
    )


def hidden_view(scene: Scene, observed: View) -> View:
    """The test view of an instance that looks from the side opposite to an observed view."""
    forward = observed.camera.cam_to_world[:3, 2]
    own = [view for view in scene.test if view.subject == observed.subject]
    return min(own, key=lambda view: float(forward @ view.camera.cam_to_world[:3, 2]))


def draw_instance(path: Path, scene: Scene, models: Mapping[str, Model], observed: View) -> None:
    """Draw the hidden side: input, truth, and each model's picture; below them normals, those of the input in its place."""
    from PIL import Image

    view = hidden_view(scene, observed)
    upper = [observed.over(scene.background), view.over(scene.background)]
    lower = [shown_normals(observed.normal, upper[0]), shown_normals(view.normal, upper[1])]
    for model in models.values():
        picture = model.render(view.camera)
        upper.append(picture.over(scene.background))
        lower.append(shown_normals(picture.normal, upper[-1]))
    rows = [torch.cat([display(one, scene) for one in upper], dim=1), torch.cat([_bytes(one) for one in lower], dim=1)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_picture(path, Image.fromarray(torch.cat(rows).numpy()))


def shown_normals(normal: torch.Tensor | None, like: torch.Tensor) -> torch.Tensor:
    """Normals as colours, (n + 1) / 2 over white; white where there are none."""
    if normal is None:
        return torch.ones_like(like)
    hit = normal.square().sum(dim=-1, keepdim=True) > 0
    return torch.where(hit, (normal + 1) / 2, 1.0)


def _bytes(colour: torch.Tensor) -> torch.Tensor:
    return (colour.clamp(0, 1) * 255).round().to(torch.uint8)
