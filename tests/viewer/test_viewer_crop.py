"""A crop box limits what is rendered: rays end at it, Gaussians outside are left out, and what cannot be cropped says why."""

import math
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

from invgraphics.core import Bounds, Context, Quantity, Rays, Renderer
from invgraphics.experiments.fitted import open_fitted
from invgraphics.renderers.ray_attention import RayAttentionConfig
from invgraphics.renderers.srn import SRNConfig
from invgraphics.testing import toy_scene
from invgraphics.viewer.crop import CropBox, CroppedGaussians, crop_note, crop_obstacle
from invgraphics.viewer.loaded_run import LoadedRun

METHODS = ("volumetric/nerf", "volumetric/hash", "splatting/gaussians")


@pytest.mark.parametrize("space", ["box", "contracted"])
def test_rays_end_at_the_crop_box(space) -> None:
    """Against dense points along each ray."""
    lo, hi = torch.tensor([-0.4, -0.2, 0.1]), torch.tensor([0.3, 0.5, 0.8])
    bounds = Bounds(-torch.ones(3), torch.ones(3), space, near=0.01, crop=(lo, hi))
    generator = torch.Generator().manual_seed(2)
    origins = torch.randn(200, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.rand(200, 3, generator=generator) - 0.4 - origins, dim=1)
    directions[0], origins[0] = torch.tensor([1.0, 0, 0]), torch.tensor([-3.0, 0.1, 0.4])  # parallel to an axis
    rays = bounds.clip(Rays.make(origins, directions))
    t = torch.linspace(0.01, 8, 20_000)
    inside = (
        (origins[:, None] + t[:, None] * directions[:, None] - lo) * (hi - origins[:, None] - t[:, None] * directions[:, None])
        >= 0
    ).all(-1)
    step = float(t[1] - t[0])
    for index in range(200):
        met = t[inside[index]]
        length = float(rays.far[index] - rays.near[index])
        if len(met):
            assert float(rays.near[index]) == pytest.approx(float(met[0]), abs=2 * step)
            assert float(rays.far[index]) == pytest.approx(float(met[-1]), abs=2 * step)
        else:
            assert length <= 2 * step
    assert bounds.to(torch.float64).crop[0].dtype == torch.float64
    whole = replace(bounds, crop=None).clip(Rays.make(origins, directions))
    assert float((whole.far - whole.near).sum()) > float((rays.far - rays.near).sum())


@pytest.mark.parametrize("method", METHODS)
def test_what_is_outside_is_not_rendered(runs: dict[str, Path], method: str) -> None:
    run = LoadedRun(open_fitted(runs[method]))
    camera = run.scene.test[0].camera
    whole = run.render(camera, geometry=False)
    everything = run.render(camera, False, CropBox((-9, -9, -9), (9, 9, 9)))
    torch.testing.assert_close(everything.rgb, whole.rgb, atol=2e-3, rtol=0)
    nothing = run.render(camera, False, CropBox((5, 5, 5), (6, 6, 6)))
    assert float(nothing.alpha.max()) < 1e-6
    seen = run.render(camera, False, CropBox((0.0, -9, -9), (9, 9, 9)))
    assert 0 < float(seen.alpha.sum()) < 0.95 * float(whole.alpha.sum())
    assert not run.crop_obstacle and "Cropped" in crop_note(run.fitted.model.renderer)
    surface = (seen.alpha > 0.5) & seen.depth.isfinite()
    if method != "splatting/gaussians":  # splats may extend beyond the box
        assert int(surface.sum()) > 20
        rays = camera.rays()
        points = rays.origins + seen.depth.reshape(-1, 1) * rays.directions
        assert float(points[surface.reshape(-1), 0].min()) > -1e-3, "no depth outside the box"


def test_gaussians_are_culled_by_their_centres(runs: dict[str, Path]) -> None:
    fitted = open_fitted(runs["splatting/gaussians"])
    ctx = Context(fitted.scene.bounds)
    box = CropBox((-0.2, -1, -1), (0.4, 1, 1))
    whole = fitted.model.field.primitives(Quantity.GAUSSIANS, ctx)
    kept = CroppedGaussians(fitted.model.field, box).primitives(Quantity.GAUSSIANS, ctx)
    x = whole.means[:, 0]
    assert len(kept) == int(((x >= -0.2) & (x <= 0.4) & (whole.means[:, 1:].abs() <= 1).all(dim=1)).sum())
    assert 0 < len(kept) < len(whole) and len(kept.sh) == len(kept)


def test_the_box_is_the_same_in_another_local_frame(runs: dict[str, Path]) -> None:
    first = LoadedRun(open_fitted(runs["volumetric/hash"]))
    angle = math.pi / 2
    similarity = torch.tensor(
        [[0.0, -3 * math.sin(angle), 0, 1], [3 * math.sin(angle), 0, 0, 2], [0, 0, 3, -1], [0, 0, 0, 1.0]]
    )
    other = LoadedRun(replace(first.fitted, scene=replace(first.scene, world_from_local=similarity)))
    box = CropBox((-0.5, 0.0, 0.1), (0.5, 0.6, 0.7))
    moved = other.crop_to_local(box, first.scene)
    corners = (box.corners - similarity[:3, 3].double()) @ torch.linalg.inv(similarity[:3, :3].double()).T
    np.testing.assert_allclose(moved.lo, corners.amin(dim=0), atol=1e-9)
    np.testing.assert_allclose(moved.hi, corners.amax(dim=0), atol=1e-9)
    assert first.crop_to_local(box, first.scene) is box


def test_what_cannot_be_cropped_says_why() -> None:
    class Meshes(Renderer):
        requires: ClassVar[Quantity] = Quantity.MESH

        def render_image(self, field, camera, ctx):
            raise NotImplementedError

    assert crop_obstacle(Meshes()) == "Meshes cannot be cropped: it renders mesh, neither Gaussians nor rays."
    assert crop_note(Meshes()) == crop_obstacle(Meshes())
    toy = toy_scene(views=2, size=8)
    for learned in (RayAttentionConfig(), SRNConfig()):  # of rays through the whole box
        assert "cannot be cropped: it has learnt from rays through all" in crop_obstacle(learned.build(toy))
    assert toy_scene(views=2, size=8).bounds.crop is None
