"""How long a fit may take, and how often it is saved: seconds or steps."""

from __future__ import annotations

import re
from dataclasses import dataclass

from invgraphics.errors import InputError

_UNITS = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True)
class Budget:
    """Either ``seconds`` or ``steps`` (or both: whichever ends first).

    Seconds count optimisation only: compilation, evaluation and writing of checkpoints are excluded.
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
        amount = _read(text)
        if amount is None:
            raise InputError(f"'{text}' is not a budget.", "Expected something like 60s, 2m, 1h or 5000steps.")
        return Budget(steps=amount) if isinstance(amount, int) else Budget(seconds=amount)

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
        """Read ``30s``, ``2m``, ``1h`` or ``100steps``.

        Raises:
            InputError: anything else, or nothing between two checkpoints.
        """
        amount = _read(text)
        if amount is None:
            message = f"'{text}' is no interval for checkpoints."
            raise InputError(message, "Expected something like 30s, 2m, 1h or 100steps.")
        return Cadence(steps=amount) if isinstance(amount, int) else Cadence(seconds=amount)


def _read(text: str) -> int | float | None:
    """Parse a positive amount: whole steps, or a time in seconds; ``None`` for anything else."""
    found = isinstance(text, str) and re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(steps?|s|min|m|h)\s*", text)
    if not found or (number := float(found.group(1))) <= 0:
        return None
    if not found.group(2).startswith("step"):
        return number * _UNITS[found.group(2)]
    return int(number) if number == int(number) else None
