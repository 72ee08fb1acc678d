"""Machine code comes from the cache on disk, also in the process that found it empty: first runs repeat bit by bit."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from invgraphics.kernels.numba import runtime

BITS = """
import hashlib, torch
from dataclasses import replace
from invgraphics import kernels
from invgraphics.bench.sample_cases import random_ngp, some_rays
from invgraphics.bench.workload import activated, bounds, camera, gaussian_field, leaves, occupied
from invgraphics.kernels.types import MarchSteps

def bits(*tensors):
    return hashlib.sha256(b"".join(tensor.detach().numpy().tobytes() for tensor in tensors)).hexdigest()

torch.manual_seed(0)
table, unit = torch.rand(8, 8, 8, 3).requires_grad_(), torch.rand(5000, 3)
values = kernels.grid_sample(unit, table)
print(bits(values, *torch.autograd.grad(values.square().sum(), table)))
rays = some_rays(500)
call = rays, occupied(64), bounds(), MarchSteps(0.02), random_ngp()
march = kernels.ngp_march(*call, rays.near, 0.01)
print(bits(*kernels.ngp_render(*call)), bits(march.t0, march.t1))
gaussians, viewpoint = activated(gaussian_field(3000)), camera(100)
footprints, rgb = kernels.splat_project(gaussians, viewpoint)
print(bits(kernels.splat_median(footprints, 100, 100)))
for absgrad in (None, torch.zeros(3000, 2, requires_grad=True)):
    for max_grad_splats in (0, 5):
        pulled = replace(footprints, absgrad=absgrad)
        image, alpha = kernels.splat_rasterise(pulled, rgb, 100, 100, max_grad_splats=max_grad_splats)
        wanted = [*leaves(gaussians), *([] if absgrad is None else [absgrad])]
        loss = image.square().sum() + alpha.sum()
        print(bits(image, alpha, *torch.autograd.grad(loss, wanted, retain_graph=True)))
"""

ALONE = """
import subprocess
import numpy as np
from invgraphics.kernels.numba import runtime

def refuse(*arguments, **options):
    raise PermissionError("no second process here")

subprocess.Popen = refuse
first = np.empty(3, np.int64)
runtime.split_by_work(np.array([5, 1, 1, 3]), 2, first)
print(*first)
"""


def run(code: str, cache: Path, *, cold: bool) -> list[str]:
    """What a process of its own prints."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", code]
    process = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=400, check=False)
    assert process.returncode == 0, process.stderr[-3000:]
    assert ("compiling kernels" in process.stderr) == cold
    return process.stdout.split()


def test_the_processes_that_fill_the_cache_find_their_functions() -> None:
    module = import_module(runtime.WARMUP)
    assert all(callable(getattr(module, part)) for part in runtime.PARTS)


def test_kernels_are_compiled_here_where_no_other_process_can(tmp_path: Path) -> None:
    assert run(ALONE, tmp_path, cold=True) == ["0", "2", "4"]
    assert run(ALONE, tmp_path, cold=False) == ["0", "2", "4"]


def test_machine_code_is_that_of_all_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba itself looks at the kernel's own file only: what was inlined into it from others stayed as it had been."""
    module = tmp_path / "doubling.py"
    module.write_text("from invgraphics.kernels.numba import runtime\n\n@runtime.serial\ndef double(x):\n    return 2 * x\n")
    monkeypatch.syspath_prepend(tmp_path)
    loaded = []
    for sources in ("before", "before", "after", "after"):
        monkeypatch.setattr(runtime, "SOURCES", sources)
        sys.modules.pop("doubling", None)
        kernel = import_module("doubling").double
        assert kernel(21) == 42
        loaded.append(sum(kernel.stats.cache_hits.values()))
    assert loaded == [0, 1, 0, 1]


def test_the_digest_of_sources_sees_every_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = "numba/runtime.py", "numba/splat/raster.py", "reference/splat_raster.py", "types.py"
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x = 1\n")
    monkeypatch.setattr(runtime, "__file__", str(tmp_path / names[0]))
    seen = {runtime.source_digest()}
    # Constants of references and types are compiled into kernels as well.
    for name in names:
        (tmp_path / name).write_text("x = 2\n")
        seen.add(runtime.source_digest())
    assert len(seen) == 1 + len(names)


def test_without_a_compiler_the_reference_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    code = "from invgraphics.kernels import dispatch; print(dispatch.in_use(), dispatch.unavailable_reason('numba'))"
    words = run(code, tmp_path, cold=False)
    assert (words[0], words[2]) == ("reference", "NUMBA_DISABLE_JIT")


@pytest.mark.slow
def test_the_first_run_has_the_bits_of_the_second(tmp_path: Path) -> None:
    first = run(BITS, tmp_path, cold=True)
    assert len(first) == 8
    assert run(BITS, tmp_path, cold=False) == first
