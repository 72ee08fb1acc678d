"""``scores.json``: quality of a model on the test views, and its costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from invgraphics.runs.schema import Record

DEFAULT = "default"
"""The protocol whose scores have no protocol in their file's name; a run that has them is finished."""

COST_UNITS = {
    "fit_seconds": "s",
    "fit_cpu_seconds": "s",
    "fit_processor_share": "",
    "fit_standstill_seconds": "s",
    "fit_processor_speed": "1/s",
    "steps": "",
    "peak_memory_bytes": "bytes",
    "render_seconds_per_view": "s",
    "render_fps": "1/s",
    "render_processor_share": "",
    "model_bytes": "bytes",
    "parameters": "",
    "primitives": "",
    "dead": "",
}
"""Costs that an evaluation writes, and their units."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """One quality metric over the test views.

    Attributes:
        mean: the protocol's aggregate; ``None`` where it is not a number.
        unit: for instance ``dB``; empty where there is none.
        higher_is_better: the metric's direction.
        per_view: one value per test view, in the order of the views; empty where only the aggregate is known.
        joined: what ``mean`` is where it is no mean over the test views.
        max: the largest value, where that is known.
        per_training_view: one value per training view, of errors of refined poses.
    """

    mean: float | None
    unit: str = ""
    higher_is_better: bool
    per_view: tuple[float | None, ...] = ()
    joined: str = ""
    max: float | None = None
    per_training_view: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ScoredTruth:
    """Ground truth of a rescoring: its hash, size, background and transparency.

    Attributes:
        sha256: of their pixels.
        size: width and height of the first view, px.
        background: that both sides are in front of, in [0, 1]; ``None`` where nothing says which.
        transparency: ``open``: any background can be put behind both sides; ``fixed``: one side has ``background`` in it;
            ``opaque``: photographs.
    """

    sha256: str
    size: tuple[int, int]
    background: tuple[float, float, float] | None = None
    transparency: Literal["open", "fixed", "opaque"]


@dataclass(frozen=True, kw_only=True)
class Scores(Record):
    """Scores of one model or one set of pictures under one protocol.

    Attributes:
        method: ``renderer/recipe``; the folder's name for pictures of another tool.
        preset: of the recipe; empty for none.
        preset_choice: what chose the preset, in words; empty where it was requested.
        scene: its name.
        seed: of the fit; ``None`` for pictures of another tool.
        protocol: its name.
        views: names of the test views.
        cost: quantity -> value (`COST_UNITS`); ``None`` where the method has no such thing.
        quality: metric -> score.
        skipped: metric -> why it has no score.
        disturbed: why the times say nothing, the subject left out; empty where they do.
        below_baseline: why the method may have lost to the mean training image, and what to try; empty where it has not.
        test_poses: how test poses were found; empty where they were taken as given.
        test_exposure: under which exposure test views were shown; empty where exposures are not fitted.
        rescored: whether saved pictures were scored, rather than the model.
        conventions: of a rescoring: everything that the protocol states.
        truth: of a rescoring.
        notes: of a rescoring: what was assumed, in sentences.
    """

    method: str
    preset: str = ""
    preset_choice: str = ""
    scene: str = ""
    seed: int | None = None
    protocol: str = DEFAULT
    views: tuple[str, ...]
    cost: dict[str, float | None]
    quality: dict[str, Score]
    skipped: dict[str, str] = field(default_factory=dict)
    disturbed: str = ""
    below_baseline: str = ""
    test_poses: str = ""
    test_exposure: str = ""
    rescored: bool = False
    conventions: dict[str, Any] = field(default_factory=dict)
    truth: ScoredTruth | None = None
    notes: tuple[str, ...] = ()

    RENAMED: ClassVar[Mapping[str, str]] = {"shortfall": "below_baseline"}
    FILES = "scores*.json"
    """Pattern of all files of scores."""

    @property
    def file(self) -> str:
        """Name of the file that holds this record."""
        return scores_file(self.protocol)


def scores_file(protocol: str = DEFAULT) -> str:
    """Name of the file of a protocol's scores."""
    return "scores.json" if protocol == DEFAULT else f"scores.{protocol}.json"
