"""Float32 kernels for NVIDIA GPUs, in Triton, which is part of every CUDA build of torch for Linux: nothing else to install.

Other operations fall back to the reference, which runs on any device. Gradients of hash tables, lattices and splats are
accumulated atomically, in no fixed order: repeated runs agree to rounding, not bitwise.

Numbers that change from step to step (of points, rows, pixels) are in ``do_not_specialize``: Triton would compile a kernel
again where they become divisible by 16, on the clock of a fit.
"""

from invgraphics.kernels.cuda.composite import composite as composite
from invgraphics.kernels.cuda.hash import hash_encode as hash_encode
from invgraphics.kernels.cuda.lattice import lattice_encode as lattice_encode
from invgraphics.kernels.cuda.march import ray_march as ray_march
from invgraphics.kernels.cuda.project import splat_project as splat_project
from invgraphics.kernels.cuda.raster import splat_rasterise as splat_rasterise
