"""Mitsuba's own Gaussians as a third renderer: ``ellipsoids`` seen by ``volprim_rf_basic``, in a process of its own.

Its model (3DGRT) is that of `GaussianSorted` with ``opacity="splat"``: the largest response on the ray, alpha = a G, composited
front to back. It sorts by where a ray enters a Gaussian rather than by where its response is largest, and ends a Gaussian at
some standard deviations rather than at alpha 1/255; colours here do not depend on the direction, which it takes from the ray.
"""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from invgraphics.core import Bounds, Camera, Context, Gaussians, Rays, harmonics
from invgraphics.fields.gaussian import GaussianField
from invgraphics.kernels.reference.gaussian_rays import Intersections
from invgraphics.renderers.gaussians.volume import GaussianRays, GaussianSorted, GaussianSortedConfig
from invgraphics.scenes.mitsuba.llvm import FAST, status
from invgraphics.testing import toy_cameras

SCRIPT = Path(__file__).with_name("mitsuba_ellipsoids.py")


def gaussians(n: int, scale: float, apart: bool) -> Gaussians:
    generator = torch.Generator().manual_seed(n)
    side = math.ceil(n ** (1 / 3))
    grid = torch.stack(torch.meshgrid(*[torch.linspace(-0.8, 0.8, side)] * 3, indexing="ij"), dim=-1).view(-1, 3)[:n]
    means = grid if apart else torch.randn(n, 3, generator=generator) * 0.4
    scales = scale * (0.5 + torch.rand(n, 3, generator=generator))
    quaternions = torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=1)
    opacities = 0.1 + 0.85 * torch.rand(n, generator=generator)
    sh = torch.rand(n, 1, 3, generator=generator) / harmonics.BAND_0 - 0.5 / harmonics.BAND_0
    return Gaussians(means, quaternions, scales, opacities, sh)


class ByEntry(GaussianSorted):
    """Sorted as Mitsuba does it: by where a ray enters the shell of five standard deviations."""

    def __init__(self, opacities: torch.Tensor) -> None:
        super().__init__(GaussianSortedConfig("splat"))
        self.opacities = opacities

    def _sums(self, *args: Any) -> torch.Tensor:
        return GaussianRays._sums(self, *args)  # in plain torch: the compiled order is another one

    def order(self, intersections: Intersections, rays: Rays, axis: torch.Tensor | None) -> torch.Tensor:
        squared = -2 * torch.log(-torch.expm1(-intersections.optical_depth) / self.opacities[intersections.gaussian])
        entry = intersections.t - intersections.sigma * (25 - squared.clamp(0, 25)).sqrt()
        return super().order(replace(intersections, t=entry), rays, axis)


def ours(given: Gaussians, camera: Camera, renderer: GaussianSorted) -> np.ndarray:
    tensors = {"means": given.means, "quaternions": given.quaternions, "log_scales": given.scales.log()}
    tensors |= {"opacity_logits": given.opacities.logit(), "sh_dc": given.sh[:, :1], "sh_rest": given.sh[:, 1:]}
    with torch.no_grad():
        picture, _ = renderer.render_image(GaussianField(tensors), camera, Context(Bounds(-torch.ones(3), torch.ones(3))))
    return picture.rgb.numpy()


def theirs(given: Gaussians, camera: Camera, folder: Path) -> np.ndarray:
    machine = status()
    if machine.variant != FAST:
        pytest.skip(f"ellipsoids need Mitsuba's LLVM variant: {machine.reason}")
    arrays = {
        "centers": given.means,
        "scales": given.scales,
        "quaternions": given.quaternions[:, [1, 2, 3, 0]],
        "opacities": given.opacities[:, None],
        "sh": given.sh.flatten(1),
        "origins": camera.rays().origins,
        "directions": camera.rays().directions,
    }
    np.savez(folder / "in.npz", **{name: value.numpy() for name, value in arrays.items()})
    command = [sys.executable, str(SCRIPT), str(folder / "in.npz"), str(folder / "out.npy")]
    done = subprocess.run(command, env=machine.environment(), capture_output=True, text=True, timeout=300, check=False)
    if done.returncode:
        pytest.fail(done.stderr[-2000:])
    return np.load(folder / "out.npy").reshape(camera.height, camera.width, 3)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return -10 * math.log10(float(((one - other) ** 2).mean()))


def test_apart_gaussians_are_the_same_in_mitsuba(tmp_path: Path) -> None:
    """Of 27 that hardly overlap, only alphas below 1/255 differ: 66 dB, and nowhere more than two of 255 shades."""
    given, camera = gaussians(27, 0.06, apart=True), toy_cameras(1, 96)[0]
    one, other = ours(given, camera, GaussianSorted(GaussianSortedConfig("splat"))), theirs(given, camera, tmp_path)
    assert one.max() > 0.5
    assert psnr(one, other) > 60
    assert np.abs(one - other).max() < 2 / 255


def test_a_cloud_is_alike_in_mitsuba(tmp_path: Path) -> None:
    """Of 1000 that overlap, what is left is Mitsuba's other order: 37 dB with our own, above 50 dB with that."""
    given, camera = gaussians(1000, 0.04, apart=False), toy_cameras(1, 96)[0]
    other = theirs(given, camera, tmp_path)
    assert psnr(ours(given, camera, GaussianSorted(GaussianSortedConfig("splat"))), other) > 35
    by_entry = psnr(ours(given, camera, ByEntry(given.opacities)), other)
    print("psnr", by_entry)
    assert by_entry > 50
