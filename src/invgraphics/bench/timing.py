"""The clock: variants of one piece of work in alternation, so that whatever disturbs the machine disturbs them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Seconds of one call: the median and the quartiles over repetitions."""

    median: float
    low: float
    high: float
    repetitions: int

    @staticmethod
    def of(seconds: list[float]) -> Timing:
        """Summary of single calls."""
        low, median, high = (float(x) for x in np.quantile(seconds, (0.25, 0.5, 0.75)))
        return Timing(median, low, high, len(seconds))

    def per(self, calls: int) -> Timing:
        """The same for one of ``calls`` equal pieces."""
        return Timing(self.median / calls, self.low / calls, self.high / calls, self.repetitions)


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    Attributes:
        seconds: time that one variant may take; a slow one is repeated less often.
        least: fewest repetitions of any variant.
        most: most repetitions of any variant.
    """

    seconds: float
    least: int
    most: int

    def repetitions(self, seconds: float) -> int:
        """How often to repeat what takes ``seconds``."""
        return max(self.least, min(self.most, int(self.seconds / max(seconds, 1e-9))))


def clock(work: Callable[[], object]) -> float:
    """Seconds of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def alternate(variants: Mapping[str, Callable[[], object]], effort: Effort) -> dict[str, Timing]:
    """Time variants in turn: A B C A B C ... The first round, which compiles and fills caches, does not count, except for
    those whose one call takes all of their time.

    A variant that has had its repetitions drops out, so after the slow ones only the fast ones go on.
    """
    first = {name: clock(work) for name, work in variants.items()}
    seconds: dict[str, list[float]] = {name: [taken] if taken >= effort.seconds else [] for name, taken in first.items()}
    for name, work in variants.items():
        if not seconds[name]:
            seconds[name].append(clock(work))
    wanted = {name: effort.repetitions(taken[0]) for name, taken in seconds.items()}
    for turn in range(1, max(wanted.values(), default=0)):
        for name, work in variants.items():
            if turn < wanted[name]:
                seconds[name].append(clock(work))
    return {name: Timing.of(taken) for name, taken in seconds.items()}
