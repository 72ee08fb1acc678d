"""Modes of a process that fits, or shows what was fitted."""

import subprocess
import sys

import pytest

CONFIGURED = 'configure_torch(torch.device("cpu"))'
OPENED = """
try:
    open_fitted(Path("no-run"))
except InputError:
    pass
"""
CODE = """
from pathlib import Path
import numba, numpy as np, torch
from invgraphics.errors import InputError
from invgraphics.experiments.build import configure_torch
from invgraphics.experiments.fitted import open_fitted

torch.set_num_threads(2)
SETTING

@numba.njit(parallel=True)
def scale(values, by, out):
    for i in numba.prange(len(values)):
        out[i] = values[i] * by

small = np.full(1_000_000, 1e-20, np.float32)
out = np.ones_like(small)
scale(small, np.float32(1e-20), out)
print(int((torch.from_numpy(small) * 1e-20).count_nonzero()), int(np.count_nonzero(out)))
"""


@pytest.mark.parametrize(
    ("setting", "expected"), [(CONFIGURED, "0 0"), (OPENED, "0 0"), ("", "1000000 1000000")], ids=["fits", "opens", "neither"]
)
def test_denormal_products_are_zero_on_all_threads_of_a_process_that_fits_or_opens_a_run(setting, expected):
    """Of torch's pool and of Numba's; without the setting 1e-40 is a number."""
    code = CODE.replace("SETTING", setting)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == expected
