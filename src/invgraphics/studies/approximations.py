"""Errors of splatting's approximations, measured one at a time on known Gaussians."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Bounds, Camera, Gaussians, Model, Renderer, harmonics
from invgraphics.core.transforms import look_at
from invgraphics.fields.gaussian import GaussianField
from invgraphics.kernels.extinction import Opacity
from invgraphics.renderers.gaussians.volume import GaussianExact, GaussianExactConfig, GaussianSorted, GaussianSortedConfig
from invgraphics.renderers.splatting import Splatting, SplattingConfig
from invgraphics.runs.analysis import Analysis, Curve

UP = (0.0, 0.0, 1.0)
PATCH = 96
"""Edge in pixels of the picture of a single Gaussian, six standard deviations wide."""

ANGLES = tuple(range(0, 61, 5))
"""Between optical axis and centre, degrees."""
SIZES = (1.0, 3.0, 10.0)
"""Standard deviation of a Gaussian as seen by the camera, degrees."""

FIELDS_OF_VIEW = (10, 20, 30, 50, 70, 90, 110)
CLOUD, SCALES = 400, (0.02, 0.05, 0.1)
"""Gaussians of a cloud that fills the picture, and their sizes relative to the cloud's."""

TURN, TURNS = 10.0, 101
"""How far the camera turns around two crossing Gaussians, degrees to either side, and in how many steps."""

OPACITIES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
RESPONSES = 512
"""Pixels along the line from the centre of a Gaussian outwards on which the gap is looked for."""


def splat() -> Splatting:
    """Splat by EWA without the low-pass filter, which approximates pixels and not the Gaussians."""
    return Splatting(SplattingConfig(dilation=0.0))


def along_rays(order: Literal["centre", "ray"] = "centre", opacity: Opacity = "splat") -> GaussianSorted:
    """Render with the same opacities in the same order, but responses evaluated on each pixel's own ray."""
    return GaussianSorted(GaussianSortedConfig(opacity, order))


def integrated(opacity: Literal["peak", "physical"] = "peak", steps: int = 64) -> GaussianExact:
    """Render overlapping densities by exact integration along each ray, without any of splatting's approximations."""
    return GaussianExact(GaussianExactConfig(opacity, steps))


def affine_projection() -> Analysis:
    """Analyse the affine projection: largest alpha error of one isotropic Gaussian over its angle from the optical axis."""
    curves, at_45 = [], {}
    for size in SIZES:
        errors = [affine_error(math.radians(angle), math.radians(size)) for angle in ANGLES]
        curves.append(Curve(f"standard deviation {size:g}°", tuple(map(float, ANGLES)), tuple(errors)))
        at_45[size] = errors[ANGLES.index(45)]
    listed = ", ".join(f"{error:.2g} for a Gaussian of {size:g}°" for size, error in at_45.items())
    return Analysis(
        title="Affine projection: distance from the optical axis",
        sentence=f"45° off the axis, replacing perspective by its derivative at the centre changes alpha by up to {listed}.",
        x="angle from the optical axis (°)",
        y="largest error of alpha",
        curves=tuple(curves),
        logarithmic=True,
    )


def affine_error(angle: float, size: float, opacity: float = 0.9) -> float:
    """Largest difference in alpha between a splat and the response along rays.

    Args:
        angle: of the Gaussian's centre from the optical axis, radians.
        size: standard deviation over distance.
        opacity: of the Gaussian.
    """
    centre = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    width = 6 * size / math.cos(angle) ** 2
    focal = PATCH / width
    # The window's middle is where the centre is seen; its optical axis stays where it is.
    principal = torch.tensor([PATCH / 2 - focal * math.tan(angle), PATCH / 2], dtype=torch.float64)
    lens = torch.full((2,), focal, dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), lens, principal, PATCH, PATCH)
    one = isotropic_gaussians(centre[None], torch.tensor([size]), torch.tensor([opacity]))
    return _largest_gap(one, camera, splat(), along_rays())


def field_of_view() -> Analysis:
    """Analyse the affine projection: RMS colour error over the field of view, for a cloud that fills the picture."""
    curves = []
    for scale in SCALES:
        errors = [cloud_error(math.radians(angle), scale) for angle in FIELDS_OF_VIEW]
        curves.append(Curve(f"size {100 * scale:g}% of the cloud", tuple(map(float, FIELDS_OF_VIEW)), tuple(errors)))
    narrow, wide = (curves[1].y[FIELDS_OF_VIEW.index(angle)] for angle in (30, 90))
    return Analysis(
        title="Affine projection: field of view",
        sentence=f"A cloud of {CLOUD} Gaussians of {100 * SCALES[1]:g}% of its size fills the picture: the affine projection's "
        f"error is {narrow:.2g} with a field of view of 30° and {wide:.2g} with 90°.",
        x="field of view (°)",
        y="RMS error of the picture",
        curves=tuple(curves),
        logarithmic=True,
    )


def cloud_error(view: float, scale: float) -> float:
    """RMS difference of colour between a splatted cloud and the same along rays, both in one order.

    Args:
        view: field of view in radians; the unit ball fills it.
        scale: standard deviation of the Gaussians, where the cloud's radius is 1.
    """
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(CLOUD, 3, generator=generator, dtype=torch.float64), dim=1)
    means = directions * torch.rand(CLOUD, 1, generator=generator, dtype=torch.float64) ** (1 / 3) * (1 - 3 * scale)
    opacities = 0.1 + 0.8 * torch.rand(CLOUD, generator=generator)
    cloud = isotropic_gaussians(means, torch.full((CLOUD,), scale), opacities, torch.rand(CLOUD, 3, generator=generator))
    distance = 1 / math.sin(view / 2)
    pose = look_at(torch.tensor([0.0, -distance, 0.0]), torch.zeros(3), torch.tensor(UP)).double()
    lens = torch.full((2,), PATCH / 2 / math.tan(view / 2), dtype=torch.float64)
    camera = Camera(pose, lens, torch.full((2,), PATCH / 2, dtype=torch.float64), PATCH, PATCH)
    one, other = (model_of(cloud, renderer).render(camera, normals=False) for renderer in (splat(), along_rays()))
    return float((one.rgb - other.rgb).square().mean().sqrt())


def sorting_by_centre() -> Analysis:
    """Analyse sorting by centre: colour of two crossing elongated Gaussians over the camera's turn, for three orders."""
    renderers = {
        "sorted by centre": along_rays(),
        "sorted along the ray": along_rays("ray"),
        "integrated": integrated(),
    }
    curves, jumps = [], {}
    for label, renderer in renderers.items():
        angles, shares = crossing(renderer)
        curves.append(Curve(label, tuple(angles), tuple(shares)))
        jumps[label] = max(abs(after - before) for before, after in itertools.pairwise(shares))
    listed = ", ".join(f"{jump:.2g} {label}" for label, jump in jumps.items())
    return Analysis(
        title="Sorting by centre: popping",
        sentence=f"In a turn of {2 * TURN / (TURNS - 1):g}° the red share of the picture changes by at most: {listed}.",
        x="turn of the camera (°)",
        y="red share of the light",
        curves=tuple(curves),
    )


def crossing(renderer: Renderer, turns: int = TURNS) -> tuple[list[float], list[float]]:
    """Camera turns in degrees, and the red share of the light of a red and a blue crossing Gaussian."""
    pair = crossing_pair(torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    model, size = model_of(pair, renderer), PATCH // 2
    angles = torch.linspace(-TURN, TURN, turns, dtype=torch.float64)
    shares = []
    for angle in angles.deg2rad().tolist():
        eye = torch.tensor([4 * math.sin(angle), -4 * math.cos(angle), 0.0])
        pose = look_at(eye, torch.zeros(3), torch.tensor(UP)).double()
        lens, centre = torch.full((2,), 1.5 * size), torch.full((2,), size / 2)
        picture = model.render(Camera(pose, lens.double(), centre.double(), size, size), normals=False)
        red, _, blue = picture.rgb.sum(dim=(0, 1)).tolist()
        shares.append(red / (red + blue))
    return angles.tolist(), shares


def crossing_pair(rgb: Float[Tensor, "2 3"]) -> Gaussians:
    """Make two elongated Gaussians of these colours that cross at the origin, turned by ±0.4 rad about z from x."""
    means = torch.tensor([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]])
    pair = isotropic_gaussians(means, torch.tensor([0.1, 0.1]), torch.tensor([0.8, 0.8]), rgb)
    scales = torch.tensor([[0.5, 0.1, 0.1], [0.5, 0.1, 0.1]]).double()
    turns = torch.tensor([[math.cos(0.2), 0.0, 0.0, math.sin(0.2)], [math.cos(0.2), 0.0, 0.0, -math.sin(0.2)]]).double()
    return replace(pair, quaternions=turns, scales=scales)


def opacity_convention() -> Analysis:
    """Analyse opacity conventions: largest difference of alpha = a G and alpha = 1 - (1 - a)^G for one Gaussian."""
    gaps = [opacity_gap(opacity) for opacity in OPACITIES]
    between = tuple(opacity / 100 for opacity in range(1, 100))
    exact = tuple(opacity_gap_formula(opacity) for opacity in between)
    named = ", ".join(f"{gaps[OPACITIES.index(a)]:.2g} at a = {a:g}" for a in (0.1, 0.5, 0.9))
    return Analysis(
        title="Opacity: splatted or marched",
        sentence=f"A splat of peak opacity a has alpha a·G, the same Gaussian marched 1 − (1 − a)^G: up to {named}.",
        x="peak opacity a",
        y="largest gap of alpha",
        curves=(Curve("rendered", OPACITIES, tuple(gaps)), Curve("closed form", between, exact)),
    )


def opacity_gap(opacity: float) -> float:
    """Largest difference of alpha over the pixels of one round Gaussian, splatted and marched along the same rays."""
    one = isotropic_gaussians(torch.zeros(1, 3), torch.tensor([0.1]), torch.tensor([opacity]))
    pose = look_at(torch.tensor([0.0, -5.0, 0.0]), torch.zeros(3), torch.tensor(UP)).double()
    focal = RESPONSES / (3 * 0.1 / 5)
    centre = torch.tensor([0.0, 0.5], dtype=torch.float64)
    camera = Camera(pose, torch.full((2,), focal, dtype=torch.float64), centre, RESPONSES, 1)
    return _largest_gap(one, camera, along_rays("ray"), along_rays("ray", "peak"))


def opacity_gap_formula(opacity: float) -> float:
    """Maximum over G of 1 - (1 - a)^G - a G, where -ln(1 - a) (1 - a)^G = a."""
    rate = -math.log1p(-opacity)
    response = math.log(rate / opacity) / rate
    return 1 - math.exp(-rate * response) - opacity * response


def isotropic_gaussians(
    means: Float[Tensor, "n 3"],
    sizes: Float[Tensor, " n"],
    opacities: Float[Tensor, " n"],
    rgb: Float[Tensor, "n 3"] | None = None,
) -> Gaussians:
    """Make isotropic Gaussians, float64; white without colours."""
    n = len(means)
    colour = torch.ones(n, 3) if rgb is None else rgb
    quaternions = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(n, 1)
    sh = ((colour.double() - 0.5) / harmonics.BAND_0)[:, None]
    return Gaussians(means.double(), quaternions, sizes.double()[:, None].repeat(1, 3), opacities.double(), sh)


def field_of(gaussians: Gaussians) -> GaussianField:
    """Make a field of given Gaussians."""
    return GaussianField(
        {
            "means": gaussians.means,
            "quaternions": gaussians.quaternions,
            "log_scales": gaussians.scales.log(),
            "opacity_logits": gaussians.opacities.logit(),
            "sh_dc": gaussians.sh[:, :1],
            "sh_rest": gaussians.sh[:, 1:],
        }
    )


def model_of(gaussians: Gaussians, renderer: Renderer) -> Model:
    """Make a model of given Gaussians and a renderer, without near-plane clipping."""
    ball = torch.full((3,), 1.5, dtype=torch.float64)
    return Model(field_of(gaussians), renderer, Bounds(-ball, ball, near=1e-3))


def _largest_gap(gaussians: Gaussians, camera: Camera, one: Renderer, two: Renderer) -> float:
    """Largest difference in alpha where both are non-zero, which excludes splatting's cut-off of alphas below 1/255."""
    first, second = (model_of(gaussians, renderer).render(camera, normals=False).alpha for renderer in (one, two))
    return float(torch.where((first > 0) & (second > 0), first - second, 0.0).abs().max())
