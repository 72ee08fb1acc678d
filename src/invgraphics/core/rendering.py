"""What a renderer gives back: a picture, and a trace of how it was made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core.bounds import Bounds
from invgraphics.core.compositing import over
from invgraphics.core.samples import FieldValues, Samples


@dataclass(frozen=True, eq=False)
class Rendering:
    """A picture without its background.

    Attributes:
        rgb: colour, premultiplied by alpha, in the scene's colour space.
        alpha: opacity in [0, 1].
        depth: expected distance along the unit ray, Σ w t / Σ w, local units; ``far`` (may be inf) where alpha < 0.5.
        normal: unit, local frame, facing the camera; zero where alpha < 0.5. ``None`` where it was not asked for.
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
    """What a splatting pass knows about its n primitives, for density control and for losses on them.

    Attributes:
        means2d: image positions; after ``backward`` its ``grad`` is the gradient in pixels.
        radii: extent in pixels, 0 where the primitive was culled.
        width: image width in pixels.
        height: image height in pixels.
        pull: after ``backward`` its ``grad`` is the sum over pixels of the absolute gradients in pixels, where that was wanted.
        opacities: peak opacities in [0, 1].
        scales: standard deviations along the primitives' axes, local units.
    """

    means2d: Float[Tensor, "n 2"]
    radii: Float[Tensor, " n"]
    width: int
    height: int
    pull: Float[Tensor, "n 2"] | None = None
    opacities: Float[Tensor, " n"] | None = None
    scales: Float[Tensor, "n 3"] | None = None

    @property
    def gradient(self) -> Float[Tensor, "n 2"] | None:
        """What pulls each primitive over the screen, in loss per pixel: of absolute values, if those were wanted."""
        return self.means2d.grad if self.pull is None else self.pull.grad


@dataclass(frozen=True, eq=False)
class Trace:
    """How a picture came about, for losses and for study; never for scores.

    Attributes:
        samples: the samples of the last level, if the renderer took any.
        values: what the field said there.
        weights: contribution T_i alpha_i of each sample to its ray.
        levels: traces of earlier passes (coarse or proposal), first to last.
        screen: what a splatting pass knows about its primitives.
        rays: number of rays rendered.
    """

    samples: Samples | None = None
    values: FieldValues | None = None
    weights: Float[Tensor, " m"] | None = None
    levels: tuple[Trace, ...] = ()
    screen: Screen | None = None
    rays: int = 0


@dataclass(frozen=True, eq=False)
class Context:
    """Circumstances of one rendering.

    Attributes:
        bounds: the region the field describes.
        training: whether randomness (jitter, dropout of detail) is wanted; evaluation is deterministic.
        progress: how much of the fit's budget is spent, in [0, 1].
        generator: source of randomness; ``None`` uses torch's global one.
        chunk: most samples to hand to a field at once.
        geometry: whether normals are wanted (they can cost a gradient).
    """

    bounds: Bounds
    training: bool = False
    progress: float = 1.0
    generator: torch.Generator | None = None
    chunk: int = 1 << 16
    geometry: bool = False
