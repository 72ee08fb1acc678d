"""Scenes by names that other processes open: as they were opened, or as copies in the folder of what is made of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor

from invgraphics.core import Scene, View
from invgraphics.errors import InputError
from invgraphics.runs.folder import SCENE_COPY
from invgraphics.scenes.npz_writer import save_npz, unsupported_parts
from invgraphics.scenes.open import SceneOptions, open_scene, source_of

CAMERA = ("cam_to_world", "focal", "principal_point")
"""Tensors of a camera; its size is that of the picture."""


class ReuseOptions(TypedDict, total=False):
    """Options of a comparison or study whose folder holds fits of an earlier call.

    Attributes:
        keep: whether finished fits stay although code or packages have changed since.
    """

    keep: bool


def reopenable_scene(scene: Scene, folder: Path) -> tuple[Scene, dict[str, Any]]:
    """Scene and name by which other processes open it: as it was opened, or as a copy written to ``folder``.

    Raises:
        InputError: the scene was made in Python and cannot be kept, or the folder holds another one.
    """
    source = source_of(scene)
    if source is not None and (source.options.train_views, source.options.seed) == (None, 0):
        options = source.options
        return scene, {"scene": source.spec, "size": options.size, "test_views": options.test_views, "spp": options.spp}
    path, present = folder / SCENE_COPY, (folder / SCENE_COPY).is_file()
    if not present:
        save_npz(scene, path)
    elif beyond := unsupported_parts(scene):
        raise InputError(f"{path} holds another scene: this one has {beyond}.", "Choose another out.")
    kept = open_scene(str(path), SceneOptions(test_views=None))
    if present and not _same(scene, kept):
        raise InputError(f"{path} holds another scene.", "Choose another out.")
    return kept, {"scene": str(path), "test_views": None}


def _same(one: Scene, other: Scene) -> bool:
    """Whether two scenes are equal in all that a file keeps.

    What is read may differ by rounding: poses are re-orthonormalised, colours of points have 8 bits.
    """
    for split in ("train", "val", "test", "observed"):
        views, others = getattr(one, split), getattr(other, split)
        if len(views) != len(others) or not all(_same_view(a, b) for a, b in zip(views, others, strict=True)):
            return False
    box = all(_close(getattr(one.bounds, corner), getattr(other.bounds, corner)) for corner in ("lo", "hi"))
    if (one.points is None) != (other.points is None) or not box:
        return False
    if one.points is None or other.points is None:
        return True
    return _close(one.points.position, other.points.position) and _close(one.points.rgb.clamp(0, 1), other.points.rgb, 1 / 255)


def _same_view(one: View, other: View) -> bool:
    exact = all(_close(getattr(one, part), getattr(other, part), 0.0) for part in ("image", "alpha"))
    cameras = all(_close(getattr(one.camera, part), getattr(other.camera, part)) for part in CAMERA)
    return (
        exact
        and cameras
        and one.subject == other.subject
        and _close(one.depth, other.depth)
        and _close(one.normal, other.normal)
    )


def _close(one: Tensor | None, other: Tensor | None, most: float = 1e-5) -> bool:
    """Whether two tensors have equal shapes and differ by at most ``most``; ``None`` equals itself alone."""
    if one is None or other is None:
        return one is other
    return one.shape == other.shape and torch.allclose(one.double(), other.double(), rtol=1e-6, atol=most)
