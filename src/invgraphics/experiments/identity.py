"""When two runs are the same run: SHA-256 of everything that decides a result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from invgraphics.core import Scene
from invgraphics.experiments.environment import code_version
from invgraphics.experiments.job import Job
from invgraphics.runs.folder import RunFolder
from invgraphics.text import sha256_of


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


def identify(job: Job, truth: TruthDigest, threads: int) -> str:
    """The identity of a run: equal for equal bits, on one machine.

    Args:
        job: of the run; its degradations of training data follow from the truth as loaded, the settings and the seed, so that
            nothing needs to be disturbed to know them.
        truth: of the scene as loaded.
        threads: of the process that fits, which decide the order of sums.
    """
    method = job.method
    source = getattr(method.recipe.field, "source", "")
    started_from = {"source": RunFolder(Path(source)).identity} if source else {}
    return sha256_of(
        started_from
        | {
            "method": method.name,
            "recipe": method.digest,
            "truth": truth.pixels,
            "cameras": truth.cameras,
            "data": job.data.changes(),
            "request": _asked(job),
            "code": code_version(),
            "threads": threads,
        }
    )


def define(job: Job) -> str:
    """The identity of a cell of a study: what it is asked for, whatever machine and code answer."""
    request = job.request
    scene = {key: getattr(request, key) for key in ("scene", "size", "test_views")}
    scene |= {} if request.spp is None else {"spp": request.spp}  # so that studies without keep their folders' names
    parts = {"method": job.method.name, "recipe": job.method.digest, "data": job.data.changes()}
    return sha256_of(_asked(job) | scene | parts)


def _asked(job: Job) -> dict[str, Any]:
    """Settings that decide a result; a budget counts, not its spelling."""
    settings = {key: getattr(job.request, key) for key in ("seed", "device", "kernels", "protocol")}
    return settings | {"budget": str(job.budget)}
