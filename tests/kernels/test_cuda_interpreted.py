"""Triton's kernels without a GPU: interpreted against the plain reference, gradients included, and compiled.

The interpreter is chosen when Triton is imported, and it is chosen for the whole process: hence processes of their own.
"""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed (`make test-triton` installs it)")

KERNELS = (
    "accumulate accumulate_backward encode encode_backward march position_gradient project project_backward rasterise "
    "rasterise_backward"
)


def words_of(script: str, **environment: str) -> list[str]:
    """Run a script of this folder; returns the words it prints."""
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, Path(__file__).with_name(script)]
    variables = {**os.environ, "PYTHONPATH": path, **environment}
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.split()


def test_interpreted_kernels_equal_the_reference() -> None:
    checks = ["hash", "composite", "edges", "odd", "march", "lattices", "splats", "projection"]
    assert words_of("triton_parity.py", TRITON_INTERPRET="1") == checks


def test_every_kernel_compiles_for_a_gpu(tmp_path: Path) -> None:
    assert words_of("triton_compilation.py", TRITON_CACHE_DIR=str(tmp_path)) == KERNELS.split()
