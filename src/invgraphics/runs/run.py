"""Reading of a whole run: scores, provenance, environment and history."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from invgraphics.errors import InputError
from invgraphics.runs.environment import Environment
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.history import Moment, read_history
from invgraphics.runs.inside import inside
from invgraphics.runs.provenance import Provenance
from invgraphics.runs.scores import DEFAULT, Scores


@dataclass(frozen=True)
class Run:
    """A finished run, read from its folder.

    Attributes:
        folder: where it lies.
        method: ``renderer/recipe``; a report may extend it to tell variants apart.
        seed: of the fit.
        scores: under one protocol.
        provenance: the request, and hashes.
        environment: machine and versions.
        history: how the fit went, oldest first.
    """

    folder: Path
    method: str
    seed: int
    scores: Scores
    provenance: Provenance
    environment: Environment
    history: tuple[Moment, ...]

    @property
    def truth(self) -> Path:
        """Folder of the true test pictures."""
        return self.files.truth(self.provenance)

    @property
    def files(self) -> RunFolder:
        """The run's `RunFolder`, for paths of its files."""
        return RunFolder(self.folder)


def truth_picture(truth: Path, index: int) -> Path:
    """Path of a test view's true picture, 8 bits, over the scene's background."""
    return inside(truth, f"{index:04d}.png")


def truth_arrays(truth: Path, index: int) -> Path:
    """Path of a test view's true arrays, where they exist: depth, normals, alpha, straight colour, mask."""
    return inside(truth, f"{index:04d}.npz")


def read_run(folder: Path, protocol: str = DEFAULT) -> Run:
    """Read one run folder, with its scores under ``protocol``.

    Raises:
        InputError: the folder is no run, or a file of it is missing or broken; the sentence names file and key.
    """
    if not folder.is_dir():
        raise InputError(f"There is no run at '{folder}'.", "Give the folder that `invgraphics fit` wrote.")
    files = RunFolder(folder)
    scores = files.read_scores(protocol)
    if scores.seed is None:
        raise InputError(f"'{files.scores_path(protocol)}' lacks the key 'seed'.", "Expected: the fit's seed, a whole number.")
    for name, score in scores.quality.items():
        if score.per_view and len(score.per_view) != len(scores.views):
            counts = f"{len(score.per_view)} values for {len(scores.views)} views"
            raise InputError(f"'{files.scores_path(protocol)}': 'quality.{name}' has {counts}.")
    return Run(
        folder=folder,
        method=scores.method,
        seed=scores.seed,
        scores=scores,
        provenance=files.read(Provenance),
        environment=files.read(Environment),
        history=read_history(files.history),
    )
