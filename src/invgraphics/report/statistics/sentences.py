"""Effects in words: what was found, on which scenes, how far it generalises, and what could have been found."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from invgraphics.report.data.factors import METHOD, Factor, Observation
from invgraphics.report.data.variants import level_words
from invgraphics.report.statistics.effects import Effect, Verdict
from invgraphics.report.statistics.intervals import POWER, Estimate
from invgraphics.report.wording import TIMES, MeasuredQuantity, listing, metric_label

FEW_SCENES = 5
"""Fewer scenes than this tell little about others, and the sentence says so."""
MOST_LISTED = 6
"""Levels of other factors that a sentence lists; of more it names the two ends that are significant."""


def effect_sentence(effect: Effect) -> str:
    """An effect in one or two sentences."""
    left_out = disturbed_words(effect.disturbed, effect.quantity)
    parts = [_verdict(effect), _lost(effect), _silent(effect), left_out]
    if effect.truths_differ:
        parts.append("The factor changes the truth itself, so the two were scored against different pictures.")
    return " ".join(part for part in parts if part)


def disturbed_words(count: int, quantity: MeasuredQuantity) -> str:
    """How many fits are left out of comparisons in a quantity, in a sentence; empty for none."""
    fits = f"{count} {'fit' if count == 1 else 'fits'}"
    if not count:
        return ""
    if quantity.key in TIMES:
        return f"Times of {fits} are left out: their clocks were disturbed."
    return f"Left out {'is' if count == 1 else 'are'} {fits} with less processor time than others in equal seconds."


def unscored_sentences(metric: str, shown: MeasuredQuantity | None) -> list[str]:
    """Sentence naming the metric that replaces a study's missing one; empty if none is missing."""
    if shown is None or shown.key == metric:
        return []
    return [f"The study asks about {metric_label(metric)}, which no finished fit has: what follows is of {shown.label}."]


def unmeasured_sentences(
    asked: Sequence[tuple[str, str]], effects: Sequence[Effect], factors: Sequence[Factor], observations: Sequence[Observation]
) -> list[str]:
    """A sentence per interaction that a study asks about and that is not among its effects: that it is missing, and why."""
    there = {(effect.contrast.factor, effect.contrast.against[0]) for effect in effects if effect.contrast.against is not None}
    return [
        f"The interaction of {first} and {second}, about which the study asks, was not measured: "
        f"{_why_unmeasured(first, second, factors, observations)}."
        for first, second in asked
        if (first, second) not in there
    ]


def _why_unmeasured(first: str, second: str, factors: Sequence[Factor], observations: Sequence[Observation]) -> str:
    by_path = {factor.path: factor for factor in factors}
    if single := [name for name in (first, second) if name not in by_path]:
        return f"{single[0]} has a single level here"
    ends = [(by_path[name].levels[0], by_path[name].levels[-1]) for name in (first, second)]
    for one, two in itertools.product(*ends):
        if not any((fit.levels.get(first), fit.levels.get(second)) == (one, two) for fit in observations):
            levels = [level if name == METHOD else f"{name} {level}" for name, level in ((first, one), (second, two))]
            return f"no finished fit has {listing(levels)}"
    return "no seed has finished fits at all four combinations of their outermost levels with the same other levels"


def _verdict(effect: Effect) -> str:
    value, unit = effect.estimate, _unit(effect.quantity)
    magnitude = f"{_verb(effect.quantity, value.mean)} {effect.text(abs(value.mean))} {unit}"
    if effect.claim.unit == "none":
        return _unmeasured(effect, magnitude)
    basis = f"{value.size}{_averaged(effect)}{_scene_counts(effect)}"
    if effect.flattered:
        return f"{effect.label}: no verdict, {_signed(effect)}, {basis}."
    if effect.opposed:
        mean = f"on average {effect.text(value.mean)} {unit} {_intervals(effect)}"
        return f"{effect.label}: the sign depends on other factors, {basis}: {_settings(effect)}; {mean}."
    if effect.found:
        return f"{_subject(effect)} {magnitude} {_intervals(effect, value.mean)}, {basis}."
    if effect.contradicted:
        mean = f"on average {effect.text(value.mean)} {unit} {_intervals(effect)}"
        return f"{effect.label}: no common direction, {basis}; {mean}."
    if effect.scenes("higher") or effect.scenes("lower"):
        p = "" if effect.adjusted is None else f" (corrected p = {effect.adjusted:.2g})"
        most = 2 * len(effect.scenes("higher" if value.mean > 0 else "lower")) > len(effect.by_scene)
        words = f"{_subject(effect)} {magnitude} {_intervals(effect, value.mean)}"
        return f"{words if most else f'{effect.label}: {_signed(effect)}'}, {basis}; undecided for other scenes{p}."
    if effect.equivalent:
        assert effect.quantity.margin is not None
        margin = effect.text(effect.quantity.margin)
        return f"{effect.label}: no effect beyond ±{margin} {unit} (equivalence test), {_signed(effect)}, {basis}."
    if effect.uncorrected:
        chance = f"with {effect.comparisons} such comparisons that may be chance"
        words = f"{_subject(effect)} {magnitude} {_intervals(effect, value.mean)}, {basis}"
        return f"{words}; {chance} (corrected p = {effect.adjusted:.2g})."
    return f"{effect.label}: undecided, {_signed(effect)}, {basis}; {detectable_words(effect)}."


def _subject(effect: Effect) -> str:
    """The contrast as the subject of a sentence; the clause that names an interaction's levels is closed by a comma."""
    return f"{effect.label}," if effect.contrast.against is not None else effect.label


def _unmeasured(effect: Effect, magnitude: str) -> str:
    value = effect.estimate
    if value.mean == 0 and (value.seeds[1] > 1 or value.scenes > 1):
        return f"{effect.label}: no difference at all, {value.size}."
    if value.seeds[1] == 1 and value.scenes == 1:
        return f"{_subject(effect)} {magnitude} with one seed only, which cannot be told from chance."
    if value.seeds[0] == 1 and value.scenes == 1:
        return f"{_subject(effect)} {magnitude} with one seed only on one side, which cannot be told from chance."
    words = f"{_subject(effect)} {magnitude} by the same amount each time, {value.size}"
    return f"{words}: no spread is known, so nothing is tested."


def _signed(effect: Effect) -> str:
    return f"{effect.text(effect.estimate.mean)} {_unit(effect.quantity)} {_intervals(effect)}".strip()


def _intervals(effect: Effect, towards: float = 0.0) -> str:
    """Both intervals with their populations; ends are magnitudes where a verb says the direction ``towards``."""
    own = _bounds(effect, effect.estimate, towards)
    if effect.across is None:
        return own
    scenes = f"these {effect.estimate.scenes} scenes"
    parts = [f"{own} for new fits on {scenes}" if own else ""]
    others = _bounds(effect, effect.across, towards)
    few = f" (only {effect.across.scenes}, which tell little)" if effect.across.scenes < FEW_SCENES else ""
    parts.append(f"{others} for scenes like these{few}" if others else "")
    return ", ".join(part for part in parts if part)


def _bounds(effect: Effect, value: Estimate, towards: float) -> str:
    if value.unit == "none":
        return ""
    low, high = (value.low, value.high) if towards >= 0 else (-value.high, -value.low)
    return f"[{effect.text(low)}, {effect.text(high)}]"


def _scene_counts(effect: Effect) -> str:
    """Verdict by scene in words, with those named that differ: ``; better on 5 of 6, `cloud` undecided``."""
    if not effect.by_scene:
        return ""
    total = len(effect.by_scene)
    if all(one.verdict == "undecided" for one in effect.by_scene.values()):
        return "; no scene decides it alone"
    if all(one.verdict == "untested" for one in effect.by_scene.values()):
        higher = sum(one.estimate.mean > 0 for one in effect.by_scene.values())
        return f"; {_direction(effect, 'higher')} on {higher} of {total} scenes in one fit each"
    lead: Verdict = "higher" if len(effect.scenes("higher")) >= len(effect.scenes("lower")) else "lower"
    rest: Verdict = "lower" if lead == "higher" else "higher"
    parts = [f"{_direction(effect, lead)} on {len(effect.scenes(lead))} of {total} scenes"]
    others: list[tuple[Verdict, str]] = [
        (rest, _direction(effect, rest)),
        ("undecided", "undecided"),
        ("untested", "not tested"),
    ]
    for verdict, word in others:
        scenes = effect.scenes(verdict)
        if scenes and len(scenes) < total:
            parts.append(f"{word} on {listing(scenes)}")
    return f"; {', '.join(parts)}"


def _direction(effect: Effect, verdict: Verdict) -> str:
    if effect.quantity.better == "none":
        return "more" if verdict == "higher" else "less"
    return "better" if (verdict == "higher") == (effect.quantity.better == "higher") else "worse"


def _averaged(effect: Effect) -> str:
    """Over how many combinations of other factors' levels an effect is averaged, and how far it goes from one to another."""
    if not effect.by_setting:
        return ""
    rising = sorted(effect.by_setting.items(), key=lambda item: item[1].claim.mean)
    ends = (f"{effect.text(one.claim.mean)} ({name})" for name, one in (rising[0], rising[-1]))
    reach = "" if effect.opposed else f", from {' to '.join(ends)}"
    return f", averaged over {len(effect.by_setting)} settings of other factors{reach}"


def _settings(effect: Effect) -> str:
    """The difference at each combination of other factors' levels, or at the significant ends of many, with its interval."""
    rising = sorted(effect.by_setting.items(), key=lambda item: item[1].claim.mean)
    significant = [item for item in rising if item[1].sign]
    ends = significant if len(significant) > 1 else rising
    shown = rising if len(rising) <= MOST_LISTED else [ends[0], ends[-1]]
    unit = _unit(effect.quantity)
    parts = (f"{effect.text(one.claim.mean)} {unit} {effect.bounds(one.claim)}".strip() + f" ({name})" for name, one in shown)
    return f"{'from ' if len(shown) < len(rising) else ''}{(' to ' if len(shown) < len(rising) else ', ').join(parts)}"


def detectable_words(effect: Effect) -> str:
    """The effect that a repetition would find with 80 % power, in words."""
    reach = effect.detectable
    if reach is None:
        return ""
    corrected = f" after correction for {effect.comparisons} comparisons" if effect.comparisons > 1 else ""
    return f"an effect of {effect.text(reach)} {_unit(effect.quantity)} would be found with {POWER:.0%} power{corrected}"


def _lost(effect: Effect) -> str:
    """Diverged and failed fits in words."""
    if effect.contrast.against is not None and sum(effect.lost):
        count = f"{sum(effect.lost)} {'fit' if sum(effect.lost) == 1 else 'fits'}"
        words = f"Diverged or failed at one of its four corners, and not in these numbers: {count}"
        return f"{words}; what is left flatters this sign." if effect.flattered else f"{words}."
    names = (level_words(effect.factor.rpartition(".")[2], level) for level in (effect.before, effect.after))
    names = (effect.before, effect.after) if effect.factor == METHOD else names
    parts = [f"{count} of {name}" for count, name in zip(effect.lost, names, strict=True) if count]
    if not parts:
        return ""
    fits = "fit" if sum(effect.lost) == 1 else "fits"
    words = f"Diverged or failed, and not in these numbers: {listing(parts)} ({sum(effect.lost)} {fits})"
    return (
        f"{words}; what is left flatters {effect.after if effect.better > 0 else effect.before}."
        if effect.flattered
        else f"{words}."
    )


def _silent(effect: Effect) -> str:
    if not effect.silent:
        return ""
    return f"Nothing is known on {listing(effect.silent)}, where one side has no number."


def _verb(quantity: MeasuredQuantity, difference: float) -> str:
    if quantity.better == "none":
        return "adds" if difference > 0 else "saves"
    return "gains" if (difference > 0) == (quantity.better == "higher") else "costs"


def _unit(quantity: MeasuredQuantity) -> str:
    """Unit of a difference in words; the quantity's label where it has no unit."""
    if quantity.unit == "dB":
        return "dB"
    return f"{quantity.unit} of {quantity.label}" if quantity.unit else quantity.label
