"""What splatting approximates, each alone: the numbers of the study against closed forms."""

import itertools
import math

import pytest

from invgraphics.renderers.gaussians.volume import GaussianExact, GaussianExactConfig
from invgraphics.studies import approximations as alone


@pytest.mark.parametrize(("opacity", "gap", "digits"), [(0.1, 0.0013, 5e-5), (0.5, 0.043, 5e-4), (0.9, 0.24, 5e-3)])
def test_opacity_convention(opacity: float, gap: float, digits: float) -> None:
    """Rendered by both conventions, and by the closed form's maximum."""
    measured = alone.opacity_gap(opacity)
    assert measured == pytest.approx(gap, abs=digits)
    assert measured == pytest.approx(alone.opacity_gap_formula(opacity), rel=1e-3)


def test_affine_projection_errs_with_size_and_angle() -> None:
    """On the axis, a round Gaussian's outline is a circle under both, and only its profile differs, in second order."""
    sizes = [math.radians(size) for size in (1, 2, 4)]
    ahead = [alone.affine_error(0.0, size) for size in sizes]
    aside = [alone.affine_error(math.radians(45), size) for size in sizes]
    assert all(near < far / 3 for near, far in zip(ahead, aside, strict=True))
    # First order off the axis, second order on it.
    assert 1.7 < aside[1] / aside[0] < 2.3 and 1.7 < aside[2] / aside[1] < 2.3
    assert 3.5 < ahead[1] / ahead[0] < 4.5 and 3.5 < ahead[2] / ahead[1] < 4.5
    wider = [alone.affine_error(math.radians(angle), sizes[1]) for angle in (0, 15, 30, 45, 60)]
    assert wider == sorted(wider)


def test_affine_error_on_the_axis_has_a_closed_form() -> None:
    """There a splat is a exp(-r²/2s²) of the tangent r, a ray's response a exp(-sin²/2s²)."""
    size, opacity = math.radians(5), 0.9
    worst = 0.0
    for i in range(1, 2000):
        tangent = 3 * size * i / 2000
        sine = tangent / math.sqrt(1 + tangent**2)
        one, other = (opacity * math.exp(-0.5 * (x / size) ** 2) for x in (tangent, sine))
        worst = max(worst, abs(one - other))
    assert alone.affine_error(0.0, size, opacity) == pytest.approx(worst, rel=0.02)


def test_a_wider_lens_makes_it_worse() -> None:
    errors = [alone.cloud_error(math.radians(angle), 0.05) for angle in (20, 50, 100)]
    assert errors[0] < errors[1] / 1.5 < errors[2] / 3


def test_popping() -> None:
    """Sorted by centre the whole picture jumps; along rays each pixel jumps at another angle; integrated there is no jump."""
    steps = {}
    for name, renderer in {
        "centre": alone.along_rays(),
        "ray": alone.along_rays("ray"),
        "exact": GaussianExact(GaussianExactConfig(steps=16)),
    }.items():
        _, shares = alone.crossing(renderer, 20)
        steps[name] = max(abs(b - a) for a, b in itertools.pairwise(shares))
        assert len(shares) == 20
    assert steps["centre"] > 0.2 and steps["ray"] < 0.005 and steps["exact"] < 0.005
