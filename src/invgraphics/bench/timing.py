"""Timing in alternation: variants of the same work take turns, so that disturbances of the machine affect all alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Seconds per call: median and quartiles over repetitions."""

    median: float
    low: float
    high: float
    repetitions: int

    @staticmethod
    def of(seconds: list[float]) -> Timing:
        """Summary of the seconds of single calls."""
        low, median, high = (float(x) for x in np.quantile(seconds, (0.25, 0.5, 0.75)))
        return Timing(median, low, high, len(seconds))

    def per(self, calls: int) -> Timing:
        """Timing per call, where each measurement made ``calls`` calls."""
        return Timing(self.median / calls, self.low / calls, self.high / calls, self.repetitions)


@dataclass(frozen=True)
class TimingBudget:
    """Measurement budget of a variant.

    Attributes:
        seconds: total time; slow variants are repeated less often.
        min_repetitions: lower bound of repetitions.
        max_repetitions: upper bound of repetitions.
    """

    seconds: float
    min_repetitions: int
    max_repetitions: int

    def repetitions(self, seconds: float) -> int:
        """Number of repetitions of a call that takes ``seconds``."""
        return max(self.min_repetitions, min(self.max_repetitions, int(self.seconds / max(seconds, 1e-9))))


def clock(work: Callable[[], object]) -> float:
    """Wall-clock seconds of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def alternate(variants: Mapping[str, Callable[[], object]], budget: TimingBudget) -> dict[str, Timing]:
    """Time variants in alternation: A B C A B C ... The first round compiles and warms caches, and is discarded.

    A variant that has had its repetitions drops out.
    """
    for work in variants.values():
        work()
    seconds = {name: [clock(work)] for name, work in variants.items()}
    wanted = {name: budget.repetitions(taken[0]) for name, taken in seconds.items()}
    for turn in range(1, max(wanted.values(), default=0)):
        for name, work in variants.items():
            if turn < wanted[name]:
                seconds[name].append(clock(work))
    return {name: Timing.of(taken) for name, taken in seconds.items()}
