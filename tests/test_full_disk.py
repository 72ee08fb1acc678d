"""A full disk, on a real small file system: every command names the file and the remedy, and leaves nothing half-written."""

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from made_up_runs import made_up_provenance
from PIL import Image
from training_fixtures import SMALL

from invgraphics import files
from invgraphics.cli import main
from invgraphics.errors import InputError
from invgraphics.experiments.request import FitRequest
from invgraphics.experiments.run import fit_run
from invgraphics.formats.base import read_gaussians
from invgraphics.runs import checkpoint
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.history import read_history

METHOD = "splatting/gaussians"
SIZE = 16 << 20
ROOMS = (0, 1 << 14, 1 << 16, 1 << 19, 1 << 23)
"""Free bytes with which a command is tried, until it ends well."""
Words = Callable[[Path, Path], list[str]]

COMMANDS: dict[str, Words] = {
    "evaluate": lambda run, disk: ["evaluate", str(run)],
    "export ply": lambda run, disk: ["export", str(run), "--to", "ply", "--out", str(disk / "out.ply")],
    "export spz": lambda run, disk: ["export", str(run), "--to", "spz", "--out", str(disk / "out.spz")],
    "render": lambda run, disk: ["render", str(run), "--frames", "12", "--size", "128", "--out", str(disk / "out.mp4")],
    "explain": lambda run, disk: ["explain", str(run), "--view", "0", "--pixel", "8,8", "--out", str(disk / "explained")],
    "report": lambda run, disk: ["report", str(run), "--out", str(disk / "report")],
    "rescore": lambda run, disk: ["rescore", str(run), "--out", str(disk / "rescored")],
}


@pytest.fixture(scope="module")
def run(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    return fit_run(
        FitRequest(method=METHOD, scene=str(toy_folder), out=str(out), budget="20steps", overrides=tuple(SMALL[METHOD]))
    )


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of `SIZE` bytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(folder)]
    if sys.platform != "linux" or os.geteuid() != 0 or subprocess.run(mount, check=False).returncode:
        pytest.skip("mounting a small tmpfs needs root, on Linux")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def leave(disk: Path, room: int) -> None:
    """Fill the disk but for ``room`` bytes."""
    ballast = disk / "ballast"
    ballast.unlink(missing_ok=True)
    ballast.write_bytes(bytes(max(0, shutil.disk_usage(disk).free - room)))


def check_whole(folder: Path) -> None:
    """Every file that is there can be read from its beginning to its end, by another route than it was written."""
    for path in folder.rglob("*"):
        assert path.suffix not in (".tmp", ".partial"), path
        match path.suffix:
            case ".png":
                Image.open(path).load()
            case ".npz":
                assert all(array.size for array in np.load(path).values())
            case ".json":
                json.loads(path.read_text())
            case ".jsonl":
                assert all(json.loads(line) for line in path.read_text().splitlines())
            case ".safetensors":
                checkpoint.load(path)
            case ".ply" | ".spz":
                read_gaussians(path)
            case ".html":
                assert path.read_text().rstrip().endswith("</html>")
            case ".svg":
                assert path.read_text().rstrip().endswith("</svg>")
            case ".mp4":
                assert b"moov" in path.read_bytes()
            case ".md" | ".csv" | ".toml" | ".tex" | ".parquet":
                assert path.stat().st_size > 0


def fails_cleanly(words: list[str], disk: Path, capsys: pytest.CaptureFixture[str]) -> int:
    """Give a command with more and more room, until it is enough; returns how often it was not."""
    said = ""
    for failures, room in enumerate(ROOMS):
        leave(disk, room)
        capsys.readouterr()
        resumed = ["--resume"] if words[0] == "fit" and (disk / "run" / "provenance.json").is_file() else []
        status = main.run([*words, *resumed])
        said = capsys.readouterr().err
        check_whole(disk)
        if status == main.DONE:
            return failures
        assert status == main.BAD_INPUT, said
        named = [line for line in said.splitlines() if f"'{disk}" in line and "cannot be written" in line]
        assert named and "Traceback" not in said, said
        assert "free some space" in said.lower(), said
    raise AssertionError(f"not even {ROOMS[-1]} bytes are enough: {said}")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_names_the_file_and_leaves_whole_ones(
    run: Path, disk: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = COMMANDS[name](Path(shutil.copytree(run, disk / "run")), disk)
    assert fails_cleanly(words, disk, capsys) > 0


def test_a_fit_names_the_file_and_goes_on_when_there_is_room(
    run: Path, toy_folder: Path, disk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["fit", METHOD, str(toy_folder), "--out", str(disk / "run"), "--budget", "20steps", "--checkpoint-every", "4steps"]
    assert fails_cleanly(words + [word for setting in SMALL[METHOD] for word in ("--set", setting)], disk, capsys) > 2
    assert (disk / "run" / "checkpoint.safetensors").read_bytes() == (run / "checkpoint.safetensors").read_bytes()
    steps = [moment.step for moment in read_history(disk / "run" / "history.jsonl")]
    assert steps == sorted(set(steps))


LIMITED = """
import resource, sys
from invgraphics.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
for words in {commands!r}:
    assert main.run(words) == main.BAD_INPUT, words
"""


def test_a_limit_on_the_size_of_files_is_said_with_its_remedy(run: Path, toy_folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("resource", reason="limits on files are POSIX's")
    commands = [COMMANDS[name](run, tmp_path) for name in ("export ply", "render", "report", "explain")]
    small = [word for setting in SMALL[METHOD] for word in ("--set", setting)]
    fit = ["fit", METHOD, str(toy_folder), "--out", str(tmp_path / "run"), "--budget", "2steps", "--kernels", "reference"]
    commands.append([*fit, *small])
    code = LIMITED.format(commands=commands)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("a file may not become as large there") >= len(commands) - 1, ended.stderr  # ffmpeg dies of it
    assert ended.stderr.count("cannot be written") == len(commands), ended.stderr
    check_whole(tmp_path)


@pytest.mark.parametrize(
    "error",
    [
        OSError(28, "No space left on device"),
        OSError("Error writing bytes. Detail: [errno 28] No space left on device"),
        RuntimeError("I/O error: No space left on device (os error 28)"),
    ],
)
def test_what_was_there_stays(tmp_path: Path, error: Exception) -> None:
    path = tmp_path / "file.txt"
    files.write_text(path, "old")

    def fail() -> None:
        with files.writing(path) as file:
            file.write(b"new, but not")
            raise error

    with pytest.raises(InputError, match=f"'{path}' cannot be written: the disk is full"):
        fail()
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_records_are_on_the_disk_before_they_replace_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As checkpoints are: else a loss of power could leave a checkpoint without the steps that it belongs to."""
    order: list[tuple[str, int]] = []
    synchronise, rename = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda file: (order.append(("synchronised", os.fstat(file).st_size)), synchronise(file)))
    monkeypatch.setattr(
        Path, "replace", lambda path, target: (order.append(("replaced", path.stat().st_size)), rename(path, target))
    )
    folder = RunFolder(tmp_path)
    folder.write(FitRecord(steps=3, seconds=1.0))
    folder.write(made_up_provenance())
    folder.write_recipe({"summary": "s"})
    sizes = [(tmp_path / name).stat().st_size for name in ("fit.json", "provenance.json", "recipe.toml")]
    assert order == [(what, size) for size in sizes for what in ("synchronised", "replaced")] and min(sizes) > 10


def test_other_errors_pass_and_leave_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with files.writing(tmp_path / "file") as file:
            file.write(b"x")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not list(tmp_path.iterdir())


def test_appending_is_all_or_nothing(disk: Path) -> None:
    path = disk / "history"
    files.append_text(path, "first\n")
    leave(disk, 4096)
    with pytest.raises(InputError, match="the disk is full"):
        files.append_text(path, "x" * 10_000)
    assert path.read_text() == "first\n"


DIRECT = {
    "files.py",
    "memory.py",  # of the kernel, in /proc
    "formats/splat.py",  # into the temporary file of `formats.base.write_gaussians`
    "formats/spz.py",
}
"""Modules that write without `invgraphics.files`."""


def test_every_other_module_writes_through_files() -> None:
    root = Path(files.__file__).parent
    direct = {"write_text", "write_bytes", "savez", "savez_compressed", "copyfile"}
    found = set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in direct:
                found.add(path.relative_to(root).as_posix())
    assert found == DIRECT
