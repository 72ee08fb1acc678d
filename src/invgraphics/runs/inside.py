"""Paths inside a folder: whatever names in records and links on disk say, nothing outside is read, copied or written."""

from __future__ import annotations

from pathlib import Path

from invgraphics.errors import InputError


def inside(folder: Path, *names: str | Path) -> Path:
    """Join ``names`` to ``folder``, links followed and compared with where the folder really lies.

    Args:
        folder: may itself be a link.
        names: relative, one level or several; what they name need not exist.

    Returns:
        The path as joined, of a regular file, a folder, or nothing yet.

    Raises:
        InputError: it leads outside the folder, or to a device, pipe or socket.
    """
    path = folder.joinpath(*names)
    try:
        real, home = path.resolve(), folder.resolve()
        odd = real.exists() and not (real.is_file() or real.is_dir())
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links; a NUL
        raise InputError(f"'{path}' cannot be followed: {error}.") from error
    if not real.is_relative_to(home):
        raise InputError(f"'{path}' leads outside '{folder}'.", "Put the file itself there: nothing outside is used.")
    if odd:
        raise InputError(f"'{path}' is neither a file nor a folder.")
    return path
