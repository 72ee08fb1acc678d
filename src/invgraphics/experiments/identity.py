"""When two runs are the same run: SHA-256 of everything that decides a result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from invgraphics.core import Scene
from invgraphics.experiments.build import training_data
from invgraphics.experiments.environment import code_version
from invgraphics.experiments.request import FitRequest
from invgraphics.recipes.recipe import Method
from invgraphics.runs.folder import RunFolder
from invgraphics.text import sha256_of
from invgraphics.training.budget import Budget


@dataclass(frozen=True)
class TruthDigest:
    """Fingerprints of a scene as it was loaded, which stand for its pixels where only they are needed.

    Attributes:
        pixels: of the training, validation and test views.
        cameras: of all cameras.
    """

    pixels: tuple[str, str, str]
    cameras: str

    @staticmethod
    def of(scene: Scene) -> TruthDigest:
        """The fingerprints of ``scene``."""
        return TruthDigest((scene.digest("train"), scene.digest("val"), scene.digest("test")), scene.camera_digest())


def identify(request: FitRequest, method: Method, truth: TruthDigest, threads: int) -> str:
    """The identity of a run: equal for equal bits, on one machine.

    Args:
        request: what is asked for; its disturbances of training data follow from the undisturbed truth, the settings and the
            seed, so that nothing needs to be disturbed to know them.
        method: its resolved recipe.
        truth: of the undisturbed scene.
        threads: of the process that fits, which decide the order of sums.
    """
    source = getattr(method.recipe.field, "source", "")
    started_from = {"source": RunFolder(Path(source)).identity} if source else {}
    return sha256_of(
        started_from
        | {
            "method": method.name,
            "recipe": method.digest,
            "truth": truth.pixels,
            "cameras": truth.cameras,
            "data": training_data(request).changes(),
            "request": _asked(request),
            "code": code_version(),
            "threads": threads,
        }
    )


def define(request: FitRequest, method: Method) -> str:
    """The identity of a cell of a study: what it is asked for, whatever machine and code answer."""
    scene = {key: getattr(request, key) for key in ("scene", "size", "test_views")}
    scene |= {} if request.spp is None else {"spp": request.spp}  # so that studies without keep their folders' names
    parts = {"method": method.name, "recipe": method.digest, "data": training_data(request).changes()}
    return sha256_of(_asked(request) | scene | parts)


def _asked(request: FitRequest) -> dict[str, Any]:
    """Settings that decide a result; a budget counts, not its spelling."""
    settings = {key: getattr(request, key) for key in ("seed", "device", "kernels", "protocol")}
    return settings | {"budget": str(Budget.parse(request.budget))}
