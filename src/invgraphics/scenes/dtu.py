"""DTU's reference scans, observation masks and table planes, where they lie beside a scene's cameras."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import torch

from invgraphics.core.scan import Scan
from invgraphics.errors import InputError

_SCANS, _MASKS, _PLANES = "stl*_total.ply", "ObsMask*_10.mat", "Plane*.mat"


def find_scan(folder: Path) -> tuple[Scan | None, str]:
    """Read the reference scan of a scene's folder, and say what the data lacks for DTU's rule.

    Looked for, in the folder and below it: ``stlNNN_total.ply`` of DTU's points, ``ObsMaskN_10.mat`` and ``PlaneN.mat`` of its
    observation masks.

    Raises:
        InputError: a file is damaged, or there are scans of several scenes.
    """
    scans = sorted(folder.rglob(_SCANS))
    if not scans:
        return None, f"the data set has no reference scan ({_SCANS} of DTU's points, beside its cameras)"
    if len(scans) > 1:
        names = ", ".join(path.name for path in scans)
        raise InputError(f"{folder} has several reference scans: {names}.", "Leave the one of this scene there.")
    number = int((re.findall(r"\d+", scans[0].stem) or ["0"])[0])
    mask, plane = (_of_scene(folder, pattern, number) for pattern in (_MASKS, _PLANES))
    values: dict[str, Any] = {"points": _points(scans[0])}
    if mask is not None:
        table = _matlab(mask, ("ObsMask", "BB", "Res"))
        observed, box, voxel = np.asarray(table["ObsMask"]), _numbers(mask, table, "BB"), _numbers(mask, table, "Res")
        if observed.ndim != 3 or observed.dtype.kind not in "biuf" or box.size != 6 or voxel.size != 1 or not voxel.min() > 0:
            shapes = f"ObsMask {observed.shape}, BB {box.shape} and Res {voxel.tolist()}"
            raise InputError(f"'{mask}' has {shapes}.", "Expected: a grid, 2 corners of 3 coordinates, and a size above 0.")
        values["observed"] = torch.from_numpy(observed > 0)
        values["origin"] = torch.from_numpy(box.reshape(2, 3)[0].copy())
        values["voxel"] = float(voxel.reshape(()))
    if plane is not None:
        numbers = _numbers(plane, _matlab(plane, ("P",)), "P")
        if numbers.size != 4:
            raise InputError(f"'{plane}' has {numbers.size} numbers as its plane P.", "Expected: 4.")
        values["plane"] = torch.from_numpy(numbers.reshape(4).copy())
    lacking = [name for name, path in (("observation mask", mask), ("table plane", plane)) if path is None]
    return Scan(**values), "".join(f"; the data has no {name}" for name in lacking)


def _numbers(path: Path, table: dict[str, Any], name: str) -> np.ndarray:
    """An array of a MATLAB file as finite float64."""
    try:
        values = np.asarray(table[name], np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"'{path}': {name} is no array of numbers.") from error
    if not np.isfinite(values).all():
        raise InputError(f"'{path}': {name} has values that are not finite.")
    return values


def _of_scene(folder: Path, pattern: str, number: int) -> Path | None:
    """The file of this scan among those of a pattern: scans are numbered with or without leading zeros."""
    found = [
        path for path in sorted(folder.rglob(pattern)) if (re.findall(r"\d+", path.stem) or [""])[0].lstrip("0") == str(number)
    ]
    return found[0] if found else None


def _points(path: Path) -> torch.Tensor:
    import trimesh

    try:
        with path.open("rb") as file:
            loaded: Any = trimesh.load(file, file_type="ply", process=False)
        points = np.asarray(loaded.vertices, np.float64)
    except OSError:
        raise
    except Exception as error:  # what a damaged file makes of a reader
        raise InputError(f"'{path}' cannot be read as points: {type(error).__name__}: {error}.") from error
    if not len(points) or not np.isfinite(points).all():
        raise InputError(f"'{path}' has no points, or some that are not finite.")
    return torch.from_numpy(points.copy())


def _matlab(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        table = loadmat(path)
    except OSError:
        raise
    except Exception as error:
        raise InputError(f"'{path}' cannot be read as a MATLAB file: {type(error).__name__}: {error}.") from error
    if missing := [name for name in names if name not in table]:
        raise InputError(f"'{path}' has no {', '.join(missing)}.")
    return table
