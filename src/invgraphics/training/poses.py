"""Camera poses optimised together with the scene (BARF, Lin et al. 2021): a small rigid motion per training view.

Photographs know the world only up to a similarity: moving all cameras and the scene together changes no picture (the gauge).
No view is held fixed to decide it. The fit may drift along with its cameras, so comparisons align first, see
`invgraphics.metrics.poses`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from invgraphics.core import Camera, Model, Scene
from invgraphics.core.transforms import se3_exp
from invgraphics.fields.encodings.window import Windowed
from invgraphics.training.batches import BatchConfig
from invgraphics.training.optimiser import GroupConfig, OptimiserConfig
from invgraphics.training.views.exposure import ExposureConfig
from invgraphics.training.views.sparse_depth import SparseDepthConfig


@dataclass(frozen=True)
class PosesConfig:
    """Refinement of the training cameras' poses. Everything follows the fit's progress.

    The rates are those of a view that every step sees. Where steps see one in n they are √n times as high: fewer steps must do,
    each of them with a gradient of its own instead of a mean.

    Attributes:
        optimise: whether poses are refined at all; for studies that compare with and without.
        rotation_lr: learning rate of rotations at the start, radians.
        rotation_final: at the end.
        translation_lr: learning rate of translations at the start, in units of the scene's extent.
        translation_final: at the end.
        rotation_warmup: part of the fit over which the rate of rotations rises from 1% to its value. They come later than
            translations: the detail that distinguishes a turn about the scene from a shift is absent while the scene is a blur.
        translation_warmup: the same of translations.
        window: progress at which the finer levels of frequency and hash encodings begin to come in, and at which all are in
            (BARF: 0.1 and 0.5).
        resolution: image scales of the photographs, the last from the window's end on, which blur what encodings without such
            levels see; for recipes that have no such schedule in ``batches``.
        test_steps: steps that refine each test view's pose to its photograph before it is scored (BARF: 100).
    """

    optimise: bool = True
    rotation_lr: float = 5e-3
    rotation_final: float = 2e-4
    translation_lr: float = 3e-3
    translation_final: float = 5e-5
    rotation_warmup: float = 0.3
    translation_warmup: float = 0.02
    window: tuple[float, float] = (0.1, 0.5)
    resolution: tuple[float, ...] = (0.25, 0.5, 1.0)
    test_steps: int = 100

    def __post_init__(self) -> None:
        if not all(rate > 0 for rate in (self.rotation_lr, self.rotation_final, self.translation_lr, self.translation_final)):
            raise ValueError("learning rates must be positive.")
        if not 0 <= self.window[0] <= self.window[1] <= 1:
            raise ValueError(f"'window' must hold two rising progress values in [0, 1], not {list(self.window)}.")
        if not (0 <= self.rotation_warmup <= 1 and 0 <= self.translation_warmup <= 1) or self.test_steps < 0:
            raise ValueError("warm-ups must be in [0, 1], and 'test_steps' at least 0.")
        if not self.resolution or not all(0 < scale <= 1 for scale in self.resolution):
            raise ValueError("'resolution' must hold scales in (0, 1].")

    def alpha(self, progress: float) -> float:
        """Coarse-to-fine parameter of the encodings: share of the levels in use, from 0 to 1 (BARF, equation 14)."""
        start, end = self.window
        return min(max((progress - start) / max(end - start, 1e-9), 0.0), 1.0)

    def optimiser(self, config: OptimiserConfig, view_share: float) -> OptimiserConfig:
        """The recipe's optimiser with two more groups, for rotations and translations.

        Args:
            config: the recipe's.
            view_share: share of the training views in one step's batch, in (0, 1].
        """
        factor = view_share**-0.5
        own = {
            "pose_rotations": GroupConfig(
                "poses.rotation", factor * self.rotation_lr, factor * self.rotation_final, warmup=self.rotation_warmup
            ),
            "pose_translations": GroupConfig(
                "poses.translation",
                factor * self.translation_lr,
                factor * self.translation_final,
                warmup=self.translation_warmup,
                per_extent=True,
            ),
        }
        return replace(config, groups=config.groups | own)

    def batches(self, config: BatchConfig) -> BatchConfig:
        """The recipe's batches, with this schedule of image scales where they have none."""
        if config.until or len(self.resolution) == 1:
            return config
        start, end = self.window
        gaps = len(self.resolution) - 2
        until = [start + (end - start) * i / gaps for i in range(gaps + 1)] if gaps else [end]
        return replace(config, resolution=self.resolution, until=tuple(until))


@dataclass(frozen=True)
class TrainingConfig:
    """Options of a fit beside field, renderer and losses: what is optimised with the scene, and what is known of its depth.

    Attributes:
        poses: the training cameras' poses; ``None`` takes them as they are given.
        exposure: an exposure of each training view; ``None`` fits them where photographs are found to differ.
        sparse_depth: supervision by points of structure from motion; ``None`` takes it where photographs of an open space came
            with some.
    """

    poses: PosesConfig | None = None
    exposure: ExposureConfig | None = None
    sparse_depth: SparseDepthConfig | None = None


class Poses(nn.Module):
    """Poses of n training views: the given ones times a rigid motion in the camera's frame, initially the identity.

    The motion rotates about the point of the optical axis that is level with the scene's centre. A rotation about the camera's
    own centre would be almost collinear with a translation, and descent slow along the valley between the two.

    Attributes:
        config: settings.
        rotation: rotation vectors of the motions, radians.
        translation: their translations, local units.
        given: what the fit starts from.
        reference: the true poses, where they are known; the given ones elsewhere.
        pivot: depth of the points about which the motions turn, local units.
    """

    given: Float[Tensor, "n 4 4"]
    reference: Float[Tensor, "n 4 4"]
    pivot: Float[Tensor, " n"]

    def __init__(
        self, config: PosesConfig, given: Float[Tensor, "n 4 4"], reference: Float[Tensor, "n 4 4"], pivot: Float[Tensor, " n"]
    ) -> None:
        super().__init__()
        self.config = config
        self._lenses: tuple[Camera, ...] = ()
        # Of each view apart, so that Adam keeps a view's moments for the steps that see it. With rows of one parameter, each
        # step would also move the views that it does not see, and so much further the fewer it sees.
        self.rotation = nn.ParameterList([nn.Parameter(torch.zeros(3)) for _ in given])
        self.translation = nn.ParameterList([nn.Parameter(torch.zeros(3)) for _ in given])
        self.register_buffer("given", given.clone())
        self.register_buffer("reference", reference.clone())
        self.register_buffer("pivot", pivot.clone())

    @staticmethod
    def of(config: PosesConfig, scene: Scene) -> Poses:
        """The unrefined poses of a scene's training views."""
        given = torch.stack([view.camera.cam_to_world for view in scene.train])
        reference = torch.stack([view.true_pose for view in scene.train])
        pivot = torch.stack([pivot_depth(view.camera, scene) for view in scene.train])
        poses = Poses(config, given, reference, pivot)
        poses._lenses = tuple(view.camera for view in scene.train)
        return poses

    @staticmethod
    def restored(config: PosesConfig, state: Mapping[str, Tensor]) -> Poses:
        """Poses from a checkpoint; without intrinsics, so `forward` works but `cameras` does not.

        Raises:
            RuntimeError: the state is that of something else.
        """
        n = len(state["given"])
        poses = Poses(config, torch.zeros(n, 4, 4), torch.zeros(n, 4, 4), torch.zeros(n))
        poses.load_state_dict(dict(state))
        return poses

    def forward(self, views: Int[Tensor, " k"] | None = None) -> Float[Tensor, "k 4 4"]:
        """Refined camera-to-world poses of some views, or of all; differentiable."""
        chosen = range(len(self.given)) if views is None else views.tolist()
        twist = torch.stack([torch.cat([self.rotation[view], self.translation[view]]) for view in chosen])
        given, pivot = (values if views is None else values[views] for values in (self.given, self.pivot))
        return given @ motion_about(twist, pivot)

    def cameras(self, views: Int[Tensor, " k"]) -> list[Camera]:
        """Refined cameras of some views, differentiable in their poses."""
        poses = self(views).unbind(dim=0)
        device = self.given.device
        return [self._lenses[int(view)].to(device).moved(pose) for view, pose in zip(views, poses, strict=True)]

    def camera(self, view: int) -> Camera:
        """The refined camera of one view, differentiable in its pose."""
        return self.cameras(torch.tensor([view], device=self.given.device))[0]


def make_poses(config: TrainingConfig | None, scene: Scene) -> Poses | None:
    """The training views' poses as parameters; ``None`` where the recipe takes them as given."""
    chosen = None if config is None else config.poses
    return Poses.of(chosen, scene) if chosen is not None and chosen.optimise else None


def pivot_depth(camera: Camera, scene: Scene) -> Float[Tensor, ""]:
    """Depth of the scene's centre along the optical axis; half the scene's radius for a camera that stands in the scene."""
    depth = (scene.bounds.centre.to(camera.position) - camera.position) @ camera.cam_to_world[:3, 2]
    return depth.clamp_min(scene.bounds.radius / 2)


def motion_about(twist: Float[Tensor, "*n 6"], depth: Float[Tensor, "*n"]) -> Float[Tensor, "*n 4 4"]:
    """Rigid motions in the cameras' frames from twists; they rotate about the points at ``depth`` on the optical axes."""
    motion = se3_exp(twist)
    zero = torch.zeros_like(depth)
    pivot = torch.stack([zero, zero, depth], dim=-1)[..., None]
    kept = torch.cat([torch.zeros_like(motion[..., :3]), torch.nn.functional.pad(pivot, (0, 0, 0, 1))], dim=-1)
    turned = torch.nn.functional.pad(motion[..., :3, :3] @ pivot, (3, 0, 0, 1))
    return motion + kept - turned


def coarse_to_fine_encodings(model: Model) -> list[Windowed]:
    """Encodings of the model whose finer levels can be faded in."""
    return [module for part in model.parts.values() for module in part.modules() if isinstance(module, Windowed)]
