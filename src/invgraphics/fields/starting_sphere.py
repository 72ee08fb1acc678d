"""Spheres that signed distances start as: solid before cameras, hollow around cameras that look out from within a scene."""

from __future__ import annotations

from invgraphics.core.scene import Scene

SOLID = 0.5
"""Radius of the solid sphere, in the box's smallest half-extent (NeuS)."""
FARTHER = 1.1
"""Least radius of the hollow sphere (MonoSDF) over the distance of the farthest camera."""
ENDLESS = 1.5
"""Radius of the hollow sphere in endless space, in half-extents of contracted space, which ends at 2."""


def hollow_radius(scene: Scene) -> float | None:
    """Radius in local units of the hollow sphere that a signed distance starts as around a scene's cameras.

    In a box at least its smallest half-extent; ``None`` for a solid sphere, which would blind cameras within.
    """
    if not scene.is_interior:
        return None
    half = float(scene.bounds.half.min())
    if scene.bounds.space == "contracted":
        return ENDLESS * half
    farthest = max(float((view.camera.position - scene.bounds.centre).norm()) for view in scene.train)
    return max(half, FARTHER * farthest)
