"""Reproducibility facts of a page: protocol, scene, machine, hashes, and the command of each run."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from invgraphics.recipes.suitable import starts_from_points
from invgraphics.report.data.assets import Folder
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.statistics.clocks import Speeds
from invgraphics.report.wording import budget_words, grouped, listing
from invgraphics.runs.folder import PUBLISHED, RECIPE
from invgraphics.runs.run import Run
from invgraphics.runs.schema import plain
from invgraphics.text import duration, slug

Facts = tuple[tuple[str, str], ...]
"""(name, value) in the order in which they are shown."""

ROUNDING = {"none": "unrounded", "nearest": "rounded to 8 bits", "down": "truncated to 8 bits"}
"""Rounding of a protocol's pictures -> words."""
SETTING_WORDS = {
    ("background", "scene"): "the scene's",
    ("masks", "excluded"): "masked pixels excluded",
    ("masks", "zero"): "masked pixels set to zero",
    ("masks", "unknown"): "not supported",
}
"""(Setting, value) of a protocol -> words."""
START_WORDS = {
    "stereo": "points that stereo finds in the training photographs, the scene's or random ones where these are few",
    "random": "random points",
    "depth": "true depth maps of the training views",
    "field": "another run's field",
}
"""``field.init`` of a recipe that does not start from the scene's points -> words."""
UNUSED = "not used: no method here starts from points"
"""The fact where a scene has points that no fit used."""


@dataclass(frozen=True)
class Cell:
    """Reproduction of one run: command, facts that differ from other runs, and files.

    Attributes:
        method: its method.
        series: index of its colour.
        seed: its seed.
        command: reproduces it; empty where the run does not say.
        differs: facts in which this run differs from the others.
        files: (name, link) of the run's files.
    """

    method: str
    series: int
    seed: int
    command: str
    differs: Facts
    files: tuple[tuple[str, str], ...]


def protocol_facts(comparison: Comparison) -> Facts:
    """(name, value) facts of scoring: budget, picture size, views, seeds, presets and protocol settings."""
    facts: dict[str, str] = {"methods": comparison.method_choice} if comparison.method_choice else {}
    if comparison.budget:
        facts["budget per fit"] = f"{budget_words(comparison.budget)} of optimisation"
    elif budgets := grouped([(budget_words(run.provenance.budget), run.method) for run in comparison.runs]):
        facts["budget per fit"] = budgets
    if comparison.size:
        facts["picture size"] = f"{comparison.size[0]} × {comparison.size[1]}"
    if comparison.runs:
        facts["test views"] = str(len(comparison.runs[0].scores.views))
        facts["seeds"] = ", ".join(str(seed) for seed in sorted({run.seed for run in comparison.runs}))
    facts |= preset_facts(comparison.runs, comparison.preset)
    if start := start_fact(comparison.runs):
        facts["points to start from"] = start
    if region := region_fact(comparison.runs):
        facts["region of the fits"] = region
    return (*facts.items(), *_scoring_facts(comparison.protocol))


def _scoring_facts(protocol: Mapping[str, Any]) -> Facts:
    """(name, value) facts of a protocol's settings, in words: rounding, background, masks, and the others as they are."""
    settings = {key: value for key, value in protocol.items() if key not in ("name", "summary")}
    sides = {side: _words(_text(settings.pop(side))) for side in ("prediction", "truth") if side in settings}
    rounding = {side: ROUNDING.get(value, value) for side, value in sides.items()}
    facts: dict[str, str] = {}
    if len(rounding) == 2 and len(set(rounding.values())) == 1:
        facts["pictures"] = f"both {rounding['truth']}"
    elif rounding:
        facts["pictures"] = ", ".join(f"{side} {words}" for side, words in rounding.items())
    for key, value in settings.items():
        text = _words(_text(value))
        facts[_words(key)] = SETTING_WORDS.get((key, text), text)
    return tuple(facts.items())


def preset_facts(runs: Sequence[Run], stated: str = "") -> dict[str, str]:
    """Presets of the fits, how each was chosen, and the scenes on which their values were tuned.

    Args:
        runs: the fits.
        stated: preset of the whole comparison, for where no run says more.
    """
    presets = grouped([(run.scores.preset or stated, run.method) for run in runs]) or stated
    choices = {run.provenance.preset_choice for run in runs}
    if choices - {""}:
        presets += f", {choices.pop()}" if len(choices) == 1 else ", chosen from each fit's budget"
    scenes = _chosen_on(runs)
    return {name: text for name, text in (("preset", presets), ("preset chosen on", scenes)) if text}


def _chosen_on(runs: Sequence[Run]) -> str:
    """Scenes on which presets were chosen, by method; those whose recipe does not say are listed where another's does."""
    chosen = [(_text(run.provenance.preset_chosen_on), run.method) for run in runs]
    if not any(scenes for scenes, _ in chosen):
        return ""
    return grouped([(scenes or "not stated", method) for scenes, method in chosen])


def start_fact(runs: Sequence[Run]) -> str:
    """What the fits' fields may start from, by scene or by method where these differ, and whose rays end at these points.

    The scene's points are named where a method uses them, or may: a run without a recipe does not say. Empty where no run says.
    """
    recipes = [_recipe(run) for run in runs]
    own = [(START_WORDS.get(_init(recipe), ""), run) for recipe, run in zip(recipes, runs, strict=True)]
    others = [(recipe, run) for recipe, (words, run) in zip(recipes, own, strict=True) if not words]
    users = [
        run for recipe, run in others if "field" not in recipe or starts_from_points(recipe) or run.provenance.sparse_depth
    ]
    scenes = [(_start(run), run.scores.scene) for run in users]
    starts = [grouped([(start or "none", scene) for start, scene in scenes])] if any(start for start, _ in scenes) else []
    for words in dict.fromkeys(words for words, _ in own if words):
        methods = list(dict.fromkeys(run.scores.method for each, run in own if each == words))
        starts.append(words if all(each == words for each, _ in own) else f"{words} ({listing(methods)})")
    if not (users or starts) and any(_start(run) for run in runs):
        starts.append(UNUSED)
    if supervised := list(dict.fromkeys(run.scores.method for run in runs if run.provenance.sparse_depth)):
        starts.append(f"rays of {listing(supervised)} end there")
    return "; ".join(starts)


def region_fact(runs: Sequence[Run]) -> str:
    """The box in which fits sought their scene, without its share, which depends on the views; empty for the data set's."""
    regions = [(re.sub(r", \d+% of.*", "", str(run.provenance.notes.get("region", ""))), run.scores.scene) for run in runs]
    if not any(words for words, _ in regions):
        return ""
    return grouped([(words or "the data set's box", scene) for words, scene in regions])


def _recipe(run: Run) -> Mapping[str, Any]:
    """A run's recipe; empty where it is not there."""
    return run.files.read_recipe() if (run.folder / RECIPE).is_file() else {}


def _init(recipe: Mapping[str, Any]) -> str:
    """The recipe's choice of first points; empty where it has none."""
    field = recipe.get("field")
    return str(field.get("init", "")) if isinstance(field, Mapping) else ""


def _start(run: Run) -> str:
    """Points of a run's scene in words, without their numbers, which differ between seeds."""
    words = run.provenance.notes.get("points", "")
    return re.sub(r"^[\d,]+ (points )?|\b[\d,]+ (?=random ones)", "", words)


def scene_facts(comparison: Comparison) -> Facts:
    """(name, value) facts of the scene, notes included."""
    facts: dict[str, str] = {}
    for key, value in plain(replace(comparison.scene_info, notes={})).items():
        facts[{"train": "training views", "val": "validation views", "test": "test views"}.get(key, _words(key))] = _text(value)
    if comparison.noise_ceiling is not None:
        facts["noise level of the truth"] = f"{comparison.noise_ceiling:.2f} dB PSNR"
    notes = comparison.scene_info.notes
    facts |= {_words(key): _text(value) for key, value in notes.items() if key not in ("summary", "stresses")}
    return tuple((key, value) for key, value in facts.items() if value)


def scene_sentence(comparison: Comparison, key: str) -> str:
    """The scene's note under ``key``; empty where there is none."""
    return str(comparison.scene_info.notes.get(key) or "")


def shared_facts(comparison: Comparison) -> Facts:
    """Provenance and machine facts that all runs share, and facts of the whole comparison."""
    tables = [_run_facts(run) for run in comparison.runs]
    shared = {key: value for key, value in tables[0].items() if all(t.get(key) == value for t in tables)} if tables else {}
    for key, value in comparison.environment.facts().items():
        shared.setdefault(_words(str(key)), _text(value))
    if speeds := Speeds.of(comparison.runs).words:
        shared["processor speed during the fits"] = speeds
    if comparison.wall_seconds is not None:
        shared["whole command took"] = duration(comparison.wall_seconds)
    return tuple(shared.items())


def reproduction(comparison: Comparison, folder: Folder) -> tuple[Cell, ...]:
    """Reproduction of every run, methods in order; links to the runs' files."""
    shared = dict(shared_facts(comparison))
    cells = []
    for series, method in enumerate(comparison.methods):
        for run in comparison.runs_of(method):
            own = {key: value for key, value in _run_facts(run).items() if shared.get(key) != value}
            command = run.provenance.command
            if folder.redactor is not None:
                command = _with_out(command, f"out/{slug(method)}-seed-{run.seed}")
            files = []
            for name in PUBLISHED:
                if run.files.path(name).is_file():
                    files.append((name, folder.publish(run.folder, name, f"runs/{series}-seed-{run.seed}/{name}")))
            cells.append(Cell(method, series, run.seed, command, tuple(own.items()), tuple(files)))
    return tuple(cells)


def _with_out(command: str, out: str) -> str:
    """A command that writes to ``out``: of a private path only the last part is left, which several runs may share."""
    words = shlex.split(command)
    if "--out" not in words[:-1]:
        return command
    words[words.index("--out") + 1] = out
    return shlex.join(words)


def plain_facts(table: Mapping[str, Any]) -> Facts:
    """A record as (name, text) facts; empty values are left out."""
    return tuple((_words(str(key)), text) for key, value in table.items() if (text := _text(value)))


def _run_facts(run: Run) -> dict[str, str]:
    """Hashes, versions and machine of one run, under display names."""
    known = run.provenance
    facts = {
        "truth SHA-256": known.truth_sha256,
        "training images SHA-256": known.train_sha256,
        "cameras SHA-256": known.cameras_sha256,
        "recipe SHA-256": known.recipe_sha256,
        "code version": known.code_version,
        "budget": known.budget,
        "test poses": known.test_poses,
        "test exposure": known.test_exposure,
        "sparse depth": known.sparse_depth,
        "load average": _text(plain(known.load_average)),
    }
    for key, value in run.environment.facts().items():
        facts.setdefault(_words(str(key)), _text(value))
    return {key: value for key, value in facts.items() if value}


def _words(key: str) -> str:
    return key.replace("_", " ")


def _text(value: Any) -> str:
    """Format a value for display; nested tables become ``key: value`` lists."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{_words(str(key))}: {_text(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    return str(value)
