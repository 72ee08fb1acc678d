"""Inference of unseen instances of a class of objects from few views, scored beside baselines."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from invgraphics.core import Conditional, Model, Scene, View
from invgraphics.errors import InputError
from invgraphics.experiments.environment import code_version
from invgraphics.experiments.fitted import Fitted
from invgraphics.experiments.progress import Reporter
from invgraphics.metrics.cost import parameter_count
from invgraphics.metrics.protocols import protocol_named, score
from invgraphics.runs.collection import runs_of
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import RunFolder, output_folder
from invgraphics.runs.inference import Inference, InstanceScores, PriorFit
from invgraphics.runs.provenance import Provenance
from invgraphics.scenes.layout import evenly
from invgraphics.text import sha256_of, slug
from invgraphics.tools.class_runs import observed_views, open_class_runs, run_names
from invgraphics.tools.inference_baselines import NearestInstance, class_mean, without_prior
from invgraphics.tools.inference_pictures import ROWS, TRUTH, draw_instance
from invgraphics.training.budget import Budget
from invgraphics.training.codes.inference import CodeInference, infer_codes

METRICS = ("psnr", "ssim", "normal_deg", "depth_abs_rel", "alpha_iou")
MEAN, NEAREST, NO_PRIOR = "class mean", "nearest training instance", "no prior"


@dataclass(frozen=True)
class InferRequest:
    """What to infer.

    Attributes:
        run: folder of a fit to a class, or of a comparison or study of such fits; the baselines are those of the first fit.
        out: folder to write.
        against: folders of other fits to the same class, likewise.
        views: numbers of observed views, one after another.
        tests: test views of each instance that are scored, evenly spaced.
        instances: how many unseen instances, the first ones; ``None`` for all.
        no_prior: budget of each fit without a prior (``600steps``); ``None`` for none.
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

    def folders(self) -> list[Path]:
        """Folders of all runs, each once.

        Raises:
            InputError: there is a folder without one.
        """
        return list(dict.fromkeys(run for path in (self.run, *self.against) for run in runs_of(path)))

    def shell(self) -> str:
        """Shell command that repeats this inference."""
        words = ["invgraphics", "infer", str(self.run), "--views", ",".join(map(str, self.views))]
        words += ["--test-views", str(self.tests)]
        words += ["--against", ",".join(map(str, self.against))] if self.against else []
        words += ["--instances", str(self.instances)] if self.instances is not None else []
        words += ["--no-prior", self.no_prior] if self.no_prior else []
        words += ["--scene", self.scene] if self.scene else []
        return shlex.join([*words, "--steps", str(self.steps), "--out", str(self.out)])


def infer(request: InferRequest) -> Inference:
    """Infer, score and draw; writes and returns the record, beside which the pictures lie.

    The record is written after each instance. Where the folder holds one of the same runs and settings, its instances are kept.

    Raises:
        InputError: a folder holds no run of a class, the runs show different classes, views are missing, or the folder holds
            another inference.
    """
    if request.no_prior is not None:
        Budget.parse(request.no_prior)  # a mistake is found before anything is opened
    fitted = open_class_runs(request.folders(), request.scene)
    names = dict(zip(run_names(fitted), fitted, strict=True))
    scene = fitted[0].scene
    subjects = sorted({view.subject for view in scene.test if view.subject is not None})[: request.instances]
    observed = observed_views(scene, subjects, max(request.views))
    with output_folder(request.out), Reporter("infer") as reporter:
        record = _begin(request, names)
        for name, one in names.items():  # by which `report --check` knows the recipes
            copy = RunFolder(request.out / "runs" / slug(name).replace(", ", "-"))
            copy.create()
            copy.write(one.folder.read(Provenance))
        methods = _InferenceMethods(names, request)
        todo = [(subject, count) for subject in subjects for count in request.views]
        for place, (subject, count) in enumerate(todo):
            if record.holds(subject, count) and _picture(request.out, subject, count).is_file():
                continue
            reporter.show(place / len(todo), f"instance {subject} from {count} view{'' if count == 1 else 's'}")
            record = _with_instance(record, methods, observed[subject][:count], request.out)
            record.write(request.out / Inference.FILE)
    return record


def _begin(request: InferRequest, names: Mapping[str, Fitted]) -> Inference:
    """The record to go on from: that in the folder, or an empty one.

    Raises:
        InputError: the folder's is of other runs, settings or code.
    """
    runs = {name: one.folder.read(Provenance).cell_sha256 for name, one in names.items()}
    settings = {"tests": request.tests, "no_prior": request.no_prior, "steps": request.steps}
    scene = next(iter(names.values())).scene
    identity = sha256_of(settings | {"runs": runs, "truth": scene.digest("test"), "code": code_version()})
    found, path = None, request.out / Inference.FILE
    if path.is_file():
        found = Inference.read(path)
        if found.identity != identity:
            sentence = f"{request.out} holds another inference, made from other runs, with other settings or by other code."
            raise InputError(sentence, "Choose another --out, or delete that folder.")
        known = len({one.subject for one in found.instances})
        views = tuple(sorted({*request.views, *found.pictures}))
        instances = None if request.instances is None else max(request.instances, known)
        request = replace(request, views=views, instances=instances)
    return Inference(
        scene=scene.name,
        runs={name: str(one.folder.root) for name, one in names.items()},
        fits={name: _fit(one) for name, one in names.items()},
        identity=identity,
        command=request.shell(),
        date=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        pictures=() if found is None else found.pictures,
        columns={} if found is None else found.columns,
        rows=ROWS,
        instances=() if found is None else found.instances,
    )


def _fit(one: Fitted) -> PriorFit:
    clock = one.folder.read(FitRecord) if one.folder.has(FitRecord) else FitRecord()
    budget = one.folder.read(Provenance).budget
    return PriorFit(
        parameters=parameter_count(one.model.parts.values()), budget=budget, steps=clock.steps, seconds=clock.seconds
    )


def _picture(out: Path, subject: int, count: int) -> Path:
    return out / "pictures" / str(count) / f"{subject:04d}.png"


class _InferenceMethods:
    """Methods that infer an instance from views of it: each run's prior, and the baselines of the first run."""

    def __init__(self, names: Mapping[str, Fitted], request: InferRequest) -> None:
        self._names, self._request = names, request
        self._first = next(iter(names.values()))
        self.scene = self._first.scene
        self._nearest = NearestInstance(self._first.model, self.scene)

    def of(self, views: Sequence[View]) -> Iterator[tuple[str, Callable[[], Model]]]:
        """Name of each method, and the function that makes its model of the instance."""
        config = CodeInference(steps=self._request.steps)
        for name, one in self._names.items():
            yield name, lambda one=one: with_prior(one.model, self.scene, views, config)
        yield MEAN, lambda: class_mean(self._first.model)
        yield NEAREST, lambda: self._nearest.find(views)
        if self._request.no_prior is not None:
            budget = Budget.parse(self._request.no_prior)
            yield NO_PRIOR, lambda: without_prior(self._first.method, self.scene, views, budget, self._first.model.device)

    def score(self, model: Model, views: Sequence[View], method: str, seconds: float) -> InstanceScores:
        """Scores of an instance on its test views, rounded to 8 bits as everywhere."""
        rules, scene, subject = protocol_named("default"), self.scene, views[0].subject
        assert subject is not None
        tests = evenly([view for view in scene.test if view.subject == subject], self._request.tests)
        found = [score(model.render(view.camera), view, scene, rules, METRICS) for view in tests]
        seen = [score(model.render(view.camera, normals=False), view, scene, rules, ("psnr",)) for view in views]
        known = [one.values["psnr"] for one in seen if "psnr" in one.values]  # not of pictures that are not finite
        return InstanceScores(
            subject=subject,
            observed=len(views),
            how=method,
            quality={metric: tuple(one.values.get(metric) for one in found) for metric in METRICS},
            input_psnr=sum(known) / len(known) if len(known) == len(views) else None,
            seconds=seconds,
        )


def with_prior(model: Model, scene: Scene, views: Sequence[View], config: CodeInference) -> Model:
    """Infer the code of an instance from views of it; the rest of the model is shared."""
    assert isinstance(model.field, Conditional)
    return replace(model, field=model.field.at(infer_codes(model, scene, [views], config)[0]))


def _with_instance(record: Inference, methods: _InferenceMethods, views: Sequence[View], out: Path) -> Inference:
    """Infer an instance by each method, draw it, and add it to the record."""
    models: dict[str, Model] = {}
    scores = []
    for method, make in methods.of(views):
        began = time.perf_counter()
        models[method] = make()
        seconds = time.perf_counter() - began
        scores.append(methods.score(models[method], views, method, seconds))
    subject, count = scores[0].subject, len(views)
    draw_instance(_picture(out, subject, count), methods.scene, models, views[0])
    kept = (one for one in record.instances if (one.subject, one.observed) != (subject, count))
    return replace(
        record,
        pictures=tuple(sorted({*record.pictures, count})),
        columns=record.columns | {str(count): (TRUTH, *models)},
        instances=(*kept, *scores),
    )
