"""``inference.json``: unseen instances of a class of objects, inferred from few views, and their scores beside baselines."""

from __future__ import annotations

from dataclasses import dataclass, field
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
        input_psnr: PSNR in dB of the observed views themselves; ``None`` where a picture of one was not finite.
        seconds: of optimisation or search; ``None`` where it was not measured.
    """

    subject: int
    observed: int
    how: str
    quality: dict[str, tuple[float | None, ...]]
    input_psnr: float | None = None
    seconds: float | None = None


@dataclass(frozen=True, kw_only=True)
class PriorFit:
    """What the fit of a prior to its class had and took.

    Attributes:
        parameters: of field and renderer, the training instances' codes among them.
        budget: as requested, ``600s`` or ``5000steps``.
        steps: of optimisation.
        seconds: that these took.
    """

    parameters: int
    budget: str
    steps: int | None = None
    seconds: float | None = None


@dataclass(frozen=True, kw_only=True)
class Inference(Record):
    """Unseen instances inferred from few views; written after each instance, so that an interrupted inference continues.

    Attributes:
        scene: the class.
        runs: what made an instance -> folder of the run, of methods with a prior.
        fits: what made an instance -> size and length of that run's fit.
        identity: SHA-256 of the runs, the settings and the code, by which an interrupted inference is known; empty for none.
        command: that repeats it.
        date: when.
        pictures: numbers of observed views of which there are pictures, ``pictures/VIEWS/SUBJECT.png``.
        columns: number of observed views -> what its pictures show, from left to right.
        rows: what they show, from top to bottom.
        instances: scores.
    """

    FILE: ClassVar[str] = "inference.json"

    scene: str
    runs: dict[str, str]
    fits: dict[str, PriorFit] = field(default_factory=dict)
    identity: str = ""
    command: str
    date: str
    pictures: tuple[int, ...]
    columns: dict[str, tuple[str, ...]]
    rows: tuple[str, ...] = ("hidden side", "normals of the hidden side")
    instances: tuple[InstanceScores, ...]

    def holds(self, subject: int, observed: int) -> bool:
        """Whether the instance has been inferred from so many views."""
        return any((one.subject, one.observed) == (subject, observed) for one in self.instances)
