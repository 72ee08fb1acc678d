"""Gaussians to write, and pictures of them."""

import math

import torch

from invgraphics.core import Bounds, Camera, Context, Gaussians
from invgraphics.core.transforms import look_at
from invgraphics.fields.gaussian import FixedGaussians
from invgraphics.renderers.splatting import Splatting, SplattingConfig

BOUNDS = Bounds(-torch.ones(3), torch.ones(3))


def cloud(n: int = 400, degree: int = 3) -> Gaussians:
    """Anisotropic Gaussians around the origin, of lively colour that changes with the direction."""
    generator = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    sh = normal(n, (degree + 1) ** 2, 3) * 0.1
    sh[:, 0] *= 4
    return Gaussians(
        means=normal(n, 3) * 0.5,
        quaternions=normal(n, 4),
        scales=torch.exp(normal(n, 3) * 0.5 - 2.8),
        opacities=torch.sigmoid(normal(n) * 2),
        sh=sh,
    )


def camera_at(eye: list[float], up: list[float], size: int = 96, focal: float = 1.2) -> Camera:
    """A camera that looks at the origin; ``focal`` in widths of the picture."""
    pose = look_at(torch.tensor(eye), torch.zeros(3), torch.tensor(up))
    return Camera(pose, torch.full((2,), focal * size), torch.full((2,), size / 2), size, size)


def picture_of(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
    """The Gaussians in front of grey, in [0, 1]."""
    with torch.no_grad():
        rendering, _ = Splatting(SplattingConfig()).render_image(FixedGaussians(gaussians), camera, Context(BOUNDS))
    return rendering.over(torch.full((3,), 0.5)).clamp(0, 1)


def psnr(one: torch.Tensor, other: torch.Tensor) -> float:
    """In dB; infinite for equal pictures."""
    error = float((one.double() - other.double()).square().mean())
    return -10 * math.log10(error) if error else math.inf


def worst_psnr(one: Gaussians, other: Gaussians) -> float:
    """The lowest PSNR of three views."""
    eyes = [camera_at(eye, [0.0, 0.0, 1.0]) for eye in ([3.0, 0.5, 0.3], [-1.0, 2.5, 1.0], [0.4, -2.0, -2.0])]
    return min(psnr(picture_of(one, eye), picture_of(other, eye)) for eye in eyes)
