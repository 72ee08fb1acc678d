"""Notes of an imported scene on how its poses were found, and on what contradicts them."""

from __future__ import annotations

from pathlib import Path

from invgraphics.scenes.photos.maker import read_quality


def pose_notes(folder: Path) -> dict[str, str]:
    """Notes of a `Scene`: ``poses`` names the strategy, ``suspicion`` the failed consistency check where there is one.

    Empty where ``folder`` holds no finished import.
    """
    quality = read_quality(folder)
    if quality is None:
        return {}
    notes = {"poses": str(quality["choice"])} if quality.get("choice") else {}
    suspicion = quality.get("suspicion")
    if isinstance(suspicion, dict) and suspicion.get("suspicious"):
        notes["suspicion"] = str(suspicion.get("sentence") or "the poses contradict the matches")
    return notes
