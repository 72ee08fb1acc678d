"""A model that was trained elsewhere as a run like any other: scored by the same rules, shown in the same reports."""

from __future__ import annotations

import hashlib
import shlex
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from invgraphics.core import Gaussians, Scene, harmonics
from invgraphics.errors import InputError
from invgraphics.experiments.build import build_model, device_of, open_requested, repeatable, use_kernels
from invgraphics.experiments.environment import code_version
from invgraphics.experiments.evaluate import evaluate
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import describe
from invgraphics.fields.gaussian import GaussianField, GaussianFieldConfig
from invgraphics.fields.transformed import move_gaussians
from invgraphics.formats.base import Splats, read_gaussians
from invgraphics.formats.ply import OPACITY_EPS
from invgraphics.metrics.protocols import protocol_named
from invgraphics.recipes.recipe import Method, load_method
from invgraphics.runs import checkpoint
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.history import Moment
from invgraphics.runs.provenance import ImportedFile, Provenance
from invgraphics.text import sha256_of
from invgraphics.tools.file_frames import WORLD, local_from_file

IMPORTED = "imported"
"""What stands where a fit's budget and preset would."""


@dataclass(frozen=True, kw_only=True)
class ImportRequest(FitRequest):
    """A file to make a run of.

    Attributes:
        file: in a format of `invgraphics.formats`.
        frame: axes of the file, as `core.transforms.axes_to_opencv` reads them; ``None`` for what the file says, else for the
            world's own.
        world: how the axes of the data set's world point, for files that have certain axes.
    """

    file: str
    frame: str | None = None
    world: str = WORLD
    budget: str = IMPORTED
    preset: str | None = ""

    def shell(self) -> str:
        """The command that makes this run."""
        placed = ["--frame", self.frame] if self.frame else []
        placed += ["--world", self.world] if self.world != WORLD else []
        given = self.flags()
        where = given.index("--budget")
        del given[where : where + 2]
        words = ["invgraphics", "import", self.file, "--scene", self.scene, "--method", self.method]
        return shlex.join([*words, *placed, *given])


def import_run(request: ImportRequest) -> Path:
    """Make the run that ``request`` describes, evaluation included; returns its folder.

    Raises:
        InputError: anything about the request, the file or the scene that cannot be used; nothing has been written then.
    """
    protocol_named(request.protocol)
    device = device_of(request.device)
    name, splats = read_gaussians(Path(request.file))
    splats = replace(splats, gaussians=without_zero_bands(splats.gaussians))
    method = method_for(request, splats.gaussians)
    axes = request.frame or splats.axes
    folder = RunFolder(Path(request.out))
    if folder.has(Provenance):
        raise InputError(f"{folder.root} already holds a run.", "Choose another --out.")
    scene = open_requested(request)
    gaussians = move_gaussians(splats.gaussians, local_from_file(scene, axes, request.world).float())
    folder.create()
    repeatable(device)
    use_kernels(request.kernels)
    origin = _origin(request, name, splats, axes)
    if splats.antialiased and not getattr(method.recipe.renderer, "compensate", False):
        print(
            "The file says that it was fitted with anti-aliasing; --set renderer.compensate=true shows it so.", file=sys.stderr
        )
    with folder.held():
        folder.clear()
        identity = _identity(method, scene, origin)
        folder.write(describe(folder, request, method, (scene, scene), identity, device, origin))
        field, renderer = build_model(method, scene, request.seed, device)
        assert isinstance(field, GaussianField)
        fill(field, gaussians)
        checkpoint.save(folder.checkpoint, {"field": field.state_dict(), "renderer": renderer.state_dict()})
        folder.append_history(Moment(step=0, seconds=0.0, progress=1.0, primitives=len(gaussians)))
        costs: dict[str, float | None] = {"fit_seconds": None, "steps": None, "peak_memory_bytes": None}
        folder.write(FitRecord())
        for rules in dict.fromkeys([request.protocol, "default"]):
            evaluate(folder, scene, (field, renderer), rules, costs, method)
    return folder.root


def without_zero_bands(gaussians: Gaussians) -> Gaussians:
    """The Gaussians without upper bands of spherical harmonics that are zero throughout, with which files are padded."""
    sh = gaussians.sh
    while (degree := harmonics.degree_of(sh.shape[1])) and not bool(sh[:, harmonics.count(degree - 1) :].any()):
        sh = sh[:, : harmonics.count(degree - 1)]
    return replace(gaussians, sh=sh.contiguous())


def method_for(request: ImportRequest, gaussians: Gaussians) -> Method:
    """The method whose renderer shows the Gaussians, its field made for their SH degree.

    Raises:
        InputError: the method is unknown, or is none of Gaussians.
    """
    method = load_method(request.method, request.preset, request.recipe_overrides)
    if not isinstance(method.recipe.field, GaussianFieldConfig):
        raise InputError(
            f"{request.method} fits no Gaussians, which '{request.file}' holds.", "Use --method splatting/gaussians."
        )
    own = (f"field.sh_degree={harmonics.degree_of(gaussians.sh.shape[1])}", "field.isotropic=false")
    return replace(load_method(request.method, request.preset, (*request.recipe_overrides, *own)), preset=IMPORTED)


def fill(field: GaussianField, gaussians: Gaussians) -> None:
    """Make a field hold these Gaussians, local frame."""
    tensors = {
        "means": gaussians.means,
        "quaternions": gaussians.quaternions,
        "log_scales": gaussians.scales.clamp_min(1e-38).log(),
        "opacity_logits": gaussians.opacities.logit(OPACITY_EPS),
        "sh_dc": gaussians.sh[:, :1],
        "sh_rest": gaussians.sh[:, 1:],
    }
    field.replace({name: tensor.to(field.means).contiguous() for name, tensor in tensors.items()})
    field.active_degree = field.sh_degree


def _origin(request: ImportRequest, name: str, splats: Splats, axes: str | None) -> ImportedFile:
    path = Path(request.file)
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
        notes=splats.notes,
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
