"""Numba's kernels compiled for older processors give the same numbers, with the vector registers those have.

Each level runs in a process of its own, because Numba reads the processor's name when it is imported, and with a cache of its
own. What takes longer to compile is checked with the slow tests.
"""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("numba_parity.py")
LEVELS = {"nehalem": "xmm", "haswell": "ymm", "skylake-avx512": "zmm"}
"""Processors that stand for x86-64-v2, v3 and v4, and the widest registers they have."""
NEEDED = {"nehalem": "sse4_2", "haswell": "avx2", "skylake-avx512": "avx512vl"}


def flags() -> set[str]:
    """What this machine's processor says it can do, where Linux tells."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    return {flag for line in lines if line.startswith("flags") for flag in line.partition(":")[2].split()}


def start(part: str, processor: str, cache: Path) -> subprocess.Popen[str]:
    """Begin one part's parity check on a level of x86, or skip where it cannot run."""
    if platform.machine() not in ("x86_64", "AMD64") or NEEDED[processor] not in flags():
        pytest.skip(f"this machine has no {NEEDED[processor]}")
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": processor,
        "NUMBA_CPU_FEATURES": "",  # those of the name; otherwise Numba adds the host's
        "NUMBA_CACHE_DIR": str(cache),
    }
    command = [sys.executable, str(SCRIPT), part, LEVELS[processor]]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str], part: str, processor: str) -> None:
    """Wait for it; it must have compared something and found vector instructions."""
    out, errors = process.communicate(timeout=400)
    assert process.returncode == 0, errors[-3000:]
    assert out.split() == [part, LEVELS[processor], "vectorised"]


def test_samples(tmp_path: Path) -> None:
    """The level that differs most from today's; nearly all of the time is compilation."""
    finish(start("samples", "nehalem", tmp_path), "samples", "nehalem")


@pytest.mark.slow
@pytest.mark.parametrize("processor", ["haswell", "skylake-avx512"])
def test_samples_with_wider_registers(processor: str, tmp_path: Path) -> None:
    finish(start("samples", processor, tmp_path), "samples", processor)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["hashing", "fields", "pictures"])
@pytest.mark.parametrize("processor", ["nehalem", "haswell", "skylake-avx512"])
def test_what_takes_longer_to_compile(processor: str, part: str, tmp_path: Path) -> None:
    finish(start(part, processor, tmp_path), part, processor)
