"""Inputs and outputs of the kernels: marches, footprints and tile lists as flat tensors."""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class MarchSteps:
    """Step sizes of a ray march: dt = ``max(step, cone * t)``, or uniform dt of length ``step`` in contracted space.

    Attributes:
        step: shortest step, local units.
        cone: cone angle, growth of the step with distance (0 for bounded scenes, 1/256 in Instant-NGP's unbounded ones).
        limit: maximum number of samples per ray in one march.
        contracted: uniform steps in contracted space (see `kernels.reference.march.step_lengths`); ``cone`` must be 0.
    """

    step: float
    cone: float = 0.0
    limit: int = 1024
    contracted: bool = False


@dataclass(frozen=True, eq=False)
class March:
    """Sample intervals on n rays, packed by ray then distance, and the distance at which each march can resume.

    Attributes:
        ray: ray index of each sample.
        t0: interval starts.
        t1: interval ends.
        resume: distance at which marching continues; ``>= far`` on finished rays.
    """

    ray: Int[Tensor, " m"]
    t0: Float[Tensor, " m"]
    t1: Float[Tensor, " m"]
    resume: Float[Tensor, " n"]


@dataclass(frozen=True, eq=False)
class Footprints:
    """n Gaussians or discs projected to the image plane.

    A footprint's response at pixel p is ``opacity * exp(-0.5 q)``. For conics ``q = d^T C d`` with ``d = p - mean``; for flat
    discs ``q = u² + v²`` with ``(u, v) = (a, b) / c`` and ``(a, b, c) = H (x, y, 1)``, where ``homography`` is H, scaled so
    that c > 0 in front of the camera.

    Attributes:
        means2d: centres in pixels.
        conics: inverse 2D covariances (C_xx, C_xy, C_yy), per square pixel.
        opacities: peak alpha, in [0, 1].
        depths: sort key, depth of the centre along the optical axis.
        depth_planes: distance along the pixel's unit ray of the maximal response, to first order:
            ``t(p) = plane[0] + plane[1] (x - mean_x) + plane[2] (y - mean_y)``.
        radii: half-width in pixels of the square outside which the response is below the smallest visible alpha;
            0 for culled primitives.
        homography: pixel to disc coordinates, where the footprints are discs.
        blur: variance in square pixels of a Gaussian around the centre below which a disc's response never falls (low-pass
            filter, 2DGS §4.2); ``None`` for no filter.
        absgrad: zeros, whose gradient after ``backward`` is the sum over pixels of |dL/d(means2d)| (AbsGS, Ye et al. 2024);
            ``None`` where it is not wanted. Conics only.
    """

    means2d: Float[Tensor, "n 2"]
    conics: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]
    depths: Float[Tensor, " n"]
    depth_planes: Float[Tensor, "n 3"]
    radii: Float[Tensor, " n"]
    homography: Float[Tensor, "n 3 3"] | None = None
    blur: Float[Tensor, " n"] | None = None
    absgrad: Float[Tensor, "n 2"] | None = None

    def __len__(self) -> int:
        return len(self.means2d)


@dataclass(frozen=True, eq=False)
class Bins:
    """Tile intersections: the footprints that overlap each tile, front to back.

    Attributes:
        splats: footprint indices, tile after tile (row by row), each tile sorted by depth (ties by index).
        starts: first entry of each tile, and the total at the end.
        tile: edge of a tile in pixels.
        columns: tiles per row.
        rows: tiles per column.
    """

    splats: Int[Tensor, " k"]
    starts: Int[Tensor, " tiles_plus_1"]
    tile: int
    columns: int
    rows: int


EXP_LIMIT = 15.0
"""Raw density at which an exponential density is clamped (Instant-NGP's source clips its derivative there)."""
ALPHA_MIN = 1 / 255
"""Responses below this are skipped (3DGS, appendix C)."""
ALPHA_MAX = 0.99
"""Alpha is clamped here for numerical stability (3DGS, appendix C)."""
COMPENSATION_MIN = 0.005
"""Lower bound of the low-pass filter's opacity compensation (3DGS's anti-aliased rasteriser; Mip-Splatting's is 0.001)."""
TRANSMITTANCE_MIN = 1e-4
"""Compositing of a pixel stops before transmittance falls below this (3DGS, appendix C)."""


@dataclass(frozen=True)
class AdamStep:
    """Settings of one Adam step (Kingma and Ba 2015).

    Attributes:
        lr: learning rate.
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        eps: added to the root of the second moment.
        number: steps so far, this one included; the bias correction's exponent.
        skip_zero: leave entries whose gradient is exactly 0 as they are, moments included.
    """

    lr: float
    beta1: float
    beta2: float
    eps: float
    number: int
    skip_zero: bool = True

    @property
    def size(self) -> float:
        """Learning rate times both bias corrections."""
        return self.lr * math.sqrt(1 - self.beta2**self.number) / (1 - self.beta1**self.number)


@dataclass(frozen=True)
class TracingLimits:
    """When rays stop, in local length units.

    Attributes:
        steps: most look-ups of a ray while it marches.
        relaxation: factor of a step over the distance, in (0, 2); above 1 it is over-relaxed (Keinert et al. 2014).
        refinements: most look-ups of a ray afterwards, in the bracket of its hit or of its closest approach.
        least: shortest step; surfaces closer together than this along a ray may be missed.
        tolerance: a hit is refined until the distance there is at most this.
        depth: a ray ends where it is this deep inside.
    """

    steps: int
    relaxation: float
    refinements: int
    least: float
    tolerance: float
    depth: float


@dataclass(frozen=True, eq=False)
class TracedRays:
    """Where n rays met a surface, or came closest to it.

    Attributes:
        hit: whether the distance changes its sign, or is negative from the start.
        hit_t: distance along the ray of the first such place; ``far`` without one.
        low_t: distance along the ray of the least signed distance.
        low: that signed distance; infinite for rays without an interval.
        steps: look-ups of each ray, refinements left out.
        converged: whether the hit was refined to the tolerance, or a ray without one has left the bounds within its steps.
    """

    hit: Bool[Tensor, " n"]
    hit_t: Float[Tensor, " n"]
    low_t: Float[Tensor, " n"]
    low: Float[Tensor, " n"]
    steps: Int[Tensor, " n"]
    converged: Bool[Tensor, " n"]


@dataclass(frozen=True, eq=False)
class Fragments:
    """The nearest triangle at each pixel's centre.

    Attributes:
        face: its index, -1 where there is none.
        barycentric: weights of its corners at the hit in space (perspective-correct), sum 1; zero where there is none.
        depth: distance of the hit along the pixel's unit ray, inf where there is none.
    """

    face: Int[Tensor, "h w"]
    barycentric: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]
