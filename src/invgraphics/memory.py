"""Memory of the machine, of the container around the process, and of the process itself, bytes."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from invgraphics.errors import InputError

_CGROUP = Path("/sys/fs/cgroup")
STATM, STATUS, CLEAR = (Path("/proc/self") / name for name in ("statm", "status", "clear_refs"))
"""Linux: sizes of this process in pages, its peaks, and the file that sets the resident set's peak back to the present."""
_RESET = "5"
_SHARE = 0.8  # of the available memory that one request may take: the rest is for allocations that a forecast leaves out


def total_bytes() -> int:
    """Physical memory, or less where a container (cgroup v2) has a smaller limit."""
    limit = _number(_CGROUP / "memory.max")
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return physical if limit is None else min(limit, physical)


def available_bytes() -> int:
    """Memory available without swapping: the kernel's estimate, within the container's limit."""
    free = [total_bytes()]
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free += [int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:")]
    except (OSError, ValueError, IndexError):
        pass  # not Linux: the physical memory is all that is known
    limit, used = _number(_CGROUP / "memory.max"), _number(_CGROUP / "memory.current")
    if limit is not None and used is not None:
        free.append(limit - used)
    return max(0, min(free))


def resident_bytes() -> int:
    """Resident set size of this process; where there is no ``/proc``, its peak so far."""
    import resource

    if STATM.exists():
        return int(STATM.read_text().split()[1]) * resource.getpagesize()
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def reset_peak() -> bool:
    """Set `peak_resident_bytes` back to the present resident set; ``False`` where that is not possible."""
    try:
        CLEAR.write_text(_RESET)
    except OSError:
        return False
    return peak_resident_bytes() is not None


def peak_resident_bytes() -> int | None:
    """Largest resident set of this process since `reset_peak`, as Linux records it; ``None`` where none is recorded."""
    try:
        lines = STATUS.read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM:")), None)


def check_fits(needed: float, what: str, remedy: str) -> None:
    """Check a memory demand against the available memory, before anything is allocated.

    Args:
        needed: bytes at the peak.
        what: beginning of the sentence: "The field of 'x' with field.count = 1e9".
        remedy: which value to change.

    Raises:
        InputError: it does not fit.
    """
    free = available_bytes()
    if needed > _SHARE * free:
        raise InputError(f"{what} needs about {format_bytes(needed)} of memory, and {format_bytes(free)} are free.", remedy)


def format_bytes(size: float) -> str:
    """Format bytes as GB or MB, two digits."""
    if size >= 1e11:
        return f"{size / 1e9:,.0f} GB"
    return f"{size / 1e9:.2g} GB" if size >= 1e9 else f"{size / 1e6:.2g} MB"


def _number(path: Path) -> int | None:
    """Read a limit of the container; ``None`` where there is none."""
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):  # no container, or "max"
        return None
