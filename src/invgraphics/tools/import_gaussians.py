"""Import of a Gaussian model trained elsewhere as a run, scored and reported like every other run."""

from __future__ import annotations

import hashlib
import re
import shlex
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from invgraphics.core import Gaussians, Scene, harmonics
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model, configure_torch, open_with_progress, use_kernels
from invgraphics.experiments.environment import code_version
from invgraphics.experiments.evaluate import evaluate
from invgraphics.experiments.identity import check_unused
from invgraphics.experiments.job import Job
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import write_description
from invgraphics.fields.gaussian import GaussianField, GaussianFieldConfig
from invgraphics.fields.similarity import transform_gaussians, with_shortest_third
from invgraphics.formats.base import DILATION, SMALLEST_SCALE, Splats, read_gaussians
from invgraphics.formats.ply import FILTERED, OPACITY_EPS
from invgraphics.recipes.recipe import Method, resolve
from invgraphics.renderers.splatting import Splatting
from invgraphics.runs import checkpoint
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.history import Moment
from invgraphics.runs.provenance import ImportedFile
from invgraphics.text import sha256_of
from invgraphics.tools.file_frames import WORLD, file_from_world, local_from_file

IMPORTED = "imported"
"""What stands where a fit's budget and preset would."""
TURNING = ("Nerfstudio", "Nerstudio")
"""Tools, as comments in their files name them, that turn, centre and scale the data set's world."""
LEAST_SEEN, MOST_CAMERAS = 0.5, 32
"""Share of the Gaussians in one of so many training pictures below which they are probably in another frame."""


@dataclass(frozen=True, kw_only=True)
class ImportRequest:
    """A file to make a run of.

    Attributes:
        file: in a format of `invgraphics.formats`.
        run: the run to make: its scene, method, folder and protocol; nothing is fitted, so that its budget does not count.
        frame: axes of the file, as `core.transforms.axes_to_opencv` reads them; ``None`` for what the file says, else for the
            world's own.
        world: how the axes of the data set's world point, for files that have certain axes.
        transform: JSON of the similarity from the data set's world to the file's frame, as nerfstudio writes it
            (``dataparser_transforms.json``); ``None`` where they are the same.
    """

    file: str
    run: FitRequest
    frame: str | None = None
    world: str = WORLD
    transform: str | None = None

    def __post_init__(self) -> None:
        if self.frame is not None and self.transform is not None:
            raise InputError("--frame and --transform both say where the file's axes point.", "Give one of them.")

    def shell(self) -> str:
        """Shell command that reproduces this import."""
        placed = ["--frame", self.frame] if self.frame else []
        placed += ["--world", self.world] if self.world != WORLD else []
        placed += ["--transform", self.transform] if self.transform else []
        given = self.run.flags()
        where = given.index("--budget")
        del given[where : where + 2]
        words = ["invgraphics", "import", self.file, "--scene", self.run.scene, "--method", self.run.method]
        return shlex.join([*words, *placed, *given])


def import_run(request: ImportRequest) -> Path:
    """Import a Gaussian file as a run and evaluate it; returns the run's folder.

    Raises:
        InputError: anything about the request, the file or the scene that cannot be used; nothing has been written then.
    """
    job = Job.of(replace(request.run, preset=""))
    name, splats = read_gaussians(Path(request.file))
    splats = replace(splats, gaussians=without_zero_bands(splats.gaussians))
    job = replace(job, method=method_for(job.method, request.file, splats.gaussians))
    axes = request.frame or splats.axes
    folder = job.folder
    check_unused(folder)  # before the work, and again under the lock
    scene = open_with_progress(job.request.scene, job.options)
    place = local_from_file(scene, axes, request.world)
    if request.transform is not None:
        place = place @ torch.linalg.inv(file_from_world(Path(request.transform), job.request.scene))
    gaussians = transform_gaussians(splats.gaussians, place.float())
    _warn_of_frame(gaussians, scene, splats, request)
    folder.create()
    configure_torch(job.device)
    use_kernels(job.request.kernels, job.device)
    origin = _origin(request, name, splats, axes)
    _advise_filter(splats, job.method.recipe.renderer)
    with folder.held():
        check_unused(folder)
        folder.clear()
        provenance = write_description(job, scene, scene, _identity(job.method, scene, origin))
        folder.write(replace(provenance, budget=IMPORTED, command=request.shell(), imported=origin))
        model = build_model(job.method, scene, job.request.seed, job.device)
        assert isinstance(model.field, GaussianField)
        flat = isinstance(model.renderer, Splatting) and model.renderer.config.flat
        fill(model.field, with_shortest_third(gaussians) if flat else gaussians)
        checkpoint.save(folder.checkpoint, model.state_dict())
        folder.append_history(Moment(step=0, seconds=0.0, progress=1.0, primitives=len(gaussians)))
        costs: dict[str, float | None] = {"fit_seconds": None, "steps": None, "peak_memory_bytes": None}
        folder.write(FitRecord())
        for protocol in job.protocols:
            evaluate(folder, scene, model, protocol, costs, job.method)
    return folder.root


def _warn_of_frame(gaussians: Gaussians, scene: Scene, splats: Splats, request: ImportRequest) -> None:
    """Warn where the Gaussians are not where the cameras look, or come from a tool that turns and scales the world."""
    seen = torch.zeros(len(gaussians), dtype=torch.bool)
    for view in scene.train[:: max(1, len(scene.train) // MOST_CAMERAS)]:
        seen |= view.camera.pixel_of(gaussians.means)[0]
    share = float(seen.float().mean())
    maker = next((name for name in TURNING if any(name.lower() in note.lower() for note in splats.notes)), "")
    if share < LEAST_SEEN or (maker and request.transform is None):
        why = f"{maker} writes files in a frame of its own" if maker else "it may be in a frame of its own"
        what = f"Warning: {share:.0%} of the Gaussians lie in a training picture; {why}."
        print(f"{what} --transform dataparser_transforms.json, or --frame, places it.", file=sys.stderr)


def _advise_filter(splats: Splats, renderer: object) -> None:
    """Name the renderer's settings with which the file was fitted, by its flag and its notes, where the renderer has others."""
    said = re.search(re.escape(DILATION) + r"(\d+(?:\.\d+)?(?:e-?\d+)?)", " ".join(splats.notes))
    dilation = said[1] if said else "0.1" if FILTERED in splats.notes else None
    settings = []
    if splats.antialiased and not getattr(renderer, "antialiased", False):
        settings.append("--set renderer.antialiased=true")
    if dilation is not None and getattr(renderer, "dilation", None) not in (None, float(dilation)):
        settings.append(f"--set renderer.dilation={dilation}")
    if settings:
        how = "with anti-aliasing" if splats.antialiased else "with another 2D filter"
        print(f"The file says that it was fitted {how}; {' '.join(settings)} shows it so.", file=sys.stderr)


def without_zero_bands(gaussians: Gaussians) -> Gaussians:
    """Truncate upper spherical-harmonics bands that are zero for all Gaussians, with which files are padded."""
    sh = gaussians.sh
    while (degree := harmonics.degree_of(sh.shape[1])) and not bool(sh[:, harmonics.count(degree - 1) :].any()):
        sh = sh[:, : harmonics.count(degree - 1)]
    return replace(gaussians, sh=sh.contiguous())


def method_for(method: Method, file: str, gaussians: Gaussians) -> Method:
    """Resolve the method that renders a file's Gaussians, with its field's SH degree set to theirs.

    Raises:
        InputError: the method is none of Gaussians.
    """
    if not isinstance(method.recipe.field, GaussianFieldConfig):
        raise InputError(f"{method.name} fits no Gaussians, which '{file}' holds.", "Use --method splatting/gaussians.")
    degree = harmonics.degree_of(gaussians.sh.shape[1])
    shape = {"sh_degree": degree, "isotropic": False}
    return resolve(method.name, IMPORTED, method.table | {"field": method.table["field"] | shape})


def fill(field: GaussianField, gaussians: Gaussians) -> None:
    """Replace a field's Gaussians by the given ones, local frame."""
    tensors = {
        "means": gaussians.means,
        "quaternions": gaussians.quaternions,
        "log_scales": gaussians.scales.clamp_min(SMALLEST_SCALE).log(),
        "opacity_logits": gaussians.opacities.logit(OPACITY_EPS),
        "sh_dc": gaussians.sh[:, :1],
        "sh_rest": gaussians.sh[:, 1:],
    }
    field.replace({name: tensor.to(field.means).contiguous() for name, tensor in tensors.items()})
    field.active_degree = field.sh_degree


def _origin(request: ImportRequest, name: str, splats: Splats, axes: str | None) -> ImportedFile:
    path = Path(request.file)
    placed = () if request.transform is None else (f"Placed by the similarity {Path(request.transform).read_text().strip()}.",)
    return ImportedFile(
        file=request.file,
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        bytes=path.stat().st_size,
        format=name,
        axes=axes or "those of the data set's world",
        world=request.world,
        gaussians=len(splats.gaussians),
        sh_degree=harmonics.degree_of(splats.gaussians.sh.shape[1]),
        antialiased=splats.antialiased,
        notes=(*splats.notes, *placed),
    )


def _identity(method: Method, scene: Scene, origin: ImportedFile) -> str:
    parts = [
        method.name,
        method.digest,
        scene.digest("test"),
        scene.camera_digest(),
        {"imported": asdict(origin)},
        code_version(),
    ]
    return sha256_of(parts)
