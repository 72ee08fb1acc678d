"""Float32 kernels for NVIDIA GPUs: Triton for packed samples, gsplat (where it is installed) for splats.

What is not here runs on the reference, whose plain torch works on any device. Gradients of hash tables are summed by atomic
additions, whose order the GPU decides: repeating a run gives close, not equal, bits.
"""

from importlib.util import find_spec

from invgraphics.kernels.cuda.composite import composite as composite
from invgraphics.kernels.cuda.hash import hash_encode as hash_encode

if find_spec("gsplat") is not None:
    from invgraphics.kernels.cuda.splats import splat_rasterise as splat_rasterise
