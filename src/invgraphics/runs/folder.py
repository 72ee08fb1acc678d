"""The files of a run folder: where they are, and how they are written and read."""

from __future__ import annotations

import fcntl
import json
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import ParseError

from invgraphics.errors import InputError
from invgraphics.runs import checkpoint


def make_parent(out: Path) -> None:
    """Create the folder that the file ``out`` goes into, before anything is computed for it.

    Raises:
        InputError: it cannot be made, or ``out`` is a folder.
    """
    if out.is_dir():
        raise InputError(f"--out cannot be '{out}', which is a folder.", "Give the name of a file.")
    try:
        out.absolute().parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"The folder of '{out}' cannot be made: {error.strerror}.", "Choose another --out.") from error


class RunFolder:
    """A run on disk. Every file but the history is replaced whole, so that an interruption leaves valid files."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def create(self) -> None:
        """Make the folder and see that it can be written.

        Raises:
            InputError: it cannot.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            probe = self.root / ".writable"
            probe.write_text("")
            probe.unlink()
        except OSError as error:
            raise InputError(f"The folder {self.root} cannot be written: {error.strerror}.", "Choose another --out.") from error

    @contextmanager
    def held(self) -> Iterator[None]:
        """Be the only process that writes this run; whoever comes second says so and waits. Freed when a process dies."""
        with (self.root / ".lock").open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                print(f"Waiting for another process that writes {self.root}.", file=sys.stderr, flush=True)
                fcntl.flock(file, fcntl.LOCK_EX)
            yield

    @property
    def identity(self) -> str:
        """Identity of the run that is here, finished or not; empty where there is none."""
        if not (self.root / "provenance.json").is_file():
            return ""
        return str(self.read_json("provenance.json").get("cell_sha256", ""))

    @property
    def checkpoint(self) -> Path:
        """Everything a resumed fit needs."""
        return self.root / checkpoint.NAME

    def snapshot(self, index: int) -> Path:
        """The model at one moment of the fit, for time-lapses."""
        return self.root / "snapshots" / f"{index:04d}.safetensors"

    @property
    def snapshots(self) -> list[Path]:
        """The kept states of the model, first to last."""
        return sorted((self.root / "snapshots").glob("*.safetensors"))

    @property
    def history(self) -> Path:
        """One JSON line for each recorded moment of the fit."""
        return self.root / "history.jsonl"

    @property
    def finished(self) -> bool:
        """Whether the run has its scores."""
        return (self.root / "scores.json").is_file()

    @property
    def resumable(self) -> bool:
        """Whether a fit can go on: from a checkpoint, and the seconds that it had taken."""
        return self.checkpoint.is_file() and (self.root / "fit.json").is_file()

    def clear(self) -> None:
        """Remove the files of an earlier run, and nothing else."""
        names = [
            "recipe.toml",
            "history.jsonl",
            "fit.json",
            "error.txt",
            "environment.json",
            "provenance.json",
            "renderings.json",
            checkpoint.NAME,
        ]
        patterns = ("scores*.json", "test/*", "snapshots/*")
        found = [path for pattern in patterns for path in self.root.glob(pattern)]
        for path in [*(self.root / name for name in names), *found]:
            path.unlink(missing_ok=True)

    def write_json(self, name: str, content: Any) -> None:
        """Write one JSON file, atomically."""
        write_json(self.root / name, content)

    def read_json(self, name: str) -> dict[str, Any]:
        """Read one JSON file of the run.

        Raises:
            InputError: it is missing or broken.
        """
        return read_json(self.root / name)

    def write_recipe(self, table: dict[str, Any]) -> None:
        """Write the resolved recipe."""
        (self.root / "recipe.toml").write_text(tomlkit.dumps(table))

    def read_recipe(self) -> dict[str, Any]:
        """Read the resolved recipe."""
        try:
            return tomlkit.parse((self.root / "recipe.toml").read_text()).unwrap()
        except FileNotFoundError:
            raise InputError(f"{self.root} is not a run: it has no recipe.toml.") from None
        except ParseError as error:
            raise InputError(f"{self.root / 'recipe.toml'} is not valid TOML: {error}.") from error

    def append_history(self, line: dict[str, Any]) -> None:
        """Add one moment to the history."""
        with self.history.open("a") as file:
            file.write(json.dumps(line) + "\n")

    def cut_history(self, step: int) -> None:
        """Drop what came after ``step``: a resumed fit will live it again."""
        if self.history.is_file():
            kept = [line for line in self._history_lines() if line["step"] <= step]
            self.history.write_text("".join(json.dumps(line) + "\n" for line in kept))

    def _history_lines(self) -> Iterable[dict[str, Any]]:
        for line in self.history.read_text().splitlines():
            try:
                yield json.loads(line)
            except json.JSONDecodeError:
                return  # the line that an interruption cut off


def write_json(path: Path, content: Any) -> None:
    """Write JSON beside ``path`` and rename it."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file, with a sentence where it is missing or broken."""
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise InputError(f"{path} does not exist.") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path} cannot be read as JSON: {error}.") from error
