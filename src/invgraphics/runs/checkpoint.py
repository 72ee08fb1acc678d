"""Checkpoints: the whole state of a fit as one safetensors file, written atomically, without clock readings."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from invgraphics.core.finite import describe_non_finite
from invgraphics.errors import InputError, NumericalError
from invgraphics.files import replacing


def save(path: Path, parts: dict[str, dict[str, Tensor]]) -> None:
    """Write ``parts`` (section -> name -> tensor) atomically: an interruption leaves either the old file or the new one.

    Raises:
        NumericalError: a value is not finite; the old file stays.
    """
    if found := describe_non_finite(parts):
        raise NumericalError(f"{path} is not written: {found}.")
    flat = _flat(parts)
    with replacing(path) as temporary:
        try:
            save_file(flat, temporary)
        except SafetensorError as error:  # the system's error in words
            number = re.search(r"os error (\d+)", str(error))
            code = int(number[1]) if number else errno.EIO
            raise OSError(code, os.strerror(code), str(path)) from error
        with temporary.open("rb") as file:
            os.fsync(file.fileno())


def _flat(parts: dict[str, dict[str, Tensor]]) -> dict[str, Tensor]:
    """All tensors as the format takes them, contiguous on the CPU; of those that share memory, all but one are copies."""
    flat, seen = {}, set()
    for section, part in parts.items():
        for name, value in part.items():
            plain = value.detach().cpu().contiguous()
            place = plain.untyped_storage().data_ptr()
            flat[f"{section}|{name}"] = plain.clone() if place in seen else plain
            seen.add(place)
    return flat


def load(path: Path, device: torch.device | None = None) -> dict[str, dict[str, Tensor]]:
    """Read a checkpoint as section -> name -> tensor (inverse of `save`).

    Raises:
        InputError: the file is missing or is not a whole checkpoint, or a value in it is not finite.
    """
    try:
        flat = load_file(path, device=str(device or "cpu"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist.", "The run has not reached its first checkpoint.") from None
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path} is not a readable checkpoint: {error}.") from error
    parts: dict[str, dict[str, Tensor]] = {}
    for key, value in flat.items():
        section, bar, name = key.partition("|")
        if not bar:
            raise InputError(f"{path} was not written by invgraphics: it holds '{key}'.")
        parts.setdefault(section, {})[name] = value
    if found := describe_non_finite(parts):
        raise InputError(f"{path} cannot be used: {found}.", "The fit diverged, or the file was damaged: fit again.")
    return parts
