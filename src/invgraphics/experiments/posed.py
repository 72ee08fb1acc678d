"""Evaluation of fits with refined training poses: the fit's frame is aligned, and test poses are refined to their views.

The fit may have drifted by a similarity, so the test poses are transformed to its frame by the one between true and
refined training poses. What remains of their errors belongs to the cameras rather than to the scene, so each is refined
to its photograph before it is scored (BARF, §4.1).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from invgraphics.core import Camera, Model, Rendering, Scene, View
from invgraphics.metrics.keys import POSE_ROTATION, POSE_TRANSLATION
from invgraphics.metrics.poses import PoseErrors, Similarity, pose_errors
from invgraphics.recipes.recipe import Method
from invgraphics.runs.scores import Score
from invgraphics.training.fit import Plan
from invgraphics.training.localise import PoseDescent, refine_pose
from invgraphics.training.poses import Poses, PosesConfig
from invgraphics.training.views.exposure import exposure_config
from invgraphics.training.views.sparse_depth import SparseDepth


def protocol_note(method: Method) -> str:
    """Describe the alignment and refinement of test poses for the protocol's table; empty for fixed poses."""
    config = refined_poses(method)
    if config is None:
        return ""
    refined = f", then refined for {config.test_steps} steps to each test photograph" if config.test_steps else ""
    return f"aligned by the similarity between refined and true training poses{refined}"


def exposure_note(method: Method, scene: Scene) -> str:
    """Describe the exposure under which test views are shown; empty where no exposures are fitted."""
    training = method.recipe.training
    config = exposure_config(None if training is None else training.exposure, scene)
    return "" if config is None else config.note


def sparse_depth_note(plan: Plan) -> str:
    """Describe the points of structure from motion that supervise a fit's depth; empty where none do."""
    return next((penalty.note for penalty in plan.penalties if isinstance(penalty, SparseDepth)), "")


def refined_poses(method: Method) -> PosesConfig | None:
    """Settings of a method's pose refinement; ``None`` for fixed poses."""
    training = method.recipe.training
    return training.poses if training is not None and training.poses is not None and training.poses.optimise else None


@torch.no_grad()
def training_errors(poses: Poses, scene: Scene) -> PoseErrors:
    """Errors of the refined training poses after alignment, in shares of the scene's extent."""
    return pose_errors(poses().cpu(), poses.reference.cpu(), scene.extent)


def world_to_fit(poses: Poses, scene: Scene) -> Similarity:
    """Similarity from the scene's frame to the frame that the fit's cameras have drifted to."""
    return training_errors(poses, scene).similarity.inverse()


def transform_camera(camera: Camera, similarity: Similarity) -> Camera:
    """Transform a camera by a similarity of the world."""
    return camera.moved(similarity.poses(camera.cam_to_world).to(camera.cam_to_world))


@torch.no_grad()
def scene_in_fit_frame(poses: Poses, scene: Scene) -> Scene:
    """Transform the scene to the fit's drifted frame: refined training cameras, all else transformed by `world_to_fit`.

    Training cameras are transformed too where the fit has seen only some of them. The scene's ``world_from_local`` leads to the
    same world as before.
    """
    errors = training_errors(poses, scene)
    similarity = errors.similarity.inverse()

    def moved(view: View, camera: Camera) -> View:
        turn = (camera.cam_to_world @ torch.linalg.inv(view.camera.cam_to_world))[:3, :3]
        turn = turn / torch.linalg.det(turn) ** (1 / 3)
        depth = None if view.depth is None else view.depth / errors.scale
        normal = None if view.normal is None else view.normal @ turn.T
        return replace(view, camera=camera, depth=depth, normal=normal, landmarks=None)

    fitted = poses().cpu()
    cameras = [view.camera.moved(pose.to(view.camera.cam_to_world)) for view, pose in zip(scene.train, fitted, strict=False)]
    if len(fitted) != len(scene.train):  # of more photographs than were fitted, none has a pose of its own
        cameras = [transform_camera(view.camera, similarity) for view in scene.train]
    back = torch.linalg.inv(similarity.matrix)
    points, mesh = scene.points, scene.mesh
    return replace(
        scene,
        train=tuple(moved(view, camera) for view, camera in zip(scene.train, cameras, strict=True)),
        **{
            split: tuple(moved(view, transform_camera(view.camera, similarity)) for view in getattr(scene, split))
            for split in ("val", "test", "observed")
        },
        points=None if points is None else replace(points, position=similarity.points(points.position).to(points.position)),
        mesh=None if mesh is None else mesh.transformed(similarity.matrix),
        world_from_local=(scene.world_from_local.double() @ back).to(scene.world_from_local),
    )


class PosedEvaluation:
    """Test cameras, geometry and pose errors of a fit with refined poses, for its evaluation.

    Args:
        poses: of the fit.
        scene: as loaded, its poses not degraded.
        model: fitted.
    """

    def __init__(self, poses: Poses, scene: Scene, model: Model) -> None:
        self._scene, self._model, self._config = scene, model, poses.config
        self.errors = training_errors(poses, scene)
        self._world_to_fit = self.errors.similarity.inverse()

    def camera(self, view: View) -> Camera:
        """Camera of a test view in the fit's frame, refined to its photograph if the settings enable it."""
        start = transform_camera(view.camera, self._world_to_fit)
        if not self._config.test_steps:
            return start
        descent = PoseDescent(self._config.test_steps)
        return refine_pose(self._model, replace(view, camera=start), self._scene, descent)

    def to_scene_frame(self, picture: Rendering, used: Camera, view: View) -> Rendering:
        """Convert a rendering's depth to the scene's units and its normals to the scene's frame."""
        turn = view.camera.cam_to_world[:3, :3] @ used.cam_to_world[:3, :3].T
        normal: Tensor | None = None if picture.normal is None else picture.normal @ turn.T
        return replace(picture, depth=picture.depth * self.errors.scale, normal=normal)

    def quality(self) -> dict[str, Score]:
        """Scores of the poses: medians over the training views, with their largest values."""
        found = {
            POSE_ROTATION: (self.errors.rotation_degrees, "deg"),
            POSE_TRANSLATION: (self.errors.translation_per_cent, "%"),
        }
        return {
            name: Score(
                mean=float(values.quantile(0.5)),
                joined="median over training views",
                max=float(values.max()),
                unit=unit,
                higher_is_better=False,
                per_training_view=tuple(values.tolist()),
            )
            for name, (values, unit) in found.items()
        }
