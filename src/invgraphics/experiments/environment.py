"""Record of the machine, package versions and source code that a run's numbers depend on."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import torch

from invgraphics import kernels
from invgraphics.experiments.progress import warn
from invgraphics.runs.environment import Environment

PACKAGES = ("numpy", "numba", "mitsuba", "pycolmap", "scikit-image")
CUDA_PACKAGES = ("triton",)
"""Packages that decide numbers, besides torch; of the latter some may be missing."""


@cache
def code_version() -> str:
    """Package version with a hash of all source files, which distinguishes an edited working copy from a release."""
    root = Path(__file__).resolve().parents[1]
    sha = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        if not {"report", "cli"} & set(path.relative_to(root).parts):  # they cannot change a number
            sha.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return f"{version('invgraphics')}+{sha.hexdigest()[:12]}"


def deciding_packages(device: torch.device) -> dict[str, str | None]:
    """Versions of the packages that decide the bits of a fit on a device."""
    names = ("numpy", "numba", *(CUDA_PACKAGES if device.type == "cuda" else ()))
    return {"torch": torch.__version__} | {name: version(name) if find_spec(name) else None for name in names}


@cache
def commit(root: Path | None = None) -> str:
    """Git commit of the working copy that this package lies in, ``+ changes`` where tracked files differ from it; else empty.

    Args:
        root: of the repository; ``None`` for the package's own. An installed package lies in none.
    """
    root = root or Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return ""
    head = _git(root, "rev-parse", "HEAD")
    return f"{head} + changes" if head and _git(root, "status", "--porcelain", "--untracked-files=no") else head


def _git(root: Path, *words: str) -> str:
    """Output of a git command; empty where there is no git, or it fails."""
    command = ["git", "--no-optional-locks", "-C", str(root), *words]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def cpu_name() -> str:
    """Name of the CPU as reported by the operating system."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def continued(here: Environment, before: Environment | None) -> Environment:
    """Environment of a resumed fit: machines and packages of its earlier parts are kept where they are others than here.

    Args:
        here: of this part.
        before: that the fit's folder holds; ``None`` of a fit that starts here.
    """
    if before is None:
        return here
    changed = () if _machine(before) == _machine(here) else (_machine(before),)
    if changed:
        warn(f"Warning: the fit was begun elsewhere ({changed[0]}). Its times are of both, and not to be compared.")
    return replace(here, begun_on=(*before.begun_on, *changed))


def begun_by(before: Environment, code: str) -> Environment:
    """Environment of a fit's earlier parts, with the code by which they were made: it goes on by other code.

    Args:
        before: that the fit's folder holds.
        code: in words.
    """
    what = f"Warning: the fit was begun by other code, threads or packages ({code})."
    warn(f"{what} The same command from the start may end elsewhere.")
    return replace(before, begun_on=(*before.begun_on, f"code: {code}"))


def _machine(found: Environment) -> str:
    """Machine and packages in words, without what differs between two processes on it."""
    packages = (f"{name} {number}" for name, number in found.packages.items() if number)
    facts = (found.cpu, f"{found.cores} cores", found.gpu, found.platform, f"Python {found.python}", f"torch {found.torch}")
    return ", ".join([*(fact for fact in facts if fact), *packages])


def environment(device: torch.device) -> Environment:
    """Record the machine, its software versions and the compute device."""
    cuda = device.type == "cuda"
    packages: dict[str, str | None] = {name: version(name) for name in PACKAGES}
    if cuda:
        packages |= {name: version(name) if find_spec(name) else None for name in CUDA_PACKAGES}
    return Environment(
        invgraphics=code_version(),
        commit=commit(),
        python=platform.python_version(),
        torch=torch.__version__,
        platform=platform.platform(),
        cpu=cpu_name(),
        cores=os.cpu_count(),
        threads=torch.get_num_threads(),
        kernels=kernels.in_use(device),
        device=str(device),
        deterministic=not cuda,
        date=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        packages=packages,
        gpu=torch.cuda.get_device_name(device) if cuda else "",
        note="Atomic sums on a GPU are not ordered: repeating a run gives close, not equal, bits." if cuda else "",
    )
