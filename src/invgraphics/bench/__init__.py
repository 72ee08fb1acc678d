"""Benchmarks of kernels and training steps against the reference, the machine's limits and third-party implementations."""

PARTS = (
    "splats", "hash", "lattice", "march", "composite", "picture", "trace", "mesh", "near", "ssim",
    "iterations", "threads", "memory", "peers",
)  # fmt: skip
"""Parts of the benchmark, in the order in which they run."""

KERNELS = PARTS[: PARTS.index("iterations")]
"""Parts that measure one kernel each."""
QUICK = (*KERNELS, "iterations")
"""Default parts of a quick run."""
