"""Cost measurements against work whose cost is known."""

import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
import torch
from torch import nn

from invgraphics import memory
from invgraphics.metrics import cost

MB = 1 << 20


def test_peak_memory_sees_what_was_freed_again() -> None:
    # In a process of its own: what earlier tests leave to be freed would hide the block.
    lines = [
        "import time, numpy as np",
        "from invgraphics import memory as memory_of; from invgraphics.metrics import cost",
        "with cost.PeakMemory() as memory:",
        f"    block = np.ones({96 * MB}, dtype=np.uint8)  # ones, so that the pages are really touched",
        "    time.sleep(SLEEP)",
        "    del block",
        "print(memory.peak_bytes)",
    ]

    def peak(setup: str, sleep: float) -> int:
        code = "\n".join([lines[0], lines[1], setup, *lines[2:]]).replace("SLEEP", str(sleep))
        return int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)

    sampled = "from pathlib import Path; memory_of.CLEAR = Path('absent/clear_refs')"
    assert 90 * MB < peak(sampled, 4 * cost.SAMPLING_SECONDS) < 130 * MB
    if memory.CLEAR.exists():
        # However short, where the kernel keeps the record.
        assert 90 * MB < peak("cost.SAMPLING_SECONDS = 60", 0.0) < 130 * MB


def test_peak_memory_excludes_a_nested_block() -> None:
    code = """
        import torch
        from invgraphics.kernels.allocator import keep_freed_memory
        from invgraphics.metrics import cost
        keep_freed_memory()
        with cost.PeakMemory() as memory:
            with memory.excluding():
                block = torch.ones(96 << 20, dtype=torch.uint8)
                del block
            before = memory.peak_bytes
            block = torch.ones(32 << 20, dtype=torch.uint8)
            del block
        print(before, memory.peak_bytes)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    before, peak = map(int, done.stdout.split())
    assert before < 20 * MB < 30 * MB < peak < 60 * MB


def test_peak_memory_counts_room_that_was_freed_before() -> None:
    code = """
        import torch
        from invgraphics.kernels.allocator import keep_freed_memory
        from invgraphics.metrics import cost
        keep_freed_memory()
        block = torch.ones(96 << 20, dtype=torch.uint8)
        del block
        with cost.PeakMemory() as memory:
            block = torch.ones(64 << 20, dtype=torch.uint8)
        print(memory.peak_bytes)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    assert 60 * MB < int(done.stdout) < 80 * MB


def test_peak_memory_leaves_out_what_was_there_before() -> None:
    block = np.ones(96 * MB, dtype=np.uint8)
    with cost.PeakMemory() as memory:
        time.sleep(2 * cost.SAMPLING_SECONDS)
    assert memory.peak_bytes < 16 * MB < block.nbytes


def test_peak_memory_counts_what_an_earlier_process_needed() -> None:
    with cost.PeakMemory() as peak:
        peak.include(10**12)
        peak.include(10**9)
        assert peak.peak_bytes == 10**12
        with peak.excluding():
            pass
    assert peak.peak_bytes == 10**12


def test_memory_without_proc(monkeypatch, tmp_path) -> None:
    now = memory.resident_bytes()
    monkeypatch.setattr(memory, "STATM", tmp_path / "absent")
    assert memory.resident_bytes() >= now * 0.9 > 10 * MB


def test_sizes_count_shared_tensors_once_and_buffers_as_bytes() -> None:
    a, b = nn.Linear(3, 5), nn.BatchNorm1d(5)
    b.weight.requires_grad_(False)
    shared = nn.Linear(3, 5)
    shared.weight = a.weight
    modules = [a, b, shared]
    assert cost.parameter_count(modules) == 15 + 5 + 5 + 5  # weight once, two biases, the norm's bias
    # the norm's frozen weight and its running mean, variance (float32) and counter (int64) are stored as well
    assert cost.model_bytes(modules) == 4 * (30 + 5) + 4 * 10 + 8


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_peak_memory_on_cuda() -> None:
    with cost.PeakMemory("cuda") as memory:
        block = torch.ones(64 * MB, dtype=torch.uint8, device="cuda")
        del block
    assert memory.peak_bytes == pytest.approx(64 * MB, rel=0.05)
