"""How long a fit may take, and how often it is saved: seconds or steps."""

from __future__ import annotations

import re
from dataclasses import dataclass

from invgraphics.errors import InputError

_UNITS = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True)
class Budget:
    """Either ``seconds`` or ``steps`` (or both: whichever ends first).

    Seconds count optimisation only: compilation, evaluation and writing of checkpoints are left out.
    """

    seconds: float | None = None
    steps: int | None = None

    def progress(self, seconds: float, steps: int) -> float:
        """Share of the budget that is spent, in [0, 1]."""
        spent = [0.0]
        if self.seconds is not None:
            spent.append(seconds / self.seconds)
        if self.steps is not None:
            spent.append(steps / self.steps)
        return min(1.0, max(spent))

    @staticmethod
    def parse(text: str) -> Budget:
        """Read ``60s``, ``2m``, ``1h`` or ``5000steps``.

        Raises:
            InputError: anything else, or nothing to spend.
        """
        found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(steps?|s|min|m|h)\s*", text)
        number = float(found.group(1)) if found else 0.0
        if found is None or number <= 0 or (found.group(2).startswith("step") and number != int(number)):
            raise InputError(f"'{text}' is not a budget.", "Expected something like 60s, 2m, 1h or 5000steps.")
        if found.group(2).startswith("step"):
            return Budget(steps=int(number))
        return Budget(seconds=number * _UNITS[found.group(2)])

    def __str__(self) -> str:
        parts = ([f"{self.seconds:g} s"] if self.seconds is not None else []) + ([f"{self.steps} steps"] if self.steps else [])
        return " or ".join(parts)


@dataclass(frozen=True)
class Cadence:
    """How often a checkpoint is written: every so many steps or seconds."""

    steps: int | None = None
    seconds: float | None = None

    @staticmethod
    def parse(text: str) -> Cadence:
        """Read ``100steps`` or ``30s``.

        Raises:
            InputError: anything else, or nothing between two checkpoints.
        """
        found = re.fullmatch(r"\s*([0-9]+)\s*(steps?|s)\s*", text)
        if found is None or int(found.group(1)) == 0:
            raise InputError(f"'{text}' is no interval for checkpoints.", "Expected something like 100steps or 30s.")
        amount = int(found.group(1))
        return Cadence(seconds=float(amount)) if found.group(2) == "s" else Cadence(steps=amount)
