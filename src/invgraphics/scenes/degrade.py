"""Degraded training data for studies: fewer, smaller, noisier or differently exposed photographs, poses with errors.

Points to start from belong to the training data: `TrainingData.init` says which. Points that came with a scene know all of its
photographs as they were, so that they are made again, by structure from motion, where photographs are left out or changed.

Test views are never changed. Every degradation is drawn per view from the run's seed, by a generator of its own, and grows
in proportion to its setting: two levels of one study share their random numbers, and leaving views out changes none that stay.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Points, Scene, View
from invgraphics.core.colour import linear_to_srgb, srgb_to_linear
from invgraphics.errors import InputError
from invgraphics.scenes.pictures.resize import wanted_size
from invgraphics.scenes.scales import check_scales, like, resized_view, scene_at
from invgraphics.scenes.silhouettes import points_inside
from invgraphics.scenes.validation import without_blank_views

COLOURS = {"black": (0.0, 0.0, 0.0), "grey": (0.5, 0.5, 0.5), "white": (1.0, 1.0, 1.0)}
"""Backgrounds that have a name."""

FEWEST_POINTS, ENOUGH_POINTS = 16, 5000
"""Fewer SfM points than the first are no start. Fewer than the second, as small pictures give them, are joined by as many
random ones, inside the silhouettes where photographs have alpha: a few hundred alone begin below a random start. PSNR of
`splatting/gaussians` at 128 px after 400 steps, bricks and textured: SfM 24.9 and 25.0 dB, random 27.1 and 25.6, both 27.2 and
26.3, both with silhouettes 28.4 and 27.7; exact points 29.1 and 28.6. After 1500 steps on bricks the start no longer matters:
SfM 31.2, random 31.4, both 31.5 and exact points 31.4 dB."""

KEEP = "random"
"""The background of a scene as loaded: its photographs keep their alpha, and each step draws a colour."""


@dataclass(frozen=True)
class TrainingData:
    """Degradations of the training data; the defaults change nothing.

    Attributes:
        train_views: number of training views, those farthest from each other first; a smaller choice is part of a larger one.
        size: longest side of the training photographs in pixels, by area average; test views keep theirs.
        pose_noise: root-mean-square error of training poses: so many degrees of rotation, about a random axis, and so many per
            cent of the scene's extent (`Scene.extent`) of position.
        photo_noise: standard deviation of Gaussian noise on each channel, as a share of white.
        exposure: standard deviation, in stops, of each photograph's exposure, applied to linear light.
        background: ``random`` keeps the photographs' alpha; a colour (``white``, ``grey``, ``black`` or [r, g, b] in [0, 1])
            puts every photograph in front of it and drops the alpha, and the fit composites over the same colour, given as
            displays show it. What is empty can then not be told from what has this colour: fits are slower and end lower.
        scales: divisors of the photographs' size; every training view is shown once at each (multiscale training of mip-NeRF).
            Rendered scenes are rendered at each size, photographs averaged (`invgraphics.scenes.scales`).
        test_scales: divisors at which the test views are scored besides their own size; the scores are ``psnr_at_1_2`` and so
            on. They degrade nothing.
        init: points that a field may start from: ``scene``, those that came with it (of a rendered scene: exact ones, which no
            method could have; of photographs: those of structure from motion); ``sfm``, triangulated from the training
            photographs at their poses, which every method could have, with random ones where they are few; ``random``, none.
        box: where an object is sought whose photographs have alpha: ``silhouettes``, in the box around these
            (`invgraphics.scenes.silhouettes.tightened`), ``scene``, in the data set's. It degrades nothing.
    """

    train_views: int | None = None
    size: int | None = None
    pose_noise: float = 0.0
    photo_noise: float = 0.0
    exposure: float = 0.0
    background: str | tuple[float, float, float] = KEEP
    scales: tuple[int, ...] = (1,)
    test_scales: tuple[int, ...] = ()
    init: Literal["scene", "sfm", "random"] = "scene"
    box: Literal["silhouettes", "scene"] = "silhouettes"

    @property
    def changes_photographs(self) -> bool:
        """Whether photographs are left out or changed, so that points made from all of them would leak what is withheld.

        Disturbed poses do not count: points triangulated at wrong poses, or random ones, start no refinement of poses.
        """
        return self.train_views is not None or self.size is not None or any((self.photo_noise, self.exposure))

    def __post_init__(self) -> None:
        for name in ("train_views", "size"):
            if (count := getattr(self, name)) is not None and count < 1:
                raise ValueError(f"'{name}' must be at least 1, not {count}.")
        for name in ("pose_noise", "photo_noise", "exposure"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"'{name}' must be 0 or more, not {getattr(self, name)}.")
        check_scales(self.scales, "scales")
        check_scales((1, *self.test_scales), "test_scales")
        if self.size is not None and self.scales != (1,):
            raise ValueError("'size' and 'scales' both resize the photographs: leave one out.")
        if isinstance(self.background, str):
            if self.background not in (KEEP, *COLOURS):
                raise ValueError(f"'background' is one of {KEEP}, {', '.join(COLOURS)}, or [r, g, b], not '{self.background}'.")
        elif not all(0 <= channel <= 1 for channel in self.background):
            raise ValueError(f"'background' has channels in [0, 1], not {list(self.background)}.")

    def changes(self) -> dict[str, object]:
        """Settings that differ from their defaults, as plain values by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if getattr(self, field.name) != field.default}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def check(self, scene: Scene) -> None:
        """Check that the settings can be applied to ``scene``.

        Raises:
            InputError: it has fewer views, smaller photographs, or no transparency to put a background behind.
        """
        if self.train_views is not None and self.train_views > len(scene.train):
            raise InputError(
                f"data.train_views = {self.train_views}, but '{scene.name}' has {len(scene.train)} training views.",
                "Give as many at most, or leave it out for all.",
            )
        largest = max(max(view.camera.width, view.camera.height) for view in scene.train)
        if self.size is not None and self.size > largest:
            raise InputError(
                f"data.size = {self.size}, but the photographs of '{scene.name}' are {largest} pixels long.",
                "Give a smaller one, or a larger --size.",
            )
        if self.background != KEEP and not scene.has_alpha:
            raise InputError(f"data.background has no effect on '{scene.name}': its photographs are opaque everywhere.")


def degrade(scene: Scene, data: TrainingData, seed: int) -> Scene:
    """Degrade a scene's training views: choice, pose errors, size, exposure, noise and background.

    Returns ``scene`` itself where ``data`` changes nothing.

    Args:
        scene: as loaded.
        data: what to change.
        seed: of all degradations.

    Raises:
        InputError: the scene cannot be changed like this (see `TrainingData.check`).
    """
    changes = data.changes()
    if not changes:
        return scene
    data.check(scene)
    chosen = chosen_views(scene, data.train_views)
    shown = [(scale, _at_scale(scene, scale)) for scale in data.scales]
    train = [
        _degraded(_named(views[index], scale), index, scene, data, seed)
        for scale, views in shown
        for index in chosen
        if index in views
    ]
    scene = without_blank_views(replace(scene, train=tuple(train)))
    train: Sequence[View] = scene.train
    done = [f"{name} = {value}" for name, value in changes.items() if name not in ("test_scales", "box")]
    notes = scene.notes | ({"training_data": ", ".join(done)} if done else {})
    if data.changes_photographs and notes.pop("exposures", None):
        scene = replace(scene, exposure_spread=None)  # estimated from all photographs as they were
    if data.changes_photographs or data.pose_noise or data.init != "scene":
        notes.pop("landmarks", None)  # of other photographs or poses, or not to be known
        train = [replace(view, landmarks=None) for view in train]
    if data.background != KEEP:
        colour = torch.tensor(COLOURS[data.background] if isinstance(data.background, str) else data.background)
        colour = srgb_to_linear(colour) if scene.colour == "linear" else colour
        train = [replace(view, image=like(view.over(colour), view), alpha=None) for view in train]
        scene = replace(scene, background=colour)
    return _with_points(replace(scene, train=tuple(train), notes=notes), data, seed)


def _with_points(scene: Scene, data: TrainingData, seed: int) -> Scene:
    """Replace a degraded scene's points by those that its own photographs give, and note which they are."""
    if data.init == "random":
        return replace(scene, points=None, notes=scene.notes | {"points": "none: a random start"})
    if data.init == "scene" and (scene.points is None or not data.changes_photographs):
        return scene
    from invgraphics.scenes.photos.triangulate import triangulated

    found = triangulated(scene)
    points = found.points
    if not data.pose_noise:
        known = zip(scene.train, found.observed, strict=True)
        scene = scene.with_views(train=tuple(replace(view, landmarks=points.position[rows]) for view, rows in known))
    what = f"{len(points):,} from SfM on the training photographs as they are here"
    # Silhouettes at disturbed poses have little in common.
    views = [] if data.pose_noise else [view for view in scene.train if view.alpha is not None]
    if len(points) < ENOUGH_POINTS:
        generator = _generator(seed, "points", 0)
        inside = points_inside(scene.bounds, views, ENOUGH_POINTS, generator)
        few = len(points) < FEWEST_POINTS
        if few and (not views or len(inside) == 0):
            return replace(scene, points=None, notes=scene.notes | {"points": f"{what}, too few: a random start"})
        more = Points(inside, torch.rand(inside.shape, generator=generator))
        points = more if few else points.joined(more)
        where = " inside the photographs' silhouettes" if views else ""
        what = f"{what}, {'too few: ' if few else 'and '}{len(more):,} random ones{where}"
    return replace(scene, points=points, notes=scene.notes | {"points": what})


def chosen_views(scene: Scene, count: int | None) -> list[int]:
    """Select ``count`` training views by farthest-point order; returns their indices, ascending.

    Farthest-point order (Gonzalez 1985) over position, in units of the scene's extent, and viewing direction; it begins with
    the view closest to the mean. The choice for fewer views is the beginning of the same order.
    """
    if count is None or count >= len(scene.train):
        return list(range(len(scene.train)))
    poses = torch.stack([view.camera.cam_to_world.double() for view in scene.train])
    features = torch.cat([poses[:, :3, 3] / scene.extent, poses[:, :3, 2]], dim=1)
    order = [int((features - features.mean(dim=0)).norm(dim=1).argmin())]
    distance = (features - features[order[0]]).norm(dim=1)
    while len(order) < count:
        order.append(int(distance.argmax()))
        distance = torch.minimum(distance, (features - features[order[-1]]).norm(dim=1))
    return sorted(order)


def _at_scale(scene: Scene, scale: int) -> dict[int, View]:
    """Training views at 1/``scale`` by their index; a mask may leave no pixel of one that small, which is then not there."""
    views = scene_at(scene, scale).train
    if len(views) == len(scene.train):
        return dict(enumerate(views))
    by_name = {view.name: view for view in views}
    return {index: by_name[view.name] for index, view in enumerate(scene.train) if view.name in by_name}


def _named(view: View, scale: int) -> View:
    return view if scale == 1 else replace(view, name=f"{view.name} at 1/{scale}")


def _degraded(view: View, index: int, scene: Scene, data: TrainingData, seed: int) -> View:
    """Degrade one training view: pose errors, resizing, then exposure and noise."""
    if data.pose_noise:
        generator = _generator(seed, "pose", index)
        # Three equal axes share the mean square.
        axis, shift = torch.randn(2, 3, generator=generator, dtype=torch.float64) / 3**0.5
        turn = _rotation(axis * torch.pi / 180 * data.pose_noise)
        pose = view.camera.cam_to_world.double().clone()
        pose[:3, :3] = pose[:3, :3] @ turn
        pose[:3, 3] += shift * scene.extent * data.pose_noise / 100
        wrong = view.camera.moved(pose.float())
        view = replace(view, camera=wrong, depth=None, normal=None, ground_truth_pose=view.true_pose)
    if data.size is not None:
        view = resized_view(view, *wanted_size(view.camera.width, view.camera.height, data.size))
    if data.exposure:
        stops = data.exposure * float(torch.randn((), generator=_generator(seed, "exposure", index)))
        view = _recoloured(view, scene, lambda colour: _exposed(colour, 2**stops, scene.colour == "linear"))
    if data.photo_noise:
        generator = _generator(seed, "photo", index)
        view = _recoloured(view, scene, lambda rgb: rgb + data.photo_noise * torch.randn(rgb.shape, generator=generator))
    return view


def _generator(seed: int, degradation: str, index: int) -> torch.Generator:
    """Seeded generator of one degradation of one view."""
    digest = hashlib.sha256(f"{degradation} {seed} {index}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))


def _rotation(vector: Float[Tensor, 3]) -> Float[Tensor, "3 3"]:
    """Rotation matrix of a rotation vector (axis times radians)."""
    x, y, z = vector.tolist()
    return torch.linalg.matrix_exp(vector.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))


def _recoloured(view: View, scene: Scene, change: Callable[[Tensor], Tensor]) -> View:
    colour = change(view.colour())
    return replace(view, image=like(colour if scene.colour == "linear" else colour.clamp_max(1), view))


def _exposed(colour: Float[Tensor, "*p"], gain: float, linear: bool) -> Float[Tensor, "*p"]:
    return colour * gain if linear else linear_to_srgb(srgb_to_linear(colour) * gain)
