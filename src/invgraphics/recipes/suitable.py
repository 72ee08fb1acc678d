"""Methods that suit a scene: those that a comparison takes by itself, and what a fit in an open space may try instead."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from invgraphics.recipes.recipe import Method, split_name

if TYPE_CHECKING:  # a report, which imports no torch, reads this module too
    from invgraphics.core import Scene

CLOSED = ("volumetric/nerf", "volumetric/hash", "splatting/gaussians")
"""One method of each large family, for scenes in a box and for objects that are cut out."""
OPEN = ("volumetric/hash-proposal", "splatting/gaussians")
"""Those for photographs of a place: a network of octaves alone would not be far after minutes."""
FEW = 30
"""Fewer training photographs of a place than this leave fog to all ray-marched methods. With the 20 of colmap_statue proposals
were 1.3 dB behind the occupancy grid, with the 43 of fox 1.1 dB ahead; Gaussians led both (160 px, 600 steps, before rays
ended at points)."""


def is_open_space(scene: Scene) -> bool:
    """Whether a scene is opaque photographs of a space without end."""
    return scene.bounds.space == "contracted" and not scene.has_alpha


def starts_from_points(table: Mapping[str, Any]) -> bool:
    """Whether a recipe's primitives, or its occupancy grid, start from the scene's points."""
    sampler = table.get("renderer", {}).get("sampler", {})
    return table.get("field", {}).get("init") == "scene" or sampler.get("points_until", 0) > 0


def default_methods(scene: Scene) -> tuple[tuple[str, ...], str]:
    """Methods for a comparison that names none, and the reason in words.

    Args:
        scene: as loaded.

    Returns:
        Their names, and why these: of a kind to follow "chosen for".
    """
    if is_open_space(scene):
        return OPEN, "an open space: a hash grid sampled by proposals in a contracted space, and Gaussians with a backdrop"
    kind = "an object that is cut out" if scene.has_alpha else "a scene in a box"
    return CLOSED, f"{kind}: one method of each large family"


def suggestion(method: Method, scene: Scene) -> str:
    """Suggest, in a sentence, what suits an open space better than a ray-marched method; empty where there is no such thing.

    That is points to end its rays, where none are known; else Gaussians where photographs are few, and a method with proposals.
    """
    sampler = method.table["renderer"].get("sampler")
    name = split_name(method.name)[0]
    if not is_open_space(scene) or sampler is None or not name.startswith("volumetric/"):
        return ""
    # At disturbed poses none could be triangulated.
    if all(view.landmarks is None and view.ground_truth_pose is None for view in scene.train):
        return f"--set data.init=sfm finds points in the photographs, where rays then end: without any, {name} may leave fog."
    if len(scene.train) < FEW and scene.points is not None:
        start = f"starts from the {len(scene.points):,} known points"
        return f"{OPEN[1]}, which {start}: from {len(scene.train)} photographs of an open space {name} may leave fog."
    if sampler.get("type") == "proposals":
        return ""
    return f"{OPEN[0]} is made for open spaces such as this, where {name} may leave fog."
