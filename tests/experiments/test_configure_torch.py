"""Modes of a process that fits."""

import subprocess
import sys

import pytest

CODE = """
import numba, numpy as np, torch
from invgraphics.experiments.build import configure_torch

torch.set_num_threads(2)
configure_torch(torch.device("cpu"))

@numba.njit(parallel=True)
def scale(values, by, out):
    for i in numba.prange(len(values)):
        out[i] = values[i] * by

small = np.full(1_000_000, 1e-20, np.float32)
out = np.ones_like(small)
scale(small, np.float32(1e-20), out)
print(int((torch.from_numpy(small) * 1e-20).count_nonzero()), int(np.count_nonzero(out)))
"""


@pytest.mark.parametrize(("configured", "expected"), [(True, "0 0"), (False, "1000000 1000000")])
def test_denormal_products_are_zero_on_all_threads_of_a_fit(configured, expected):
    """Of torch's pool and of Numba's; without the setting 1e-40 is a number."""
    code = CODE if configured else CODE.replace('configure_torch(torch.device("cpu"))', "")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == expected
