"""Notes of an imported scene on how its poses were found, on what contradicts them, and on converted colours."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from invgraphics.scenes.photos.maker import read_quality


def pose_notes(folders: Iterable[Path]) -> dict[str, str]:
    """Notes of a `Scene`: ``poses`` names the strategy, ``inconsistent_poses`` the failed consistency check, ``colour_profile``
    the profiles from which its photographs were converted to sRGB.

    Empty where none of ``folders`` holds a finished import; of several that do, the first counts.
    """
    quality = next((found for found in map(read_quality, folders) if found is not None), None)
    if quality is None:
        return {}
    notes = {"poses": str(quality["choice"])} if quality.get("choice") else {}
    consistency = quality.get("consistency")
    if isinstance(consistency, dict) and consistency.get("suspicious"):
        notes["inconsistent_poses"] = str(consistency.get("sentence") or "the poses contradict the matches")
    if quality.get("colour_profile"):
        notes["colour_profile"] = str(quality["colour_profile"])
    return notes
