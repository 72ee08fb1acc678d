"""Methods that suit a scene: those that a comparison takes by itself, and what a fit in an open space may try instead."""

from __future__ import annotations

from invgraphics.core import Scene
from invgraphics.recipes.recipe import Method, split_name

CLOSED = ("volumetric/nerf", "volumetric/hash", "splatting/gaussians")
"""One method of each large family, for scenes in a box and for objects that are cut out."""
OPEN = ("volumetric/hash-proposal", "splatting/gaussians")
"""Those for photographs of a place: a network of octaves alone would not be far after minutes."""


def is_open_space(scene: Scene) -> bool:
    """Whether a scene is opaque photographs of a space without end."""
    return scene.bounds.space == "contracted" and not scene.has_alpha


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
    """Suggest, in a sentence, the ray-marched method for open spaces in place of one that is not; else empty."""
    sampler = method.table["renderer"].get("sampler")
    name = split_name(method.name)[0]
    if not is_open_space(scene) or sampler is None or sampler.get("type") == "proposals" or not name.startswith("volumetric/"):
        return ""
    return f"{OPEN[0]} is made for open spaces such as this, where {name} may leave fog."
