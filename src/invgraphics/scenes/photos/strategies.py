"""Reconstruction strategies on the same features and matches, in the order in which they are tried.

Each answers a known weakness of the one before. The incremental mapper stands or falls with its first pair and with the focal
length that it guesses for photographs without EXIF; the global mapper averages rotations over all pairs instead. Focal lengths
calibrated from the fundamental matrices of all pairs, and an initial pair of larger parallax, mend the incremental mapper's
beginning. A wrong lens model bends the whole; guided matching adds matches where few were found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from invgraphics.scenes.photos.job import PhotoJob
from invgraphics.scenes.photos.prepare import Prepared

INITIAL_ANGLE, WIDE_ANGLE = 16.0, 32.0
"""Smallest triangulation angle of the initial pair in degrees: COLMAP's default, and that of a second try."""


@dataclass(frozen=True)
class Strategy:
    """One way to reconstruct.

    Attributes:
        mapper: ``incremental`` or ``global``.
        lens: name of the lens model, see `invgraphics.scenes.photos.job.MODELS`.
        calibrated: focal lengths that are not known are taken from the view graph before the first pair is placed.
        initial_angle: smallest triangulation angle of the incremental mapper's initial pair, degrees.
        guided: overlapping photographs are matched again along their epipolar lines.
    """

    mapper: str
    lens: str
    calibrated: bool = False
    initial_angle: float = INITIAL_ANGLE
    guided: bool = False

    @property
    def name(self) -> str:
        """Its name in reports."""
        words = [f"{self.mapper} mapper", f"{self.lens} lens"]
        words += ["focal length from the view graph"] if self.calibrated else []
        words += [f"initial pair at {self.initial_angle:.0f}° or more"] if self.initial_angle != INITIAL_ANGLE else []
        words += ["guided matching"] if self.guided else []
        return ", ".join(words)


def strategies(job: PhotoJob, photos: Sequence[Prepared]) -> tuple[Strategy, ...]:
    """Ordered strategies for a job: the requested one first, then the alternatives that its settings leave open."""
    straight = all(photo.centre is not None for photo in photos)  # a data set's calibrated pinholes
    lens = "radial" if job.lens == "auto" else job.lens
    if straight:
        lens = "pinhole"
    others = ["pinhole", "opencv"] if job.lens == "auto" and not straight else [lens, lens]
    tries = [
        Strategy("incremental", lens),
        Strategy("global", lens),
        Strategy("incremental", lens, calibrated=True, initial_angle=WIDE_ANGLE),
        Strategy("global" if job.mapper == "auto" else job.mapper, others[1]),
        Strategy("incremental" if job.mapper == "auto" else job.mapper, others[0]),
        Strategy("incremental" if job.mapper == "incremental" else "global", lens, guided=True),
    ]
    return tuple(dict.fromkeys(row for row in tries if job.mapper in ("auto", row.mapper)))
