"""Float32 kernels for NVIDIA GPUs: Triton for packed samples, gsplat (where it is installed) for splats.

Other operations fall back to the reference, which runs on any device. Gradients of hash tables are accumulated atomically, in
no fixed order: repeated runs agree to rounding, not bitwise.
"""

from importlib.util import find_spec

from invgraphics.kernels.cuda.composite import composite as composite
from invgraphics.kernels.cuda.hash import hash_encode as hash_encode

if find_spec("gsplat") is not None:
    from invgraphics.kernels.cuda.splats import splat_rasterise as splat_rasterise
