"""Speed of the kernels and of whole iterations, against the plain reference, the machine's limits and other people's code."""

PARTS = ("splats", "hash", "grid", "march", "composite", "picture", "ssim", "iterations", "threads", "memory", "peers")
"""What can be measured alone; the order in which a run takes them."""

KERNELS = PARTS[: PARTS.index("iterations")]
"""Those that measure one kernel each."""
QUICK = (*KERNELS, "iterations")
"""What a quick run measures unless it is told otherwise."""
