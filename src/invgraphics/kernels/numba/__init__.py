"""Float32 kernels for the CPU, compiled by Numba at first use and cached on disk.

`runtime` holds the compiler settings; the operations are those of `invgraphics.kernels`. Cases without a compiled kernel fall
back to the reference, among them: discs, optimised intrinsics, gradients through `Footprints.depth_planes`, the Jacobian of the
hash encoding, second derivatives of the lattice encoding, fused rendering of hash grids with other than two features per entry,
fused marches of cones, integrals of splats, ordered Gaussians with extra features and gradients, gradients of a density's
positions, pictures narrower than SSIM's window.
"""

from invgraphics.kernels.numba.adam import adam_rows as adam_rows
from invgraphics.kernels.numba.fused.march import lattice_march as lattice_march
from invgraphics.kernels.numba.fused.render import lattice_render as lattice_render
from invgraphics.kernels.numba.gaussians.density import gaussian_density as gaussian_density
from invgraphics.kernels.numba.gaussians.integrate import gaussian_integrals as gaussian_integrals
from invgraphics.kernels.numba.gaussians.ordered import gaussian_composites as gaussian_composites
from invgraphics.kernels.numba.gaussians.pairs import gaussian_pairs as gaussian_pairs
from invgraphics.kernels.numba.hash.encode import hash_encode as hash_encode
from invgraphics.kernels.numba.lattice.encode import lattice_encode as lattice_encode
from invgraphics.kernels.numba.mesh.interpolate import mesh_interpolate as mesh_interpolate
from invgraphics.kernels.numba.mesh.rasterise import mesh_rasterise as mesh_rasterise
from invgraphics.kernels.numba.near import near_points as near_points
from invgraphics.kernels.numba.ngp.distance import sdf_values as sdf_values
from invgraphics.kernels.numba.ngp.march import ngp_march as ngp_march
from invgraphics.kernels.numba.ngp.radiance import sdf_radiance as sdf_radiance
from invgraphics.kernels.numba.ngp.render import ngp_render as ngp_render
from invgraphics.kernels.numba.ngp.skip import sdf_skip as sdf_skip
from invgraphics.kernels.numba.ngp.trace import sdf_trace as sdf_trace
from invgraphics.kernels.numba.rays.composite import composite as composite
from invgraphics.kernels.numba.rays.march import ray_march as ray_march
from invgraphics.kernels.numba.segments import segment_sums as segment_sums
from invgraphics.kernels.numba.splat.binning import splat_bin as splat_bin
from invgraphics.kernels.numba.splat.project import splat_project as splat_project
from invgraphics.kernels.numba.splat.rasterise import splat_median as splat_median
from invgraphics.kernels.numba.splat.rasterise import splat_rasterise as splat_rasterise
from invgraphics.kernels.numba.ssim import ssim as ssim
from invgraphics.kernels.numba.warmup import warm_up as warm_up
