"""``inference.json``: unseen instances of a class of objects, inferred from few views, and their scores beside baselines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from invgraphics.runs.schema import Record


@dataclass(frozen=True, kw_only=True)
class InstanceScores:
    """Scores of one instance, made one way.

    Attributes:
        subject: number of the instance in the scene.
        observed: number of views that it was inferred from.
        how: what made it: a method with a prior, or a baseline.
        quality: metric -> value of each test view; ``None`` where a view has none.
        input_psnr: PSNR in dB of the observed views themselves.
    """

    subject: int
    observed: int
    how: str
    quality: dict[str, tuple[float | None, ...]]
    input_psnr: float


@dataclass(frozen=True, kw_only=True)
class Inference(Record):
    """Unseen instances inferred from few views.

    Attributes:
        scene: the class.
        runs: what made an instance -> folder of the run, of methods with a prior.
        command: that repeats it.
        date: when.
        pictures: numbers of observed views of which there are pictures, ``pictures/VIEWS/SUBJECT.png``.
        columns: number of observed views -> what its pictures show, from left to right.
        seconds: what made an instance -> seconds of optimisation for all instances, by the number of views.
        instances: scores.
    """

    FILE: ClassVar[str] = "inference.json"

    scene: str
    runs: dict[str, str]
    command: str
    date: str
    pictures: tuple[int, ...]
    columns: dict[str, tuple[str, ...]]
    seconds: dict[str, dict[str, float]]
    instances: tuple[InstanceScores, ...]
