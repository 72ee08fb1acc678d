"""Run folders: paths of their files, reading and atomic writing."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from invgraphics import locks
from invgraphics.errors import InputError
from invgraphics.files import write_text
from invgraphics.runs import history
from invgraphics.runs.environment import Environment
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.history import Moment
from invgraphics.runs.inside import inside
from invgraphics.runs.provenance import Provenance
from invgraphics.runs.renderings import Renderings
from invgraphics.runs.schema import Record
from invgraphics.runs.scores import DEFAULT, Scores, scores_file
from invgraphics.tables import read_toml

R = TypeVar("R", bound=Record)

RECIPE = "recipe.toml"
"""The resolved recipe."""
CHECKPOINT = "checkpoint.safetensors"
"""Everything a resumed fit needs, see `invgraphics.runs.checkpoint`."""
RUNS = "runs"
"""Folder of the runs, in a comparison or study."""
TRUTH = "truth"
"""Folder of the true pictures, once per content; in a comparison or study they are shared by its runs."""
RENDERED = "rendered"
"""Folder of a fit's renderings by other renderers, each a run."""
SHARED_ABOVE = 5
"""Levels above a run at which the folder of runs of its comparison or study is looked for: of METHOD/seed-N/rendered/NAME."""
SCENE_COPY = "scene.npz"
"""Copy of a scene that was made in Python, in its run or comparison."""
TEMPORARY = ("*.*.tmp", ".tmp??????", "test/*.*.tmp", "snapshots/*.*.tmp", "snapshots/.tmp??????")
"""Files that are being written: ours (`NAME.SUFFIX.tmp`), and those of safetensors."""
PUBLISHED = (RECIPE, scores_file(), history.FILE, Provenance.FILE, Environment.FILE)
"""Files of a run that a report links."""


@contextmanager
def output_file(out: Path) -> Iterator[None]:
    """Lock the output file ``out`` before its computation starts; its folder is created.

    Raises:
        InputError: its folder cannot be made, ``out`` is a folder, or another process is writing it.
    """
    if out.is_dir():
        raise InputError(f"--out cannot be '{out}', which is a folder.", "Give the name of a file.")
    try:
        out.absolute().parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"The folder of '{out}' cannot be made: {error.strerror}.", "Choose another --out.") from error
    with locks.locked(out):
        yield


@contextmanager
def output_folder(out: Path) -> Iterator[None]:
    """Create the folder ``out``, and lock it for writing.

    Raises:
        InputError: it cannot be made, or another process is writing it.
    """
    folder = RunFolder(out)
    folder.create()
    with folder.held():
        yield


def check_run(folder: Path) -> None:
    """Refuse a folder that holds no run.

    Raises:
        InputError: it lacks a recipe or its provenance.
    """
    for name in (RECIPE, Provenance.FILE):
        if not inside(folder, name).is_file():
            raise InputError(f"{folder} is not a run: it has no {name}.", "Give a folder that `invgraphics fit` wrote.")


class RunFolder:
    """A run's folder. All files but the history are replaced atomically, so that an interruption leaves valid files.

    Paths are checked by `inside`: where a link leads outside the folder, all that uses the path raises `InputError`.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def create(self) -> None:
        """Create the folder, and check that it is writable.

        Raises:
            InputError: it cannot.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.root):  # of no name, or one of its own: others may check at the same time
                pass
        except OSError as error:
            raise InputError(f"The folder {self.root} cannot be written: {error.strerror}.", "Choose another --out.") from error

    @contextmanager
    def held(self, wait: bool = False) -> Iterator[None]:
        """Lock the folder for writing by this process; a dying process frees the lock.

        Args:
            wait: for a process that holds it, which is named on the terminal.

        Raises:
            InputError: another process holds it, and is not waited for; the sentence names it.
        """

        def waiting(holder: locks.Holder) -> None:
            print(f"Waiting for {holder}, which writes {self.root}.", file=sys.stderr, flush=True)

        with locks.locked(self.root, self.root / locks.INSIDE, waiting if wait else None):
            for pattern in TEMPORARY:
                for left in self.root.glob(pattern):  # by a process that was killed; the lock keeps others out
                    if left.is_file():
                        left.unlink(missing_ok=True)
            yield

    def path(self, *names: str) -> Path:
        """Path of a file or folder in this folder.

        Raises:
            InputError: it leads outside.
        """
        return inside(self.root, *names)

    def has(self, kind: type[Record]) -> bool:
        """Whether the file of a record exists."""
        return self.path(kind.FILE).is_file()

    def read(self, kind: type[R]) -> R:
        """Read a record from its file.

        Raises:
            InputError: the file is missing or broken; the sentence names file and key.
        """
        return kind.read(self.path(kind.FILE))

    def write(self, record: Record) -> None:
        """Write a record to its file, atomically."""
        record.write(self.path(record.file))

    def remove(self, kind: type[Record]) -> None:
        """Remove the file of a record, if it exists."""
        (self.root / kind.FILE).unlink(missing_ok=True)

    @property
    def identity(self) -> str:
        """Identity of the folder's run, finished or not; empty without a run."""
        return self.read(Provenance).cell_sha256 if self.has(Provenance) else ""

    @property
    def checkpoint(self) -> Path:
        """Path of the fit's checkpoint."""
        return self.path(CHECKPOINT)

    def snapshot(self, index: int) -> Path:
        """Path of a snapshot of the model during the fit, for time-lapses."""
        return self.path("snapshots", f"{index:04d}.safetensors")

    @property
    def snapshots(self) -> list[Path]:
        """Paths of all snapshots of the model, first to last."""
        return self._matching("snapshots", "*.safetensors")

    def picture(self, index: int) -> Path:
        """Path of the prediction of a test view, 8 bits, over the scene's background."""
        return self.path("test", f"{index:04d}.png")

    def arrays(self, index: int) -> Path:
        """Path of the unrounded prediction of a test view: colour, alpha, depth and normals."""
        return self.path("test", f"{index:04d}.npz")

    @property
    def predictions(self) -> list[Path]:
        """Paths of all unrounded predictions that exist."""
        return self._matching("test", "*.npz")

    def _matching(self, folder: str, pattern: str) -> list[Path]:
        """Sorted paths of the files of a folder in this one that match a pattern."""
        return [self.path(folder, path.name) for path in sorted(self.path(folder).glob(pattern))]

    def truth(self, provenance: Provenance) -> Path:
        """Folder of the run's true pictures: in the run, or in the folder of truth that its comparison or study shares.

        Raises:
            InputError: its provenance names another place.
        """
        real = self.root.resolve()
        sets = [above.parent / TRUTH for above in real.parents[:SHARED_ABOVE] if above.name in (RUNS, RENDERED)]
        path = (real / provenance.truth).resolve()
        if any(path.is_relative_to(place) for place in (real, *sets)):
            return path
        raise InputError(
            f"'{self.root / Provenance.FILE}': 'truth' cannot be '{provenance.truth}', outside the run and its comparison.",
            "Nothing outside them is used: move the run together with its comparison or study.",
        )

    def fit(self, provenance: Provenance) -> RunFolder:
        """Folder of the fit that a rendering shows; the run itself where it is a fit.

        Raises:
            InputError: its provenance names a folder that the rendering does not lie in.
        """
        if provenance.fitted_run is None:
            return self
        fit = (self.root / provenance.fitted_run).resolve()
        if fit not in self.root.resolve().parents:
            raise InputError(
                f"'{self.root / Provenance.FILE}': 'fitted_run' cannot be '{provenance.fitted_run}'.",
                "Expected: the folder that the rendering lies in, for instance '../..'.",
            )
        return RunFolder(fit)

    @property
    def history(self) -> Path:
        """Path of the history, one JSON line for each recorded moment of the fit."""
        return self.path(history.FILE)

    @property
    def finished(self) -> bool:
        """Whether the run has its scores."""
        return self.scores_path().is_file()

    @property
    def resumable(self) -> bool:
        """Whether the fit can be resumed: its checkpoint and its elapsed seconds exist."""
        return self.checkpoint.is_file() and self.has(FitRecord)

    def scores_path(self, protocol: str = DEFAULT) -> Path:
        """Path of a protocol's scores."""
        return self.path(scores_file(protocol))

    def read_scores(self, protocol: str = DEFAULT) -> Scores:
        """Read the scores under a protocol.

        Raises:
            InputError: they are missing or broken.
        """
        return Scores.read(self.scores_path(protocol))

    def clear(self) -> None:
        """Remove the files of an unfinished or replaced run, and no others.

        Its scores go first, as without them it is not finished; its provenance, which identifies the files, goes last.

        Raises:
            InputError: there are files in their places, and no provenance of a run that wrote them.
        """
        for folder in ("test", "snapshots"):
            self.path(folder)
        kinds = (FitRecord, Renderings, Environment, Provenance)
        patterns = (Scores.FILES, "test/*", "snapshots/*")
        found = [path for pattern in patterns for path in self.root.glob(pattern)]
        names = [CHECKPOINT, history.FILE, RECIPE, *(kind.FILE for kind in kinds)]
        foreign = [path for path in (*found, self.checkpoint) if path.exists()]
        if foreign and not self.has(Provenance):
            sentence = f"{self.root} holds {foreign[0].relative_to(self.root)}, which no run here has written."
            raise InputError(sentence, "Choose another --out.")
        for path in [*found, *(self.root / name for name in names)]:
            path.unlink(missing_ok=True)

    def write_recipe(self, table: dict[str, Any]) -> None:
        """Write the resolved recipe, atomically."""
        import tomlkit

        write_text(self.path(RECIPE), tomlkit.dumps(table), durable=True)

    def read_recipe(self) -> dict[str, Any]:
        """Read the resolved recipe.

        Raises:
            InputError: it is missing or is not TOML.
        """
        recipe = self.path(RECIPE)
        if not recipe.is_file():
            raise InputError(f"{self.root} is not a run: it has no {RECIPE}.")
        return read_toml(recipe)

    def append_history(self, moment: Moment) -> None:
        """Append one moment to the history."""
        history.append_history(self.history, moment)

    def cut_history(self, step: int) -> None:
        """Truncate the history after ``step``, from which a resumed fit continues."""
        history.cut_history(self.history, step)
