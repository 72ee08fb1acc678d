"""``PHOTO-located.json``: the estimated camera pose of a photograph in a fitted scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from invgraphics.runs.schema import Record

Row = tuple[float, float, float, float]

AXES = "OpenCV: +x right, +y down, +z forward; the data set's world"


@dataclass(frozen=True, kw_only=True)
class Start:
    """An initial pose of the search, with its loss after each round.

    Attributes:
        start: index among all starts.
        loss_at_start: mean squared difference of colours in [0, 1], at the coarsest scale.
        rounds: likewise after each round that it took part in: image scale -> loss.
    """

    start: int
    loss_at_start: float
    rounds: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class PoseError:
    """Pose error against a known pose: degrees, and per cent of the scene's extent."""

    rotation_deg: float
    translation_percent: float


@dataclass(frozen=True, kw_only=True)
class Location(Record):
    """Estimated pose of a photograph. Schema 1 had a start's rounds beside its other keys.

    Attributes:
        photo: its file, as given.
        run: folder of the fit, as given.
        method: ``renderer/recipe`` of the fit.
        cam_to_world: rigid 4x4, row by row, in the data set's world.
        axes: of the camera, in words.
        focal: focal lengths in pixels, x and y.
        size: width and height of the photograph as it was compared, px.
        loss: mean squared difference of colours in [0, 1].
        psnr: the same in dB.
        starts: that were followed.
        test_view: the test view that shows the same pixels, if there is one.
        error: against that view's pose.
    """

    SCHEMA: ClassVar[int] = 2

    photo: str
    run: str
    method: str
    cam_to_world: tuple[Row, Row, Row, Row]
    axes: str = AXES
    focal: tuple[float, float]
    size: tuple[int, int]
    loss: float
    psnr: float
    starts: tuple[Start, ...]
    test_view: str | None = None
    error: PoseError | None = None

    @classmethod
    def migrate(cls, table: dict[str, Any], schema: int) -> dict[str, Any]:
        """Convert schema 1, which had ``loss_at_scale_S`` in place of the entry ``S`` of ``rounds``."""
        starts = table.get("starts")
        if not isinstance(starts, list) or not all(isinstance(one, dict) for one in starts):
            return table
        mark = "loss_at_scale_"
        rounds = [{key.removeprefix(mark): one[key] for key in one if key.startswith(mark)} for one in starts]
        return table | {"starts": [{**one, "rounds": found} for one, found in zip(starts, rounds, strict=True)]}
