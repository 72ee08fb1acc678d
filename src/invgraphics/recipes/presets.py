"""Selection of a recipe's preset: by name, or by the fit's budget."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from invgraphics.errors import InputError, did_you_mean
from invgraphics.training.budget import Budget

LADDER = (("laptop", 0.0), ("long", 120.0), ("hour", math.nextafter(1800.0, math.inf)))
"""Presets and the shortest budget of each, seconds: laptop under two minutes, long up to thirty, hour above."""

CHOSEN_ON = "chosen_on"
"""Key of a preset that is no setting: the scenes on which its values were chosen."""


@dataclass(frozen=True)
class Preset:
    """A selected preset of a recipe, and the reason for its selection.

    Attributes:
        name: as in the recipe; empty for none.
        choice: what chose it, in words; empty where it was requested by name.
        chosen_on: scenes on which its values were chosen; empty where the recipe does not say.
        table: its settings.
    """

    name: str
    choice: str
    chosen_on: tuple[str, ...]
    table: dict[str, Any]


def preset_for(budget: Budget | None, known: Collection[str]) -> str:
    """Select the preset for a budget: its step of `LADDER`, else the recipe's nearest smaller one; empty for none.

    A budget in steps says nothing about seconds; it takes the first, as does no budget.

    Args:
        budget: of the fit.
        known: names of the recipe's presets.
    """
    seconds = 0.0 if budget is None or budget.seconds is None else budget.seconds
    fitting = [name for name, shortest in LADDER if shortest <= seconds and name in known]
    return fitting[-1] if fitting else ""


def select_preset(method: str, requested: str | None, budget: Budget | None, known: Mapping[str, Any]) -> Preset:
    """Select the preset by name, or else by the budget.

    Args:
        method: name of the recipe, for the sentence of an error.
        requested: the named preset; empty for none at all, ``None`` leaves the choice to the budget.
        budget: of the fit; ``None`` where there is none.
        known: the recipe's presets and their tables.

    Raises:
        InputError: the recipe has no such preset, or ``chosen_on`` is no list of names.
    """
    name = preset_for(budget, known) if requested is None else requested
    if name and name not in known:
        raise InputError(
            f"{method} has no preset '{name}'.{did_you_mean(name, known)}", f"Its presets: {', '.join(known) or 'none'}."
        )
    table = dict(known.get(name, {}))
    scenes = table.pop(CHOSEN_ON, [])
    if not isinstance(scenes, list) or not all(isinstance(scene, str) for scene in scenes):
        raise InputError(f"'presets.{name}.{CHOSEN_ON}' of {method} cannot be {scenes!r}.", 'Expected: ["scene", ...].')
    choice = "" if requested is not None or budget is None or not name else _choice(budget)
    return Preset(name, choice, tuple(scenes), table)


def preset_summary(known: Mapping[str, Any]) -> str:
    """List a recipe's presets in a line, by length of budget, each with the scenes that it was tuned on.

    Args:
        known: the recipe's presets and their tables.
    """
    order = [name for name, _ in LADDER]
    names = sorted(known, key=lambda name: (order.index(name) if name in order else len(order), name))
    scenes = {name: _listed(known[name].get(CHOSEN_ON, [])) for name in names}
    return ", ".join(f"{name} ({scenes[name]})" if scenes[name] else name for name in names)


def _listed(scenes: Any) -> str:
    """Scenes as a recipe names them, in a line; what is no list is shown as it stands, and refused where the preset is used."""
    return ", ".join(map(str, scenes)) if isinstance(scenes, list) else str(scenes)


def announcements(choices: Iterable[tuple[str, str, str]]) -> list[str]:
    """Report automatically selected presets, one sentence for each.

    Args:
        choices: (method, preset, what chose it) of every fit.
    """
    methods: dict[tuple[str, str], list[str]] = {}
    for method, name, choice in dict.fromkeys(choices):
        if choice:
            methods.setdefault((name, choice), []).append(method)
    return [
        f"{', '.join(dict.fromkeys(names))}: preset {name}, {choice}; --preset overrides."
        for (name, choice), names in methods.items()
    ]


def _choice(budget: Budget) -> str:
    if budget.seconds is None:
        return "as for every budget in steps"
    return f"chosen from the budget of {_span(budget.seconds)}"


def _span(seconds: float) -> str:
    """Format seconds exactly, in the largest unit that leaves no long fraction."""
    if seconds >= 3600 and seconds % 900 == 0:
        return f"{seconds / 3600:g} h"
    return f"{seconds / 60:g} min" if seconds >= 120 and seconds % 15 == 0 else f"{seconds:g} s"
