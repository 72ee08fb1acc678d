"""Evaluation of a fit that chose its training poses: both worlds are aligned, and test views look for their own poses.

The fit may have drifted by a similarity, so the undisturbed test poses are carried into its world by the one between true and
refined training poses. What remains of their errors belongs to the cameras rather than to the scene, so each is refined
to its photograph before it is scored (BARF, §4.1).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from invgraphics.core import Camera, Field, Renderer, Rendering, Scene, View
from invgraphics.metrics.poses import PoseErrors, Similarity, pose_errors
from invgraphics.recipes.recipe import Method
from invgraphics.runs.scores import Score
from invgraphics.training.localise import Descent, descend
from invgraphics.training.poses import Poses, PosesConfig


def protocol_note(method: Method) -> str:
    """How test poses are treated, in words for a table of the protocol; empty where poses are taken as given."""
    config = optimised(method)
    if config is None:
        return ""
    refined = f", then refined for {config.test_steps} steps to each test photograph" if config.test_steps else ""
    return f"aligned by the similarity between refined and true training poses{refined}"


def optimised(method: Method) -> PosesConfig | None:
    """The settings under which a method refines poses, if it does."""
    training = method.recipe.training
    return training.poses if training is not None and training.poses is not None and training.poses.optimise else None


@torch.no_grad()
def training_errors(poses: Poses, scene: Scene) -> PoseErrors:
    """Errors of the refined training poses after alignment, in shares of the scene's extent."""
    return pose_errors(poses().cpu(), poses.reference.cpu(), scene.extent)


def into_fit(poses: Poses, scene: Scene) -> Similarity:
    """From the scene's frame into the one that the fit's cameras have drifted to."""
    return inverse(training_errors(poses, scene).similarity)


def inverse(similarity: Similarity) -> Similarity:
    """The way back."""
    back = similarity.rotation.T
    return Similarity(1 / similarity.scale, back, -(back @ similarity.translation) / similarity.scale)


def carried(camera: Camera, similarity: Similarity) -> Camera:
    """A camera in another world."""
    return camera.moved(similarity.poses(camera.cam_to_world).to(camera.cam_to_world))


@torch.no_grad()
def scene_of_fit(poses: Poses, scene: Scene) -> Scene:
    """A scene in the frame that the fit has drifted to, for whoever looks at the fit: training cameras as they were refined,
    all else carried along. Its ``world_from_local`` leads to the same world as before."""
    errors = training_errors(poses, scene)
    similarity = inverse(errors.similarity)

    def moved(view: View, camera: Camera) -> View:
        turn = (camera.cam_to_world @ torch.linalg.inv(view.camera.cam_to_world))[:3, :3]
        turn = turn / torch.linalg.det(turn) ** (1 / 3)
        depth = None if view.depth is None else view.depth / errors.scale
        normal = None if view.normal is None else view.normal @ turn.T
        return replace(view, camera=camera, depth=depth, normal=normal)

    refined = zip(scene.train, poses().cpu(), strict=True)
    back = torch.linalg.inv(similarity.matrix)
    points, mesh = scene.points, scene.mesh
    return replace(
        scene,
        train=tuple(moved(view, view.camera.moved(pose.to(view.camera.cam_to_world))) for view, pose in refined),
        val=tuple(moved(view, carried(view.camera, similarity)) for view in scene.val),
        test=tuple(moved(view, carried(view.camera, similarity)) for view in scene.test),
        points=None if points is None else replace(points, position=similarity.points(points.position).to(points.position)),
        mesh=None if mesh is None else replace(mesh, vertices=similarity.points(mesh.vertices).to(mesh.vertices)),
        world_from_local=(scene.world_from_local.double() @ back).to(scene.world_from_local),
    )


class PosedEvaluation:
    """Stands between a fit with refined poses and its evaluation.

    Args:
        poses: of the fit.
        scene: undisturbed.
        model: fitted field and renderer.
    """

    def __init__(self, poses: Poses, scene: Scene, model: tuple[Field, Renderer]) -> None:
        self._scene, self._model, self._config = scene, model, poses.config
        self.errors = training_errors(poses, scene)
        self._into_fit = inverse(self.errors.similarity)

    def camera(self, view: View) -> Camera:
        """Where a test view's photograph was taken, in the fit's world."""
        start = carried(view.camera, self._into_fit)
        if not self._config.test_steps:
            return start
        descent = Descent(self._config.test_steps)
        return descend(self._model, replace(view, camera=start), self._scene, descent)

    def as_seen(self, picture: Rendering, used: Camera, view: View) -> Rendering:
        """A picture's geometry in the scene's frame and units: distances scaled, normals turned with the camera."""
        turn = view.camera.cam_to_world[:3, :3] @ used.cam_to_world[:3, :3].T
        normal: Tensor | None = None if picture.normal is None else picture.normal @ turn.T
        return replace(picture, depth=picture.depth * self.errors.scale, normal=normal)

    def quality(self) -> dict[str, Score]:
        """Scores of the poses: medians over the training views, with their largest values."""
        found = {
            "pose_rotation_deg": (self.errors.rotation_degrees, "deg"),
            "pose_translation_percent": (self.errors.translation_per_cent, "%"),
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
