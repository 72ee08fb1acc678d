"""The frame of a fit that refined its poses: what drifted with it lands where the fit has it, and the world stays."""

from dataclasses import replace

import torch

from invgraphics.core import Scene
from invgraphics.core.transforms import apply_similarity, se3_exp
from invgraphics.experiments.posed import scene_in_fit_frame
from invgraphics.metrics.poses import Similarity
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
