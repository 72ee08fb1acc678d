"""A renderer's results: a picture, and a trace of the samples or primitives behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.compositing import over
from invgraphics.core.display import encode_png
from invgraphics.core.samples import FieldValues, Samples


@dataclass(frozen=True, eq=False)
class Rendering:
    """A picture without its background.

    Attributes:
        rgb: colour, premultiplied by alpha, in the scene's colour space.
        alpha: opacity in [0, 1].
        depth: expected distance along the unit ray, Σ w t / Σ w, local units; ``far`` (may be inf) where alpha < 0.5.
        normal: unit, local frame, facing the camera; zero where alpha < 0.5. ``None`` where it was not rendered.
    """

    rgb: Float[Tensor, "*p 3"]
    alpha: Float[Tensor, "*p"]
    depth: Float[Tensor, "*p"]
    normal: Float[Tensor, "*p 3"] | None = None

    def over(self, background: Float[Tensor, 3] | Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
        """The picture in front of ``background``."""
        return over(self.rgb, self.alpha, background)

    def reshape(self, *shape: int) -> Rendering:
        """The same pixels in another arrangement, for instance ``(height, width)``."""
        normal = None if self.normal is None else self.normal.reshape(*shape, 3)
        return Rendering(self.rgb.reshape(*shape, 3), self.alpha.reshape(shape), self.depth.reshape(shape), normal)

    def detach(self) -> Rendering:
        """The same picture outside the graph."""
        normal = None if self.normal is None else self.normal.detach()
        return Rendering(self.rgb.detach(), self.alpha.detach(), self.depth.detach(), normal)

    def to(self, device: torch.device | str) -> Rendering:
        """The same picture on another device."""
        normal = None if self.normal is None else self.normal.to(device)
        return Rendering(self.rgb.to(device), self.alpha.to(device), self.depth.to(device), normal)

    def _repr_png_(self) -> bytes | None:
        """The picture in a notebook, over white, taken as display sRGB; ``None`` for pixels that are no picture."""
        return encode_png(self.over(torch.ones(3, device=self.rgb.device))) if self.rgb.ndim == 3 else None

    @staticmethod
    def cat(parts: Sequence[Rendering]) -> Rendering:
        """Join packed renderings, in order."""
        normals = [part.normal for part in parts if part.normal is not None]
        return Rendering(
            torch.cat([part.rgb for part in parts]),
            torch.cat([part.alpha for part in parts]),
            torch.cat([part.depth for part in parts]),
            torch.cat(normals) if len(normals) == len(parts) and parts else None,
        )


@dataclass(eq=False)
class Screen:
    """Screen-space state of n splatted primitives, for density control and for losses on them.

    Attributes:
        means2d: image positions; after ``backward`` its ``grad`` is the gradient in pixels.
        radii: extent in pixels, 0 where the primitive was culled.
        width: image width in pixels.
        height: image height in pixels.
        absgrad: after ``backward`` its ``grad`` is the sum of absolute gradients over pixels; ``None`` if not wanted.
        opacities: peak opacities in [0, 1].
        scales: standard deviations along the primitives' axes, local units.
    """

    means2d: Float[Tensor, "n 2"]
    radii: Float[Tensor, " n"]
    width: int
    height: int
    absgrad: Float[Tensor, "n 2"] | None = None
    opacities: Float[Tensor, " n"] | None = None
    scales: Float[Tensor, "n 3"] | None = None

    @property
    def gradient(self) -> Float[Tensor, "n 2"] | None:
        """Screen-space gradient ∂L/∂means2d, in loss per pixel; in absolute values where ``absgrad`` is there."""
        return self.means2d.grad if self.absgrad is None else self.absgrad.grad


@dataclass(frozen=True, eq=False)
class SurfaceTrace:
    """How n rays were traced to the surface of a signed distance.

    Attributes:
        logit: of each ray's opacity, ``-sharpness * lowest``, where ``lowest`` is the least signed distance on the ray (IDR,
            equation 7); -inf for rays that miss the bounds. It has gradients where the opacity itself has saturated.
        sharpness: of that opacity, per local length unit.
        hit: whether the ray meets the surface.
        steps: look-ups of the signed distance on the ray before refinement.
        converged: whether the hit was refined to its tolerance, or a ray without one left the bounds within its steps.
    """

    logit: Float[Tensor, " n"]
    sharpness: float
    hit: Bool[Tensor, " n"]
    steps: Int[Tensor, " n"]
    converged: Bool[Tensor, " n"]


@dataclass(frozen=True, eq=False)
class Trace:
    """Samples, weights and screen-space state behind a rendering, for losses and for study; never for scores.

    Attributes:
        samples: the samples of the last level, if the renderer took any.
        values: the field's values there.
        weights: contribution T_i alpha_i of each sample to its ray.
        levels: traces of earlier passes (coarse or proposal), first to last.
        screen: screen-space state of a splatting pass.
        rays: number of rays rendered.
        surface: statistics of sphere tracing.
    """

    samples: Samples | None = None
    values: FieldValues | None = None
    weights: Float[Tensor, " m"] | None = None
    levels: tuple[Trace, ...] = ()
    screen: Screen | None = None
    rays: int = 0
    surface: SurfaceTrace | None = None

    @property
    def empty_samples(self) -> float | None:
        """Share of the samples at which the field's density is zero; ``None`` without samples or densities."""
        density = None if self.values is None else self.values.density
        return None if density is None or not len(density) else float((density == 0).float().mean())


@dataclass(frozen=True, eq=False)
class Context:
    """Settings of one rendering, besides the camera.

    Attributes:
        bounds: the region the field describes.
        training: whether there is randomness (jitter, dropout of detail); evaluation is deterministic.
        progress: how much of the fit's budget is spent, in [0, 1].
        generator: source of randomness; ``None`` uses torch's global one.
        chunk: most samples of one field query.
        geometry: whether normals are rendered (they can cost a gradient).
    """

    bounds: Bounds
    training: bool = False
    progress: float = 1.0
    generator: torch.Generator | None = None
    chunk: int = 1 << 16
    geometry: bool = False

    def rand(self, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """Uniform random numbers in [0, 1) of ``like``'s type, drawn on the generator's device: the same on CPU and GPU."""
        device = like.device if self.generator is None else self.generator.device
        return torch.rand(shape, generator=self.generator, dtype=like.dtype, device=device).to(like.device)
