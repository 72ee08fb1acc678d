"""Numba microbenchmarks of exp2 throughput and of gather rate; imported only where Numba works."""

from __future__ import annotations

import numpy as np

from invgraphics.kernels.numba.runtime import exp2, index, job_start, parallel, prange

_ONE = np.float32(1.0)


@parallel
def exp2_passes(values, passes):
    """``passes`` times x <- 2^x - 1 in each job's row of ``values`` (which stays in the L1 cache; 0 is a fixed point)."""
    for job in prange(len(values)):
        row = values[job]
        for _ in range(passes):
            for number in range(len(row)):
                i = index(number)
                row[i] = exp2(row[i]) - _ONE


@parallel
def gather_sum(table, indices, jobs, sums):
    """Gather and sum the entries of ``table`` at ``indices``, which are split evenly among jobs; one sum per job."""
    for job in prange(jobs):
        total = np.int64(0)
        for number in range(job_start(len(indices), jobs, job), job_start(len(indices), jobs, job + 1)):
            total += table[index(indices[index(number)])]
        sums[job] = total
