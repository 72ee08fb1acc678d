"""Selection of the Mitsuba variant for this machine: the vectorised one needs a working LLVM library.

Dr.Jit takes the newest system library by itself, and one that is too old *aborts the process* at the first kernel rather than
raising. So every candidate is tried in a process of its own, and the winner is passed on by ``DRJIT_LIBLLVM_PATH``.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
OLDEST = 19
"""LLVM 15 and 16 abort (no ``fminimum`` for float32 vectors); 19, 22 and 23 work."""

FAST, PORTABLE = "llvm_ad_rgb", "scalar_rgb"
REMEDY = f"Install LLVM {OLDEST} or newer: `pip install 'invgraphics[llvm]'`, or `apt-get install libllvm{OLDEST}`."
SYSTEM_FOLDERS = ("/usr/lib/*-linux-gnu", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib")

# `minimum` of two vectors is the operation that an old LLVM cannot compile.
_PROBE = "import drjit; from drjit.llvm import Float; assert drjit.minimum(drjit.arange(Float, 64), 5)[63] == 5"


@dataclass(frozen=True)
class Status:
    """Selected Mitsuba variant and its LLVM library.

    Attributes:
        variant: name of the Mitsuba variant.
        library: path of the LLVM library; ``None`` for the portable variant.
        reason: one sentence.
        remedy: what would make it faster; empty when nothing is missing.
    """

    variant: str
    library: str | None
    reason: str
    remedy: str = ""

    def environment(self) -> dict[str, str]:
        """Environment variables for a rendering process."""
        return {**os.environ, VARIABLE: self.library} if self.library else dict(os.environ)


@cache
def status() -> Status:
    """Probe LLVM libraries; selects the first that computes correctly in a process of its own, else the scalar variant."""
    failures = []
    for library in _candidates():
        failure = _probe(library)
        if failure is None:
            return Status(FAST, library, f"LLVM works: {library}.")
        failures.append(f"{library} {failure}")
    found = "; ".join(failures) or f"no LLVM {OLDEST} or newer was found"
    return Status(PORTABLE, None, f"{found}; rendering falls back to the portable variant, about 2.5 times slower.", REMEDY)


def _candidates() -> Iterator[str]:
    """List candidate libraries, best first; a user's explicit choice excludes all others."""
    chosen = os.environ.get(VARIABLE)
    if chosen:
        yield chosen
        return
    own = Path(sys.prefix) / "lib"
    yield from (str(path) for path in (own / "libLLVM.so", own / "libLLVM.dylib") if path.exists())
    system = {
        path for pattern in SYSTEM_FOLDERS for path in Path("/").glob(f"{pattern[1:]}/libLLVM*") if _version(path) >= OLDEST
    }
    yield from (str(path) for path in sorted(system, key=_version, reverse=True))


def _version(path: Path) -> int:
    """Major version in a library's name: ``libLLVM.so.19.1``, ``libLLVM-19.so``, ``libLLVM.19.1.dylib``; 0 where there is none.

    ``libLLVM.dylib``, as Homebrew's newest is called, counts as the oldest that is tried: the probe decides.
    """
    if path.name == "libLLVM.dylib":
        return OLDEST
    match = re.fullmatch(r"libLLVM(?:-(\d+)[\d.]*\.(?:so.*|dylib)|\.so\.(\d+).*|\.(\d+)[\d.]*\.dylib)", path.name)
    return int(next(filter(None, match.groups()), 0)) if match else 0


def _probe(library: str) -> str | None:
    """Test ``library``; returns the reason of failure, or ``None``."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE], env={**os.environ, VARIABLE: library}, capture_output=True, timeout=60, check=False
        )
    except subprocess.TimeoutExpired:
        return "did not answer within a minute"
    return None if done.returncode == 0 else "is too old or broken"
