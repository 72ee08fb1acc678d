"""Triton's kernels against the plain reference, gradients included, on the CPU through Triton's interpreter.

The interpreter is chosen when Triton is imported, and it is chosen for the whole process: hence a process of its own.
"""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed")

SCRIPT = Path(__file__).with_name("triton_parity.py")


def test_interpreted_kernels_equal_the_reference() -> None:
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run([sys.executable, SCRIPT], env=environment, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split() == ["hash", "composite", "edges", "march", "lattices", "splats", "projection"]
