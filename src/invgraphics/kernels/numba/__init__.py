"""Float32 kernels for the CPU, compiled by Numba at first use and cached on disk."""

from invgraphics.kernels.numba.projecting import splat_project as splat_project
from invgraphics.kernels.numba.binning import splat_bin as splat_bin
from invgraphics.kernels.numba.rasterising import splat_rasterise as splat_rasterise
