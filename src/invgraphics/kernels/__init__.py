"""The hot operations of hash grids, ray marching, volume rendering and splatting; `dispatch` chooses the implementation.

``reference`` is plain torch, any dtype, meant to be read; it is the oracle of the others. ``numba`` is float32 on the CPU,
``cuda`` float32 on NVIDIA GPUs. All are differentiable where their docstring says so; ``reference`` and ``numba`` are
deterministic for a given number of threads, ``cuda`` accumulates some gradients atomically, in no fixed order.
"""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics.core import ngp
from invgraphics.core.bounds import Bounds
from invgraphics.core.camera import Camera
from invgraphics.core.field import Gaussians
from invgraphics.core.rays import Rays
from invgraphics.kernels import checks, types
from invgraphics.kernels.dispatch import choose
from invgraphics.kernels.dispatch import compiled as compiled
from invgraphics.kernels.dispatch import in_use as in_use
from invgraphics.kernels.dispatch import use as use
from invgraphics.kernels.dispatch import using as using
from invgraphics.kernels.dispatch import warm_up as warm_up
from invgraphics.kernels.lattices import lattice_encode as lattice_encode
from invgraphics.kernels.lattices import lattice_march as lattice_march
from invgraphics.kernels.lattices import lattice_render as lattice_render
from invgraphics.kernels.meshes import mesh_interpolate as mesh_interpolate
from invgraphics.kernels.meshes import mesh_rasterise as mesh_rasterise
from invgraphics.kernels.tracing import sdf_radiance as sdf_radiance
from invgraphics.kernels.tracing import sdf_skip as sdf_skip
from invgraphics.kernels.tracing import sdf_trace as sdf_trace
from invgraphics.kernels.tracing import sdf_values as sdf_values


def hash_encode(
    unit: Float[Tensor, "m 3"], table: Float[Tensor, "entries f"], grid: ngp.HashGrid, jacobian: bool = False
) -> tuple[Float[Tensor, "m width"], Float[Tensor, "m width 3"] | None]:
    """Multi-resolution hash encoding (Instant-NGP, §3): trilinear look-ups on every level, concatenated coarse to fine.

    Args:
        unit: positions in [0, 1]; those outside are clamped.
        table: features of all levels, `HashGrid.entries` rows.
        grid: geometry of the levels.
        jacobian: whether to return d features / d unit as well.

    Returns:
        Features (m, levels * f), differentiable twice in ``table`` and ``unit``; and the Jacobian, differentiable in ``table``.

    Raises:
        ValueError: positions that are no (m, 3), or a table of another number of entries.
    """
    checks.check_columns(3, unit=unit)
    checks.check_table(table, grid)
    return choose("hash_encode", unit, table)(unit, table, grid, jacobian)


def adam_rows(
    values: Float[Tensor, "*rows c"],
    gradient: Float[Tensor, "*rows c"] | Float[Tensor, "k c"],
    moments: tuple[Float[Tensor, "*rows c"], Float[Tensor, "*rows c"]],
    step: types.AdamStep,
    rates: Float[Tensor, "*rows"] | None = None,
    rows: Int[Tensor, " k"] | None = None,
) -> None:
    """Adam step in place, on the entries with a gradient only (masked Adam of DVGO, Sun et al. 2022, `lib/cuda/adam_upd`).

    With m and v the moments after their update, values -= lr sqrt(1 - beta2^k) / (1 - beta1^k) m / (sqrt(v) + eps). Entries
    whose gradient is exactly 0 keep value and moments, which are not decayed later either; k counts all steps, not the entry's
    own. Unlike torch's Adam, eps is not divided by sqrt(1 - beta2^k).

    Args:
        values: what is updated; rows of c.
        gradient: of the same shape, or of the ``rows`` alone.
        moments: first and second moment, updated too.
        step: settings, number of the step, and whether zeros are skipped.
        rates: factor of the learning rate of each row, for instance its share of the most views that see a voxel (DVGO,
            §4.2); ``None`` for 1.
        rows: which rows ``gradient`` has, each once, int64, in the order of memory; all others keep value and moments.
            ``None`` for all.
    """
    checks.check_adam(values, gradient, moments, rates, rows)
    choose("adam_rows", values, gradient, *moments)(values, gradient, moments, step, rates, rows)


def ray_march(
    rays: Rays, occupied: Bool[Tensor, "r r r"], bounds: Bounds, steps: types.MarchSteps, start: Float[Tensor, " n"]
) -> types.March:
    """Occupancy-grid ray marching: the intervals whose midpoint lies in an occupied cell of the unit cube.

    Args:
        rays: with near and far set; marching ends at far.
        occupied: cells of the unit cube (see `Bounds.to_unit`), indexed [x, y, z].
        bounds: the region's map to the unit cube.
        steps: step lengths and the most samples to keep per ray.
        start: distance at which each ray begins or resumes (``resume`` of an earlier march).

    Returns:
        Packed intervals, sorted by ray and distance. Not differentiable.
    """
    checks.check_cube(occupied)
    return choose("ray_march", *checks.checked_rays(rays, start))(rays, occupied, bounds, steps, start)


def ngp_march(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: types.MarchSteps,
    field: ngp.FusedNGP,
    start: Float[Tensor, " n"],
    min_transmittance: float,
) -> types.March:
    """`ray_march` with early ray termination: densities of the field are evaluated and composited inside the march.

    Args:
        rays: with near and far set.
        occupied: as in `ray_march`.
        bounds: as in `ray_march`.
        steps: step lengths; ``limit`` is ignored.
        field: density to march through; its colours are not evaluated.
        start: distance at which each ray begins.
        min_transmittance: intervals before which the transmittance is below this are left out.

    Returns:
        Packed intervals, sorted by ray and distance. Not differentiable.
    """
    checks.check_cube(occupied)
    checks.check_table(field.table, field.grid)
    return choose("ngp_march", *checks.checked_rays(rays, start), field.table)(
        rays, occupied, bounds, steps, field, start, min_transmittance
    )


def ngp_render(
    rays: Rays,
    occupied: Bool[Tensor, "r r r"],
    bounds: Bounds,
    steps: types.MarchSteps,
    field: ngp.FusedNGP,
    min_transmittance: float = 0.0,
    max_error: float = 0.0,
    width: int = 0,
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, " n"]]:
    """Fused volume rendering of an Instant-NGP field: march, encode, evaluate, composite. Not differentiable.

    Args:
        rays: with near and far set.
        occupied: cells of the unit cube in which the field is evaluated, as in `ray_march`.
        bounds: the region's map to the unit cube.
        steps: step lengths.
        field: parameters of the hash grid and its networks.
        min_transmittance: a ray may terminate once its transmittance is below this.
        max_error: upper bound, per ray, of the summed weights of samples whose colour is not evaluated, in [0, 1].
        width: width in pixels of the image whose pixels the rays are, row by row; 0 if they are none. It only orders the work:
            rays of neighbouring pixels share cells, which is faster.

    Returns:
        Sums of w * (radiance, distance), and of w, per ray (see `composite`).
    """
    checks.check_cube(occupied)
    checks.check_table(field.table, field.grid)
    render = choose("ngp_render", *checks.checked_rays(rays), field.table)
    return render(rays, occupied, bounds, steps, field, min_transmittance, max_error, width)


def composite(
    optical_depth: Float[Tensor, " m"], channels: Float[Tensor, "m c"], ray: Int[Tensor, " m"], rays: int
) -> tuple[Float[Tensor, " m"], Float[Tensor, "n c"], Float[Tensor, " n"]]:
    """Emission-absorption along packed rays: alpha_i = 1 - exp(-tau_i), T_i = exp(-sum_{j<i} tau_j), w_i = T_i alpha_i.

    Args:
        optical_depth: tau_i = sigma_i * length, >= 0; sorted by ray, then distance.
        channels: what to sum along each ray.
        ray: ray index of each sample, non-decreasing.
        rays: number of rays.

    Returns:
        Weights w_i; sums over each ray of w_i * channels_i; alpha = sum of w_i. Differentiable in the first two arguments.

    Raises:
        ValueError: rows of channels or ray indices that are not as many as optical depths.
    """
    checks.check_rows("samples", len(optical_depth), channels=channels, ray=ray)
    return choose("composite", optical_depth, channels)(optical_depth, channels, ray, rays)


def splat_project(
    gaussians: Gaussians, camera: Camera, dilation: float = 0.3, antialiased: bool = False
) -> tuple[types.Footprints, Float[Tensor, "n 3"]]:
    """EWA projection of 3D Gaussians (Zwicker et al. 2001; 3DGS §4) and their colours towards the camera.

    Args:
        gaussians: activated primitives.
        camera: pinhole camera, differentiable in its pose.
        dilation: variance in square pixels added to both screen axes (low-pass filter).
        antialiased: opacity compensation: the filter keeps a footprint's integral, not its peak (Mip-Splatting, §5.2).

    Returns:
        Conic footprints, culled where what is opaquer than 1/255 misses the frustum; and rgb = max(0, SH(direction) + 0.5).
    """
    checks.check_gaussians(gaussians)
    return choose("splat_project", *vars(gaussians).values())(gaussians, camera, dilation, antialiased)


def splat_project_discs(
    gaussians: Gaussians, camera: Camera, dilation: float = 0.5
) -> tuple[types.Footprints, Float[Tensor, "n 3"]]:
    """Flat discs instead of ellipsoids (2DGS, Huang et al. 2024, §4.2): each is spanned by its first two axes.

    Args:
        gaussians: activated primitives; the third axis is the normal, and its scale is ignored.
        camera: pinhole camera, differentiable in its pose.
        dilation: variance in square pixels of the smallest footprint (2DGS uses 0.5).

    Returns:
        Disc footprints, whose response is taken where a pixel's ray meets the disc; and colours as in `splat_project`.
    """
    checks.check_gaussians(gaussians)
    return choose("splat_project_discs", *vars(gaussians).values())(gaussians, camera, dilation)


def splat_bin(footprints: types.Footprints, width: int, height: int, tile: int) -> types.Bins:
    """Tile intersection and depth sort: per tile, front to back, the footprints whose square overlaps it. No gradient."""
    return choose("splat_bin", *vars(footprints).values())(footprints, width, height, tile)


def splat_rasterise(
    footprints: types.Footprints,
    features: Float[Tensor, "n c"],
    width: int,
    height: int,
    tile: int | None = None,
    max_grad_splats: int = 0,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Front-to-back alpha compositing of footprints at pixel centres (3DGS, appendix C).

    alpha = min(0.99, response), skipped below 1/255; a pixel stops before its transmittance falls below 1e-4.

    Args:
        footprints: conics, or discs where ``homography`` is set.
        features: what to sum, per footprint (colour, depth coefficients, normals), at least one channel.
        width: image width in pixels.
        height: image height in pixels.
        tile: edge of a tile in pixels (Numba: in fours, 32 at most); ``None`` for the implementation's own.
        max_grad_splats: number of footprints of each pixel, counted from the front, that receive gradients; 0 for all.

    Returns:
        Sums of w * features and of w per pixel, differentiable in means2d, conics (or homography), opacities and features.

    Raises:
        ValueError: there are no channels.
    """
    if not features.shape[1]:
        raise ValueError("Features need at least one channel.")
    checks.check_rows("footprints", len(footprints), features=features)
    rasterise = choose("splat_rasterise", *vars(footprints).values(), features)
    return rasterise(footprints, features, width, height, tile, max_grad_splats)


def splat_median(footprints: types.Footprints, width: int, height: int, tile: int | None = None) -> Float[Tensor, "h w"]:
    """Median depth: distance along each pixel's ray of the footprint where transmittance falls to 1/2; inf where it does not.

    Not differentiable. Arguments as in `splat_rasterise`.
    """
    return choose("splat_median", *vars(footprints).values())(footprints, width, height, tile)


def ssim(image: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Mean SSIM, differentiable (Wang et al. 2004; 11x11 Gaussian window, sigma 1.5, zero-padded as in 3DGS).

    Values in [0, 1] are assumed (data range 1). Differentiable in ``image``.

    Raises:
        ValueError: images of two shapes.
    """
    if image.ndim != 3 or image.shape != target.shape:
        raise ValueError(f"Images have one shape (h, w, c), not {tuple(image.shape)} and {tuple(target.shape)}.")
    return choose("ssim", image, target)(image, target)
