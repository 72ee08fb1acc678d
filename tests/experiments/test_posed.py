"""The frame of a fit that refined its poses: what drifted with it lands where the fit has it, and the world stays."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from invgraphics.core import Context, Field, FieldValues, Gaussians, Model, Quantity, Samples, Scene
from invgraphics.core.colour import quantise
from invgraphics.core.transforms import apply_similarity, se3_exp
from invgraphics.experiments.evaluate import score_model
from invgraphics.experiments.posed import PosedEvaluation, scene_in_fit_frame
from invgraphics.fields.similarity import transform_gaussians
from invgraphics.metrics.keys import POSE_ROTATION, POSE_TRANSLATION
from invgraphics.metrics.poses import Similarity
from invgraphics.renderers.splatting import SplattingConfig
from invgraphics.training.poses import Poses, PosesConfig


def test_a_scene_follows_its_fit(scene: Scene) -> None:
    motion = se3_exp(torch.tensor([0.1, -0.2, 0.05, 0.3, 0.1, -0.2], dtype=torch.float64))
    drift = Similarity(1.25, motion[:3, :3], motion[:3, 3])
    first = scene.test[0]
    depth, normal = torch.full(first.image.shape[:2], 2.0), torch.zeros_like(first.image, dtype=torch.float32)
    normal[..., 2] = 1.0
    scene = replace(scene, test=(replace(first, depth=depth, normal=normal), *scene.test[1:]))
    scene = replace(scene, val=scene.test[:1], observed=scene.test[1:])
    poses = Poses.of(PosesConfig(), scene)
    poses.given.copy_(drift.poses(poses.reference))
    seen = scene_in_fit_frame(poses, scene)
    for split in ("train", "val", "test", "observed"):
        for before, after in zip(getattr(scene, split), getattr(seen, split), strict=True):
            expected = drift.poses(before.camera.cam_to_world).float()
            torch.testing.assert_close(after.camera.cam_to_world.float(), expected, atol=1e-4, rtol=0)
            worlds = [
                apply_similarity(s.world_from_local.double(), v.camera.cam_to_world.double())
                for s, v in ((scene, before), (seen, after))
            ]
            torch.testing.assert_close(*worlds, atol=1e-4, rtol=0)
    assert seen.test[0].depth is not None
    torch.testing.assert_close(seen.test[0].depth, 1.25 * depth, atol=1e-4, rtol=0)
    assert seen.test[0].normal is not None
    torch.testing.assert_close(seen.test[0].normal[0, 0].double(), motion[:3, 2], atol=1e-4, rtol=0)


def test_photographs_that_the_fit_did_not_see_follow_its_drift(scene: Scene) -> None:
    """Fitted to a few of the training views: the scene as loaded has more of them than there are refined poses."""
    drift = Similarity(1.25, torch.eye(3, dtype=torch.float64), torch.tensor([0.1, 0.0, -0.3], dtype=torch.float64))
    poses = Poses.of(PosesConfig(), scene.with_views(train=scene.train[:4]))
    poses.given.copy_(drift.poses(poses.reference))
    seen = scene_in_fit_frame(poses, scene)
    for before, after in zip(scene.train, seen.train, strict=True):
        expected = drift.poses(before.camera.cam_to_world).float()
        torch.testing.assert_close(after.camera.cam_to_world.float(), expected, atol=1e-4, rtol=0)


class Fixed(Field):
    """Given Gaussians."""

    provides = Quantity.GAUSSIANS

    def __init__(self, gaussians: Gaussians) -> None:
        super().__init__()
        self.gaussians = gaussians

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        raise NotImplementedError

    def primitives(self, want: Quantity, ctx: Context) -> Gaussians:
        return self.gaussians


def test_a_drifted_fit_is_scored_as_if_it_had_not_drifted(scene: Scene) -> None:
    """What the undrifted Gaussians show is the truth; the drifted ones, seen by cameras that drifted too, show the same."""
    motion = se3_exp(torch.tensor([0.7, -1.2, 0.5, 0.3, 0.1, -0.2], dtype=torch.float64))
    drift = Similarity(1.25, motion[:3, :3], motion[:3, 3])
    generator = torch.Generator().manual_seed(0)
    shapes = ((80, 3), (80, 4), (80, 3), (80,), (80, 4, 3))
    means, quaternions, scales, opacities, sh = (torch.randn(shape, generator=generator) for shape in shapes)
    scales = torch.tensor([0.25, 0.2, 0.05]) * (0.2 * scales).exp()
    still = Gaussians(0.3 * means, quaternions, scales, (2 + opacities).sigmoid(), 0.3 * sh)
    splatting = SplattingConfig().build(scene)
    model = Model(Fixed(still), splatting, scene.bounds)
    drifted = Model(Fixed(transform_gaussians(still, drift.matrix.float())), splatting, scene.bounds)
    test = []
    for view in scene.test:
        truth = model.render(view.camera)
        image = quantise(truth.rgb / truth.alpha.clamp_min(1e-3)[..., None])
        test.append(replace(view, image=image, alpha=quantise(truth.alpha), depth=truth.depth, normal=truth.normal))
    scene = scene.with_views(test=tuple(test))
    poses = Poses.of(PosesConfig(test_steps=0), scene)
    poses.given.copy_(drift.poses(poses.reference))
    posed = PosedEvaluation(poses, scene, drifted)
    for view in scene.test:
        camera = posed.camera(view)
        found = posed.to_scene_frame(drifted.render(camera), camera, view)
        solid = view.opacity() > 0.55
        assert 40 < int(solid.sum()) < solid.numel()
        assert view.depth is not None and view.normal is not None and found.normal is not None
        torch.testing.assert_close(found.depth[solid], view.depth[solid], atol=1e-3, rtol=0)
        torch.testing.assert_close(found.normal[solid], view.normal[solid], atol=1e-2, rtol=0)
    scores = score_model(drifted, scene, "default", "drifted", poses).quality
    assert scores["depth_abs_rel"].mean < 1e-4
    assert scores["normal_deg"].mean < 0.1
    assert scores["psnr"].mean > 45
    unaligned = score_model(drifted, scene, "default", "unaligned").quality
    assert unaligned["depth_abs_rel"].mean > 0.05 and unaligned["normal_deg"].mean > 10


def test_errors_of_poses_are_in_degrees(scene: Scene) -> None:
    """Cameras that turn about themselves, the first by one degree and the last by twelve, stay in their places."""
    poses, degrees = Poses.of(PosesConfig(), scene), torch.arange(1.0, 1 + len(scene.train))
    turns = torch.from_numpy(Rotation.from_euler("x", degrees[:, None].numpy(), degrees=True).as_matrix()).float()
    poses.given[:, :3, :3] = poses.reference[:, :3, :3] @ turns
    found = PosedEvaluation(poses, scene, Model(Fixed(_none()), SplattingConfig().build(scene), scene.bounds)).quality()
    rotation, translation = found[POSE_ROTATION], found[POSE_TRANSLATION]
    assert (rotation.unit, rotation.mean, rotation.max) == ("deg", pytest.approx(6.5, abs=1e-3), pytest.approx(12, abs=1e-3))
    assert rotation.per_training_view == pytest.approx(degrees.tolist(), abs=1e-3)
    assert (translation.unit, translation.max) == ("%", pytest.approx(0, abs=1e-3))


def _none() -> Gaussians:
    return Gaussians(*(torch.zeros(shape) for shape in ((0, 3), (0, 4), (0, 3), (0,), (0, 1, 3))))
