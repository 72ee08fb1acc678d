"""The doors of the table: what a field offers, what a renderer needs, and the check that they fit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Flag, auto
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from invgraphics.core.camera import Camera
from invgraphics.core.rays import Rays
from invgraphics.core.rendering import Context, Rendering, Trace
from invgraphics.core.samples import FieldValues, Samples
from invgraphics.errors import NotComposableError


class Quantity(Flag):
    """What a field can be asked for. Pointwise quantities come from `Field.query`, the others from `Field.primitives`."""

    NONE = 0
    DENSITY = auto()
    SDF = auto()
    RADIANCE = auto()
    NORMAL = auto()
    FEATURES = auto()
    GAUSSIANS = auto()
    PLANES = auto()
    MESH = auto()

    def words(self) -> str:
        """The members in lower case, comma-separated."""
        return ", ".join(str(member.name).lower() for member in self) or "nothing"


@dataclass(frozen=True, eq=False)
class Gaussians:
    """n anisotropic 3D Gaussians, activated: what a splatter reads.

    Attributes:
        means: centres, local frame.
        quaternions: rotations (w, x, y, z); normalised by whoever uses them.
        scales: standard deviations along the rotated axes, > 0, local units.
        opacities: peak opacity in [0, 1].
        sh: real spherical-harmonics coefficients of the colour minus 0.5, k = (degree + 1)^2 of them (3DGS, §2).
    """

    means: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]

    def __len__(self) -> int:
        return len(self.means)


class Field(nn.Module, ABC):
    """A scene's parameterisation. It never renders itself.

    Attributes:
        provides: the quantities it can be asked for.
    """

    provides: Quantity

    @abstractmethod
    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        """Answer ``want`` (within ``provides``) at each sample, differentiably in parameters, positions and directions."""

    def primitives(self, want: Quantity, ctx: Context) -> Any:
        """The explicit primitives of this field: `Gaussians` for ``Quantity.GAUSSIANS``, and so on."""
        raise NotComposableError(f"{type(self).__name__} has no {want.words()}.")

    def primitive_count(self) -> int | None:
        """Number of explicit primitives, ``None`` for fields that have none."""
        return None


class Conditional(nn.Module, ABC):
    """A family of fields over a latent code (a hypernetwork, or a decoder with an embedding)."""

    @abstractmethod
    def at(self, code: Float[Tensor, " c"]) -> Field:
        """The field of one code, differentiable in it."""


Density = Callable[[Samples], Float[Tensor, " m"]]
"""What a sampler may ask a field."""


class Sampler(nn.Module, ABC):
    """Chooses where along rays to look. May own parameters (proposals) and buffers (occupancy)."""

    @abstractmethod
    def sample(self, rays: Rays, density: Density, ctx: Context) -> tuple[Samples, tuple[Trace, ...]]:
        """Samples on ``rays`` (whose near and far are set), and the traces of the passes that led to them."""

    def update(self, density: Density, ctx: Context) -> None:
        """Refresh what is learnt without gradients (an occupancy grid); called once after each training step."""


class Renderer(nn.Module, ABC):
    """Makes a picture from a field and a camera, differentiably in the field and in the camera's pose.

    Attributes:
        requires: the quantities the field must provide.
    """

    requires: ClassVar[Quantity]

    @abstractmethod
    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render every pixel of ``camera``; the rendering has shape (height, width)."""

    def update(self, field: Field, ctx: Context) -> None:
        """Refresh what is learnt without gradients; called once after each training step."""


SAMPLES_EXPECTED = 16
"""Samples per ray that a picture's first rays are counted with, to keep within `Context.chunk`."""
MORE_RAYS = 16
"""How many times as many rays a part may have where they take fewer samples than expected."""


class RayRenderer(Renderer):
    """A renderer whose pixels are independent, so that it can train on any set of rays."""

    @abstractmethod
    def render_rays(self, field: Field, rays: Rays, ctx: Context) -> tuple[Rendering, Trace]:
        """Render n rays; the rendering has shape (n,)."""

    def render_image(self, field: Field, camera: Camera, ctx: Context) -> tuple[Rendering, Trace]:
        """Render the camera's rays in parts, larger ones where rays take few samples. The trace is the last part's."""
        rays = camera.rays()
        least = max(1, ctx.chunk // SAMPLES_EXPECTED)
        size = min(least, len(rays))
        rendering, trace = self.render_rays(field, rays[:size], ctx)
        parts, begin = [rendering], size
        while begin < len(rays):
            if trace.samples is not None:
                fitting = size * ctx.chunk // max(len(trace.samples), 1)
                size = min(max(fitting, least), 2 * size, MORE_RAYS * least)
            rendering, trace = self.render_rays(field, rays[begin : begin + size], ctx)
            parts.append(rendering)
            begin += size
        return Rendering.cat(parts).reshape(camera.height, camera.width), trace


def check(field: Field, renderer: Renderer) -> None:
    """Refuse a pair that does not fit.

    Raises:
        NotComposableError: names what the renderer needs and the field lacks.
    """
    missing = renderer.requires & ~field.provides
    if missing:
        raise NotComposableError(
            f"{type(renderer).__name__} needs {missing.words()}, which {type(field).__name__} does not provide.",
            f"It provides {field.provides.words()}.",
        )


class Encoding(nn.Module, ABC):
    """Maps positions in the unit cube to features.

    Attributes:
        width: number of features.
        needs_covariance: whether `forward` wants the sample's covariance (integrated encodings).
    """

    width: int
    needs_covariance: ClassVar[bool] = False

    @abstractmethod
    def forward(self, unit: Float[Tensor, "m 3"], covariance: Float[Tensor, "m 3 3"] | None = None) -> Float[Tensor, "m f"]:
        """Features at ``unit``; ``covariance`` is in unit coordinates and given only if ``needs_covariance``."""


class NoGradDensity:
    """A field's density as a plain function, outside the graph.

    Attributes:
        field: whose.
    """

    def __init__(self, field: Field) -> None:
        self.field = field

    def __call__(self, samples: Samples) -> Float[Tensor, " m"]:
        """The density alone."""
        with torch.no_grad():
            values = self.field.query(samples, Quantity.DENSITY)
        assert values.density is not None
        return values.density

    def look(self, samples: Samples) -> FieldValues:
        """The density and, of a field that has some, the features that it would start from to say a colour."""
        with torch.no_grad():
            return self.field.query(samples, Quantity.DENSITY | (self.field.provides & Quantity.FEATURES))


def no_grad_density(field: Field) -> NoGradDensity:
    """The field's density as a plain function, outside the graph."""
    return NoGradDensity(field)
