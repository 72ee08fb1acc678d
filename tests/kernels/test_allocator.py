"""Freed memory is kept: counted in page faults, by the operating system."""

import platform
import subprocess
import sys
from textwrap import dedent

import pytest

from invgraphics.kernels.allocator import keep_freed_memory

COUNT = dedent("""
    import resource
    import torch
    from invgraphics.kernels.allocator import keep_freed_memory

    faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for setting in (lambda: None, keep_freed_memory):
        assert setting() in (None, True)
        for repetition in range(12):
            before = faults()
            torch.ones(64 * 2**18)
            last = faults() - before
        print(last)
""")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are left alone")
def test_large_blocks_are_used_again() -> None:
    """Page faults of writing 64 MB for the twelfth time, in a process of its own; at first, gaps may be too narrow."""
    done = subprocess.run([sys.executable, "-c", COUNT], capture_output=True, text=True, check=True)
    returned, kept = map(int, done.stdout.split())
    assert kept <= max(returned / 50, 4)


def test_where_there_is_nothing_to_set_it_says_no(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ctypes.CDLL", lambda name: object())
    assert not keep_freed_memory()


@pytest.mark.parametrize(("largest", "expected"), [(2**30, [(-3, 2**30), (-1, 2**31 - 1)]),
                                                   (2**25, [(-3, 2**30), (-3, 2**25), (-1, 2**31 - 1)]),
                                                   (2**24, [(-3, 2**30), (-3, 2**25)])])  # fmt: skip
def test_the_largest_blocks_that_are_accepted_are_kept(
    monkeypatch: pytest.MonkeyPatch, largest: int, expected: list[tuple[int, int]]
) -> None:
    """Where none are, nothing is set: a trim threshold alone would end the automatic choice of both."""
    calls: list[tuple[int, int]] = []

    class Library:
        @staticmethod
        def mallopt(setting: int, value: int) -> int:
            calls.append((setting, value))
            return int(setting != -3 or value <= largest)

    monkeypatch.setattr("ctypes.CDLL", lambda name: Library())
    assert keep_freed_memory() == (largest > 2**24)
    assert calls == expected
