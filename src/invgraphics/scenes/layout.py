"""From photographs with cameras to a scene: which views train, which are scored, and how they are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from invgraphics.core import Points, Scene, View
from invgraphics.core.transforms import apply_similarity, transform_points
from invgraphics.errors import InputError
from invgraphics.scenes.border import background_of, masking_blank
from invgraphics.scenes.pictures.images import Photo, file_exists, match_sizes, profiles_note
from invgraphics.scenes.pictures.masks import masks_note
from invgraphics.scenes.pictures.resize import RESIZE, wanted_size
from invgraphics.scenes.pictures.views import load_view
from invgraphics.scenes.region import LocalFrame

T = TypeVar("T")

HOLD_OUT = 8
"""One photograph in eight is scored, the first included (LLFF's rule, which later work kept)."""

IMAGE_FOLDERS = ("images", "input", "images_2", "images_4", "images_8")
"""What people call the folder of a scene's photographs, the most telling first; a number is how much smaller they are."""

_HOLDERS = ("sparse", "dense", "colmap", "undistorted", "distorted")  # folders of a COLMAP workspace, which name no scene


@dataclass(frozen=True)
class SceneOptions:
    """Options of opening a scene: picture size, numbers of views, samples per pixel.

    Attributes:
        size: longest side in pixels, or (width, height); ``None`` leaves pictures as they are.
        test_views: number of views to score, evenly spaced among those held out (of a rendered scene the
            first, which are even); ``None`` means all.
        train_views: number of views to fit, likewise.
        seed: seed of whatever has to be rendered first.
        spp: samples per pixel of the training views of a scene that is rendered; ``None`` for what its description says.
    """

    size: int | tuple[int, int] | None = None
    test_views: int | None = 16
    _: KW_ONLY
    train_views: int | None = None
    seed: int = 0
    spp: int | None = None

    def __post_init__(self) -> None:
        sides = self.size if isinstance(self.size, tuple) else (self.size,)
        if any(side is not None and side < 1 for side in sides):
            raise InputError(f"The size {self.size} is not positive.")
        for name, what in (("test_views", "test views"), ("train_views", "train views"), ("spp", "samples per pixel")):
            if (count := getattr(self, name)) is not None and count < 1:
                raise InputError(f"The number of {what} must be at least 1, not {count}.")


@dataclass(frozen=True, eq=False)
class Split:
    """Photographs of each split.

    Attributes:
        train: to fit.
        test: to score.
        val: to monitor during a fit.
        rule: how the splits were determined, for the scene's notes.
    """

    train: Sequence[Photo]
    test: Sequence[Photo]
    val: Sequence[Photo] = ()
    rule: str = ""

    @property
    def photos(self) -> list[Photo]:
        """Photographs of all splits."""
        return [*self.train, *self.val, *self.test]


def is_image_folder(path: Path) -> bool:
    """Whether a folder's name is one that conventionally holds a scene's photographs."""
    return path.name in IMAGE_FOLDERS


def scene_name(path: Path) -> str:
    """Name of a data set: of the first folder upwards that is not conventional (``sparse/0``, ``images``)."""
    folder = path.resolve()
    for each in (folder, *folder.parents):
        model = (each.name.isdecimal() and each.parent.name in _HOLDERS) or each.parent.name == "sparse"
        if each.name and not model and each.name not in _HOLDERS and not is_image_folder(each):
            return each.name
    return folder.name or "scene"


def every_eighth(photos: Sequence[Photo]) -> Split:
    """Split photographs in name order: every eighth is a test view, the others train (LLFF).

    Those with the very pose of a test view, as at the end of a full turn, are left out.

    Raises:
        InputError: none is left to fit.
    """
    ordered = sorted(photos, key=lambda photo: photo.name)
    test = ordered[::HOLD_OUT]
    others = [photo for index, photo in enumerate(ordered) if index % HOLD_OUT]
    if not others:
        raise InputError(f"{len(ordered)} photograph is too few: at least one to fit and one to score are needed.")
    scored = torch.stack([photo.camera.cam_to_world for photo in test])
    train = [photo for photo in others if not bool((scored == photo.camera.cam_to_world).all(dim=(1, 2)).any())]
    if not train:
        raise InputError("All photographs have the poses of those to be scored.", "Poses of the photographs are needed.")
    left = f"; {len(others) - len(train)} with the pose of one of them are left out" if len(train) < len(others) else ""
    return Split(train, test, rule=f"every {HOLD_OUT}th photograph by name{left}")


def evenly(items: Sequence[T], count: int | None) -> list[T]:
    """Select ``count`` evenly spaced items, in the middle of equal parts; all of them if there are no more."""
    if count is None or count >= len(items):
        return list(items)
    return [items[int((index + 0.5) * len(items) / count)] for index in range(count)]


def existing_photos(photos: Sequence[Photo], source: Path) -> tuple[list[Photo], dict[str, str]]:
    """Select the photographs whose files exist; also returns a note about missing ones.

    Raises:
        InputError: none of them exists.
    """
    found = [photo for photo in photos if file_exists(photo.path)]
    absent = [photo.name for photo in photos if not file_exists(photo.path)]
    if not found:
        raise InputError(
            f"None of the {len(photos)} pictures that {source} lists exists.", f"Looked for {photos[0].path} first."
        )
    if not absent:
        return found, {}
    shown = ", ".join(absent[:5]) + (", ..." if len(absent) > 5 else "")
    return found, {"missing": f"{len(absent)} of {len(photos)} listed files are absent: {shown}"}


def compose(name: str, split: Split, frame: LocalFrame, options: SceneOptions, notes: dict[str, str]) -> Scene:
    """Read the chosen photographs and compose the scene: cameras in the local frame, bounds, background, notes.

    Scenes with alpha are declared to be on white, those whose pictures have a plain border on its colour, others on black.
    """
    if not split.test:
        raise InputError(f"{name} has no photographs to score.")
    chosen = replace(split, train=evenly(split.train, options.train_views), test=evenly(split.test, options.test_views))
    notes = notes | {
        "split": split.rule,
        "train_views": f"{len(chosen.train)} of {len(split.train)}, evenly spaced",
        "test_views": f"{len(chosen.test)} of {len(split.test)}, evenly spaced",
    }
    photos = match_sizes(chosen.photos)
    views = _read(photos, torch.linalg.inv(frame.world_from_local), options.size)
    if frame.bounds.space == "contracted":
        views, blank = masking_blank(views)
        notes |= blank
    lenses = sorted({photo.lens.model for photo in photos if photo.lens is not None})
    if lenses:
        notes["undistortion"] = f"{', '.join(lenses)} removed at full size (bilinear), zoomed in until no pixel is blank"
    notes |= masks_note(photos) | profiles_note(photos)
    notes["resize"] = _resize_note(photos, views)
    first_test, first_val = len(views) - len(chosen.test), len(chosen.train)
    return Scene(
        name=name,
        train=tuple(views[:first_val]),
        val=tuple(views[first_val:first_test]),
        test=tuple(views[first_test:]),
        background=background_of(views),
        bounds=frame.bounds,
        points=local_points(frame),
        world_from_local=frame.world_from_local.float(),
        notes=notes,
    )


def local_points(frame: LocalFrame) -> Points | None:
    """Transform the frame's points from the world to the local frame; ``None`` without points."""
    if frame.points is None:
        return None
    position = transform_points(torch.linalg.inv(frame.world_from_local), frame.points.position.double())
    return Points(position.float(), frame.points.rgb.float())


def _read(photos: Sequence[Photo], local_from_world: Float[Tensor, "4 4"], size: int | tuple[int, int] | None) -> list[View]:
    """Read photographs one at a time, keeping only their final pixels.

    Those have their place before the first picture is read: allocated in between, they would be scattered among the large
    work arrays and keep the C library from using that space again (1 GB for a hundred photographs of 1 MP).
    """
    sizes = [wanted_size(photo.camera.width, photo.camera.height, size) for photo in photos]
    places = [(torch.empty(h, w, 3, dtype=torch.uint8), torch.empty(h, w, dtype=torch.uint8)) for w, h in sizes]
    views = []
    for photo, (image, alpha) in zip(photos, places, strict=True):
        camera = photo.camera.moved(apply_similarity(local_from_world, photo.camera.cam_to_world))
        view = load_view(replace(photo, camera=camera), size)
        coverage = None if view.alpha is None else alpha.copy_(view.alpha)
        views.append(replace(view, image=image.copy_(view.image), alpha=coverage))
    return views


def _resize_note(photos: Sequence[Photo], views: Sequence[View]) -> str:
    changes = {
        f"{photo.camera.width}x{photo.camera.height} to {view.camera.width}x{view.camera.height}"
        for photo, view in zip(photos, views, strict=True)
        if (photo.camera.width, photo.camera.height) != (view.camera.width, view.camera.height)
    }
    return f"{RESIZE}, {', '.join(sorted(changes))}" if changes else "none"
