"""Atomic writing of files: whole or not at all, and a full disk is named together with the file and the remedy.

Every result is written through this module: the content goes to a temporary file beside its place and is renamed at the end, so
that an interruption or a full disk leaves either the old file or the new one.
"""

from __future__ import annotations

import errno
import io
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from invgraphics.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_AGAIN = "Free some space there, and give the command again (a fit: with --resume)."
FULL = {
    errno.ENOSPC: ("the disk is full", _AGAIN),
    errno.EDQUOT: ("the disk quota is used up", _AGAIN),
    errno.EFBIG: ("a file may not become as large there", "Raise the limit (`ulimit -f unlimited`), or write to another disk."),
}
"""Errors of a disk that takes no more -> what it is, and the remedy."""
FAULTS = {
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EROFS: "the file system is read-only",
    errno.ENOENT: "no such file or folder",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.EISDIR: "it is a folder",
    errno.EEXIST: "it exists, and is not a folder",
    errno.ENAMETOOLONG: "the name is too long",
}
"""Other failures of the file system that a person can mend, in words."""
_SYSTEM_ERROR = re.compile(r"(?i)\(os error (\d+)\)|\[errno (\d+)\]")  # how Rust and Arrow spell errors of the system in words


def full_disk(path: Path | str | None, error: BaseException) -> InputError | None:
    """Convert an error of writing to a full disk to one that names the file and the remedy.

    Args:
        path: the file or folder that was being written; ``None`` if it is not known.
        error: what was raised, by the system or by a library that quotes it.

    Returns:
        ``None`` if ``error`` says nothing of a full disk.
    """
    number = getattr(error, "errno", None)
    if number is None and (quoted := _SYSTEM_ERROR.search(str(error))):
        number = int(quoted.group(1) or quoted.group(2))
    if number is None and "No space left on device" in str(error):
        number = errno.ENOSPC
    if number not in FULL:
        return None
    what, remedy = FULL[number]
    subject = "A file" if path is None else f"'{path}'"
    return InputError(f"{subject} cannot be written: {what}.", remedy)


def file_fault(error: BaseException) -> InputError | None:
    """Convert an error of the file system that a person can mend, a full disk among them, to one that names the file.

    Returns:
        ``None`` for any other error.
    """
    if full := full_disk(getattr(error, "filename", None), error):
        return full
    if not isinstance(error, OSError) or error.errno not in FAULTS:
        return None
    subject = f"'{error.filename}'" if error.filename else "a file"
    return InputError(f"{subject} cannot be used: {FAULTS[error.errno]}.")


@contextmanager
def naming_full_disk(path: Path) -> Iterator[None]:
    """Turn errors of a full disk within the context into an `InputError` that names ``path``.

    Raises:
        InputError: the disk is full, a quota is used up, or files may not become as large.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        full = full_disk(path, error)
        if full is None:
            raise
        raise full from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` to be written, which replaces it at the end; an exception removes it.

    Args:
        path: the file.

    Raises:
        InputError: as `naming_full_disk`.
    """
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        with naming_full_disk(path):
            yield temporary
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path, *, durable: bool = False) -> Iterator[IO[bytes]]:
    """Yield a binary file that replaces ``path`` at the end; an exception removes it. Errors as `replacing`.

    Args:
        path: the file.
        durable: whether the content is on the disk before it replaces the file: else a loss of power soon afterwards can leave
            an empty one.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        yield file
        if durable:
            file.flush()
            os.fsync(file.fileno())


@contextmanager
def writing_text(path: Path) -> Iterator[IO[str]]:
    """Yield a UTF-8 text file, for ``csv``, that replaces ``path`` at the end; line ends are written as they are given."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        yield file


def write_bytes(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write a file atomically; ``durable`` as of `writing`."""
    with writing(path, durable=durable) as file:
        file.write(content)


def write_text(path: Path, text: str, *, durable: bool = False) -> None:
    """Write a UTF-8 text file atomically; ``durable`` as of `writing`."""
    write_bytes(path, text.encode("utf-8"), durable=durable)


def append_text(path: Path, text: str) -> None:
    """Append to a UTF-8 text file: all of ``text``, or nothing where the disk is full.

    Raises:
        InputError: as `naming_full_disk`.
    """
    with naming_full_disk(path), path.open("ab", buffering=0) as file:
        size, rest = file.tell(), text.encode("utf-8")
        try:
            while rest:
                rest = rest[file.write(rest) :]
        except OSError:
            file.truncate(size)
            raise


def write_arrays(path: Path, arrays: Mapping[str, ArrayLike]) -> None:
    """Write a compressed ``.npz`` archive atomically."""
    import numpy as np

    with writing(path) as file:
        np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]  # numpy's stub takes keywords for switches


def write_picture(path: Path, image: Any, **options: Any) -> None:
    """Write a Pillow image as PNG atomically.

    Args:
        path: the file.
        image: a ``PIL.Image.Image``.
        options: of Pillow's PNG writer.
    """
    content = io.BytesIO()  # Pillow's encoder hides the system's error behind one of its own
    image.save(content, format="PNG", **options)
    with writing(path) as file:
        file.write(content.getvalue())


def copy_file(source: Path | str, target: Path | str) -> None:
    """Copy a file's content atomically."""
    with replacing(Path(target)) as temporary:
        shutil.copyfile(source, temporary)
