"""Every kernel in plain torch, meant to be read; the oracle of the fast ones."""

from invgraphics.kernels.reference.adam import adam_rows as adam_rows
from invgraphics.kernels.reference.composite import composite as composite
from invgraphics.kernels.reference.fused import lattice_march as lattice_march
from invgraphics.kernels.reference.fused import lattice_render as lattice_render
from invgraphics.kernels.reference.gaussian_order import gaussian_composites as gaussian_composites
from invgraphics.kernels.reference.gaussian_quadrature import gaussian_integrals as gaussian_integrals
from invgraphics.kernels.reference.gaussian_rays import gaussian_pairs as gaussian_pairs
from invgraphics.kernels.reference.gaussian_sums import gaussian_density as gaussian_density
from invgraphics.kernels.reference.hash import hash_encode as hash_encode
from invgraphics.kernels.reference.lattice import lattice_encode as lattice_encode
from invgraphics.kernels.reference.march import ray_march as ray_march
from invgraphics.kernels.reference.mesh import mesh_interpolate as mesh_interpolate
from invgraphics.kernels.reference.mesh import mesh_rasterise as mesh_rasterise
from invgraphics.kernels.reference.near import near_points as near_points
from invgraphics.kernels.reference.ngp import ngp_march as ngp_march
from invgraphics.kernels.reference.ngp import ngp_render as ngp_render
from invgraphics.kernels.reference.segments import segment_sums as segment_sums
from invgraphics.kernels.reference.splat_discs import splat_project_discs as splat_project_discs
from invgraphics.kernels.reference.splat_project import splat_project as splat_project
from invgraphics.kernels.reference.splat_raster import splat_bin as splat_bin
from invgraphics.kernels.reference.splat_raster import splat_median as splat_median
from invgraphics.kernels.reference.splat_raster import splat_rasterise as splat_rasterise
from invgraphics.kernels.reference.ssim import ssim as ssim
from invgraphics.kernels.reference.tracing import sdf_trace as sdf_trace
from invgraphics.kernels.reference.tracing import sdf_values as sdf_values
