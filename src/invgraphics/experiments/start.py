"""What comes before a fit: initialisation from a run or a checkpoint, checks of folder and losses, forecast of peak memory."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from invgraphics import locks
from invgraphics.core import Field, RayRenderer, Scene
from invgraphics.errors import InputError
from invgraphics.experiments.clocks import at_step
from invgraphics.experiments.fitted import load_fitted
from invgraphics.experiments.job import Job
from invgraphics.experiments.memory_check import COPIES, RAY_BYTES, TRAINED_COPIES, upsampled_bytes
from invgraphics.experiments.progress import warn
from invgraphics.fields.mesh import MeshFieldConfig
from invgraphics.formats.mesh import mesh_from_file
from invgraphics.memory import total_bytes
from invgraphics.metrics.cost import model_bytes
from invgraphics.recipes.recipe import Method
from invgraphics.runs import checkpoint
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import RunFolder, check_run
from invgraphics.runs.provenance import Provenance
from invgraphics.runs.scores import Scores
from invgraphics.training.batches import Batches, size_of
from invgraphics.training.fit import Fit, Plan

SCREEN_BYTES = 300
"""Of a primitive on the screen: footprint, its gradients, packed row and sums; rounded up from two threads."""
PICTURE_BYTES = 300
"""Of a pixel of a training picture: rendering, truth, SSIM's moments, and their gradients."""
CHECKPOINT_COPIES = 3
"""A checkpoint holds each parameter and Adam's two moments."""
MARGIN = 1.25
"""Memory that is freed and allocated again in other sizes leaves gaps."""
GROWTH_MARGIN = 1.5
"""As `MARGIN`, of primitives that are still to be made, whose arrays are allocated once in each size. Grown by MCMC from 5,000
to 150,000, Gaussians took 400 MB; as many from the first step on took 230."""
BASE_BYTES = 95 * 10**6
"""Of work arrays of threads and libraries, whatever the method, and of gaps that freed arrays leave: NeRF's third monitor pass
takes 45 MB more than its first. With 65 MB, NeRF on room at 128 px exceeded the forecast by 5 MB on one thread, 17 on two."""


def check_source(method: Method, scene_spec: str) -> None:
    """Check that the run or the file that a recipe's ``field.source`` names is there, and shows the scene.

    Raises:
        InputError: it is not, or does not.
    """
    config = method.recipe.field
    source = getattr(config, "source", "")
    if not source or (isinstance(config, MeshFieldConfig) and Path(source).is_file()):
        return
    check_run(Path(source))
    shown = RunFolder(Path(source)).read(Provenance).scene
    if Path(shown).resolve() != Path(scene_spec).resolve():
        raise InputError(f"field.source: {source} is a run on '{shown}', not on '{scene_spec}'.")


def resume(fit: Fit, job: Job) -> FitRecord:
    """Load the folder's checkpoint into the fit, with the clocks at that moment; returns the record of the time before.

    Checkpoint and clocks are two files: of a fit that was killed between them, the clocks are those of the checkpoint before.

    Raises:
        InputError: the checkpoint, of earlier code, does not fit today's model.
    """
    state, known = checkpoint.load(job.folder.checkpoint, job.device), job.folder.read(FitRecord)
    earlier = at_step(known, int(state["fit"]["steps"]))
    if earlier is not known:
        lost = f"steps {known.steps} to {earlier.steps} of {job.folder.root}, which was killed as it wrote a checkpoint"
        warn(f"Warning: the times of {lost}, are not known; they count at the mean rate of the steps before.")
    try:
        fit.load(state, earlier.seconds or 0.0)
    except (RuntimeError, KeyError, ValueError) as error:
        if not job.request.keep:
            raise
        cause = " ".join(str(error).split())
        raise InputError(f"The checkpoint in {job.folder.root} does not fit the code of today: {cause}.") from error
    fit.resume_clocks(asdict(earlier))
    for stale in job.folder.root.glob(Scores.FILES):  # of this checkpoint, under whatever protocol
        stale.unlink(missing_ok=True)
    return earlier


def remove_empty(folder: Path) -> None:
    """Remove a folder where it holds nothing but its lock, unless another process holds that: it is about to write there."""
    with suppress(OSError, InputError), locks.locked(folder, folder / locks.INSIDE):
        if all(path.name == locks.INSIDE for path in folder.iterdir()):
            (folder / locks.INSIDE).unlink()
            folder.rmdir()


def check_losses(fit: Fit, method: Method) -> None:
    """Warn of losses that the first step gave nothing to act on.

    Raises:
        InputError: all losses are such.
    """
    names = [method.table["losses"][index]["type"] for index in fit.idle_losses]
    if names and len(names) == len(fit.plan.losses) and fit.progress < 1:
        words = f"{method.name} has nothing to fit by: its renderer gives {', '.join(names)} nothing to act on."
        raise InputError(words, "A loss of every renderer is --set 'losses=[{type=\"photometric\"}]'.")
    for name in names:
        warn(f"Warning: the loss '{name}' is 0 throughout: this renderer gives it nothing to act on.")


def initialise_field(plan: Plan, method: Method, scene_spec: str, scene: Scene) -> Plan:
    """Initialise the plan's field by conversion from the run that the recipe's ``field.source`` names, if any.

    Args:
        plan: of the fit.
        method: its recipe.
        scene_spec: name of its scene.
        scene: as loaded, with the photographs that the run may have had.

    Raises:
        InputError: there is no such run, it shows another scene, or its field cannot be converted.
    """
    config = method.recipe.field
    source = getattr(config, "source", "")
    check_source(method, scene_spec)
    if not source:
        return plan
    if isinstance(config, MeshFieldConfig) and Path(source).is_file():
        return _with_field(plan, config.from_mesh(mesh_from_file(Path(source), plan.scene), plan.scene))
    fitted = load_fitted(RunFolder(Path(source)), scene)
    if fitted.poses is not None:
        sentence = f"'{source}' has refined its cameras' poses: its field does not lie where this scene's cameras look."
        raise InputError(sentence, "Start from a run that was fitted without --optimise poses.")
    source_field = fitted.model.field
    torch.manual_seed(plan.seed)  # loading the source has drawn its own initial values
    return _with_field(plan, config.converted(source_field, plan.scene))


def _with_field(plan: Plan, field: Field) -> Plan:
    plan.model.renderer.prepare(field)
    return replace(plan, model=replace(plan.model, field=field.to(plan.device)))


@dataclass(frozen=True)
class MemoryForecast:
    """Forecast peak memory of a fit, above what its process held before.

    Attributes:
        bytes: on the device that computes.
        primitives: most that the fit may make; 0 for fields without primitives.
    """

    bytes: int
    primitives: int

    def __str__(self) -> str:
        most = f"up to {self.primitives:,} primitives in " if self.primitives else ""
        return f" with {most}about {self.bytes / 1e6:.0f} MB"


def memory_forecast(plan: Plan, method: Method, held: int) -> MemoryForecast:
    """Forecast peak memory: what a step and a monitor pass needed, plus what is still to be allocated.

    To come are primitives with their gradients, moments and footprints, up-sampled lattices, pictures at full size where the
    fit begins with smaller ones, more rays where empty space leaves fewer samples on each, and a checkpoint's copy of the
    parameters and their moments.
    Empty space is not known yet, so that rays are as full of samples as they will ever be.

    Args:
        plan: of the fit.
        method: its recipe.
        held: bytes, of parameters, gradients, moments, samples and pictures.

    Raises:
        InputError: the primitives need more than this machine, or the container around the process, has.
    """
    field = plan.model.field
    now = field.primitive_count() or 0
    most = max(now, *(int(getattr(hook, "max_primitives", 0)) for hook in method.recipe.hooks), 0) if now else 0
    row = _row_bytes(field, now) if now else 0
    needed = most * (COPIES * row + SCREEN_BYTES)
    has = _machine_bytes(next(field.parameters()).device) if now else needed
    if needed > has:
        sentence = f"{most:,} primitives need about {needed / 1e9:.1f} GB of memory, and this machine has {has / 1e9:.1f} GB."
        raise InputError(sentence, "Choose a lower --max-primitives.")
    growth = (most - now) * (COPIES * row + SCREEN_BYTES)
    finest, links = upsampled_bytes(method, plan.scene)
    lattices = max(0, finest - model_bytes([field])) * (TRAINED_COPIES + CHECKPOINT_COPIES) + 2 * links
    parameters = model_bytes(plan.modules.values()) + (most - now) * row
    on_rays = isinstance(plan.model.renderer, RayRenderer)
    sizes = [size_of(view) for view in plan.scene.train]
    starts_small = any(plan.batches.scale_at(0.0, max(size)) < 1 for size in sizes)
    pictures = max(width * height for width, height in sizes) * PICTURE_BYTES if starts_small and not on_rays else 0
    rays = Batches.MAX_RAYS * RAY_BYTES if on_rays and plan.batches.samples else 0
    total = MARGIN * held + GROWTH_MARGIN * growth + lattices + pictures + rays + CHECKPOINT_COPIES * parameters + BASE_BYTES
    return MemoryForecast(round(total), most)


def _row_bytes(field: Field, primitives: int) -> int:
    """Bytes of one primitive: of the tensors with a row for each, not of networks that all of them share."""
    tensors = [*field.parameters(), *field.buffers()]
    return sum(one[0].numel() * one.element_size() for one in tensors if one.dim() and len(one) == primitives)


def _machine_bytes(device: torch.device) -> int:
    if device.type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory
    return total_bytes()
