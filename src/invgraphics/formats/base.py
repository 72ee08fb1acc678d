"""Formats of Gaussian files, and reading and writing by format."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import Protocol, runtime_checkable

from invgraphics import plugins
from invgraphics.core import Gaussians
from invgraphics.core.believable import check_gaussians
from invgraphics.errors import InputError
from invgraphics.files import replacing

HEAD_BYTES = 1 << 16
"""How much of a file `Format.matches` gets to see."""
SMALLEST_SCALE = 1e-37
"""Least scale whose logarithm is written: above float32's denormals, which a process that has fitted flushes to zero."""

ANTIALIASED = "anti-aliased: opacities are to be compensated"
"""Note of a file whose format has no place for Mip-Splatting's compensation (`Splats.antialiased`)."""
DILATION = "renderer.dilation="
"""What precedes, in a file's notes, the variance in square pixels of the 2D filter that its Gaussians were fitted with."""


@dataclass(frozen=True, eq=False)
class Splats:
    """Content of a file of Gaussians.

    Attributes:
        gaussians: activated, in the file's own axes and units.
        axes: where the file's +x, +y and +z point, as `core.transforms.axes_to_opencv` reads it; ``None`` where the file does
            not say.
        antialiased: whether they were fitted with Mip-Splatting's opacity compensation; ``None`` where the file does not say.
        notes: what else there is to know, in sentences.
    """

    gaussians: Gaussians
    axes: str | None = None
    antialiased: bool | None = None
    notes: tuple[str, ...] = ()


@runtime_checkable
class Format(Protocol):
    """A format that can be read.

    Attributes:
        suffixes: usual ends of its files' names.
        axes: the axes in which its files are written, as in `Splats`; ``None`` where the format leaves them open.
    """

    suffixes: tuple[str, ...]
    axes: str | None

    def matches(self, path: Path, head: bytes) -> bool:
        """Whether ``path``, which begins with ``head``, is in this format."""
        ...

    def read(self, path: Path) -> Splats:
        """The file's content; bad input raises `InputError`."""
        ...


@runtime_checkable
class WritableFormat(Format, Protocol):
    """A format that can be written as well."""

    def write(self, path: Path, splats: Splats) -> None:
        """Write ``splats``, which are in the format's axes; `InputError` where they do not fit into it."""
        ...


def read_gaussians(path: Path) -> tuple[str, Splats]:
    """Read a file in any known format; returns the format's name and the content.

    Raises:
        InputError: the file is missing, broken, of no known format, empty, or holds numbers that are not finite.
    """
    if not path.is_file():
        raise InputError(f"There is no file '{path}'." if not path.exists() else f"'{path}' is not a file.")
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    for name, kind in plugins.load_all("formats"):
        form: Format = kind()
        if form.matches(path, head):
            return name, checked(form.read(path), path)
    known = ", ".join(plugins.names("formats"))
    raise InputError(f"'{path}' is no file of 3D Gaussians in a known format.", f"Known formats: {known}.")


def write_gaussians(path: Path, name: str, splats: Splats, **settings: int) -> None:
    """Write a file in the format ``name``, whole or not at all; ``settings`` are those of its class, such as a version.

    Raises:
        InputError: the format is unknown or cannot be written, the file's name has another ending, there are no Gaussians, or
            they do not fit into the format.
    """
    form = plugins.load("formats", name)(**settings)
    if not isinstance(form, WritableFormat):
        raise InputError(f"The format '{name}' can only be read.")
    if not path.name.lower().endswith(form.suffixes):  # a run's checkpoint, say, would be overwritten
        raise InputError(f"'{path}' has another ending than {name} files.", f"Expected: {' or '.join(form.suffixes)}.")
    splats = checked(splats, path)
    with replacing(path) as temporary:
        form.write(temporary, splats)


def checked(splats: Splats, path: Path) -> Splats:
    """Validate: at least one Gaussian, believable numbers; quaternions of length zero become the identity.

    Raises:
        InputError: there are no Gaussians, or some are not believable (`core.believable`).
    """
    gaussians = splats.gaussians
    if len(gaussians) == 0:
        raise InputError(f"'{path}': there are no Gaussians.")
    check_gaussians(gaussians, f"'{path}'")
    still = gaussians.quaternions.norm(dim=1) == 0
    if not bool(still.any()):
        return splats
    identity = gaussians.quaternions.new_tensor([1.0, 0.0, 0.0, 0.0])
    mended = replace(gaussians, quaternions=torch.where(still[:, None], identity, gaussians.quaternions))
    return replace(splats, gaussians=mended, notes=(*splats.notes, f"{int(still.sum())} rotations of length zero."))


def truncation_error(path: Path, expected: int, present: int) -> InputError:
    """The error for a truncated file, with both sizes in bytes."""
    return InputError(f"'{path}' is cut off: {expected} bytes are expected, {present} are there.", "Copy the file again.")


def complete_quaternions(largest: Int[Tensor, " n"], others: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Unit quaternions from three components in order, among which the largest one goes to index ``largest``."""
    stored = torch.cat([others, (1 - others.square().sum(dim=1, keepdim=True)).clamp_min(0).sqrt()], dim=1)
    place, gap = torch.arange(4).expand(len(others), 4), largest[:, None]
    source = (place - (place > gap).long()).masked_fill(place == gap, 3)
    return stored.gather(1, source)
