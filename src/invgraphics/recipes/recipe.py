"""Recipes: a method is data, a TOML file that names a field, a renderer, losses, hooks and settings."""

from __future__ import annotations

import copy
import fnmatch
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invgraphics import plugins
from invgraphics.config import fill, merge, set_path, to_table
from invgraphics.data import find, has_method, has_scene
from invgraphics.errors import InputError, did_you_mean
from invgraphics.recipes.aliases import suggested_method
from invgraphics.recipes.presets import select_preset
from invgraphics.recipes.renamed import ADDED_KEYS, with_current_names, with_first_names
from invgraphics.tables import LIMITS, parse_toml, read_text
from invgraphics.text import sha256_of
from invgraphics.training.budget import Budget

if TYPE_CHECKING:
    from invgraphics.recipes.schema import Recipe


PRESET = "preset="
"""How the change in a method's name begins that chooses a preset."""

_NO_START_SIZE = {key: ADDED_KEYS["batches"][key] for key in ("start_size", "start_until")}
"""Values of ``batches`` with which a fit begins with all pixels."""


@dataclass(frozen=True)
class Method:
    """A resolved recipe, ready to build: name, table, preset and digest.

    Attributes:
        name: ``renderer/recipe`` or the path of a user's own TOML file, with changes after colons (see `split_name`).
        preset: name of the preset merged into the recipe; empty for none.
        recipe: its typed settings.
        table: the same, everything resolved, as plain values; what a run's ``recipe.toml`` holds.
        preset_choice: what chose the preset, in words; empty where it was requested.
        chosen_on: scenes on which the preset's values were chosen.
    """

    name: str
    preset: str
    recipe: Recipe
    table: dict[str, Any]
    preset_choice: str = ""
    chosen_on: tuple[str, ...] = ()

    @property
    def choice(self) -> tuple[str, str, str]:
        """Name, preset and reason of the preset's selection, for `recipes.presets.announcements`."""
        return self.name, self.preset, self.preset_choice

    @property
    def digest(self) -> str:
        """SHA-256 of the resolved table, invariant under renamed keys."""
        return sha256_of(with_first_names(self.table))

    def equivalent_digests(self, longest_edge: int | None) -> tuple[str, ...]:
        """SHA-256 of every table that makes the same fit to photographs of a size, this one's first.

        There are two where photographs are too small for ``batches.start_size`` to do anything: with it and without.

        Args:
            longest_edge: of the photographs in pixels; ``None`` where it is not known.
        """
        if longest_edge is None or self.recipe.batches.halvings(longest_edge):
            return (self.digest,)
        plain = self.table | {"batches": {**self.table["batches"], **_NO_START_SIZE}}
        return self.digest, sha256_of(with_first_names(plain))


def methods() -> dict[str, str]:
    """List all known methods, name -> summary, built-in ones first; imports no implementation.

    A third-party recipe that cannot be read is left out, with a warning.
    """
    root = find("renderers")
    found = {}
    for path in sorted(root.glob("*/*.toml")):
        found[f"{path.parent.name}/{path.stem}"] = str(_parse(path.read_text(), str(path)).get("summary", ""))
    for name in plugins.names("recipes"):
        if name not in found:
            try:
                found[name] = str(_foreign_source(name).get("summary", ""))
            except InputError as error:
                plugins.leave_out(error.sentence)
    return found


def expand(names: Sequence[str]) -> tuple[tuple[str, ...], frozenset[str]]:
    """Replace patterns among methods' names by the known methods that match them.

    Args:
        names: methods, ``all`` for every known one, or patterns such as ``volumetric/*``; a method named twice stays once.

    Returns:
        The methods' names in order, and those of them that only a pattern names.

    Raises:
        InputError: a pattern matches no method.
    """
    found: dict[str, bool] = {}
    for name in names:
        if name != "all" and "*" not in name:
            found[name] = False
            continue
        matching = [known for known in methods() if name == "all" or fnmatch.fnmatchcase(known, name)]
        if not matching:
            raise InputError(f"No method matches '{name}'.", f"Known methods: {', '.join(methods())}.")
        for known in matching:
            found.setdefault(known, True)
    return tuple(found), frozenset(name for name, by_pattern in found.items() if by_pattern)


def presets(name: str) -> list[str]:
    """Names of the presets of a method."""
    return sorted(source(name).get("presets", {}))


def load_method(name: str, preset: str | None = None, overrides: Sequence[str] = (), budget: Budget | None = None) -> Method:
    """Read a method's recipe, merge a preset and then overrides into it, and check every key.

    Args:
        name: ``renderer/recipe`` of a built-in or plugged-in method, or the path of a TOML file; either may have changes after
            colons (see `split_name`).
        preset: one of the recipe's presets, unless the name says one; ``None`` takes the one for the budget (see
            `recipes.presets`).
        overrides: ``dotted.path=value`` items, values as in TOML; bare words are taken as text.
        budget: of the fit; ``None`` counts as a short one.

    Raises:
        InputError: unknown method, preset or key, or a value of the wrong type.
    """
    return method_from(source(name), name, preset, overrides, budget)


def method_from(
    table: Mapping[str, Any], name: str, preset: str | None = None, overrides: Sequence[str] = (), budget: Budget | None = None
) -> Method:
    """Resolve a method from a recipe's table with its presets; otherwise as `load_method`.

    Raises:
        InputError: unknown preset or key, or a value of the wrong type.
    """
    table = dict(table)
    _, named, own = split_name(name)
    chosen = select_preset(name, preset if named is None else named, budget, table.pop("presets", {}))
    plain = merge(table, chosen.table)
    changed = copy.deepcopy(plain)
    assign(changed, (*overrides, *own))
    _check_groups(name, plain, changed)
    try:
        method = resolve(name, chosen.name, changed)
    except InputError as error:
        raise _of_its_file(error, name, plain) from error
    return replace(method, preset_choice=chosen.choice, chosen_on=chosen.chosen_on)


def _check_groups(name: str, table: Mapping[str, Any], changed: Mapping[str, Any]) -> None:
    """Check that overrides name parameter groups that the recipe has, or say what a new one matches.

    Raises:
        InputError: names the first that is neither.
    """
    known, groups = (each.get("optimiser", {}).get("groups", {}) for each in (table, changed))
    for group in groups:
        if group not in known and "match" not in groups[group]:
            sentence = f"{name} has no parameter group '{group}'.{did_you_mean(group, known)}"
            new = f"A new one needs --set optimiser.groups.{group}.match=PARAMETER, too."
            remedy = f"Its groups: {', '.join(known) or 'none'}. {new}"
            raise InputError(sentence, remedy)


def _of_its_file(error: InputError, name: str, table: dict[str, Any]) -> InputError:
    """The error with the file's name, where the recipe is a file whose table cannot be resolved even without overrides."""
    file = split_name(name)[0]
    if file.endswith(".toml"):
        try:
            resolve(name, "", table)
        except InputError as fault:
            return type(fault)(f"{file}: {fault.sentence}", fault.remedy)
    return error


def split_name(name: str) -> tuple[str, str | None, tuple[str, ...]]:
    """Split a method's name into recipe, preset (``None`` where none is named) and overrides.

    ``volumetric/hash:field.width=64:batches.rays=2048`` is the recipe with two values changed, ``volumetric/nerf:preset=paper``
    one of its presets. A comparison can so hold several variants of one recipe, each under a name that makes it again.
    """
    recipe, *settings = re.split(r":(?=[\w.]+=)", name)
    presets = [item.partition("=")[2] for item in settings if item.startswith(PRESET)]
    return recipe, presets[-1] if presets else None, tuple(item for item in settings if not item.startswith(PRESET))


def assign(table: dict[str, Any], items: Sequence[str]) -> None:
    """Set values of a table from ``dotted.path=value`` items, in their order.

    Raises:
        InputError: an item has another form, or its path leads nowhere.
    """
    for item in items:
        path, equals, value = item.partition("=")
        if not equals or not path.strip():
            raise InputError(f"'--set {item}' is not of the form key=value.", "Example: --set batches.rays=2048.")
        set_path(table, path.strip(), _value(value.strip()))


def resolve(name: str, preset: str, table: dict[str, Any]) -> Method:
    """Resolve a method from a complete table, such as a run's ``recipe.toml``; keys of earlier versions are renamed.

    Raises:
        InputError: unknown key, a value of the wrong type, or a hook that the field cannot serve.
    """
    from invgraphics.recipes.schema import Recipe

    recipe = fill(Recipe, with_current_names(table)).capped()
    recipe.check_hooks()
    return Method(name, preset, recipe, to_table(recipe))


def source(name: str) -> dict[str, Any]:
    """Read a recipe's table as written, presets included, without the overrides in the method's name."""
    name = split_name(name)[0]
    if name.endswith(".toml"):
        path = Path(name)
    else:
        path = find("renderers") / f"{name}.toml"
        if name in plugins.names("recipes") and not path.is_file():
            return _foreign_source(name)
        if not path.is_file():
            known = methods()
            guess = suggested_method(name, known)
            if has_scene(name):
                guess = f" '{name}' is a scene; the order is `fit METHOD SCENE`."
            sentence = f"There is no method '{name}'.{guess}"
            others = "Those of other packages are known once the package is installed."
            raise InputError(sentence, f"Known methods: {', '.join(known)}; or the path of a .toml. {others}")
    return _parse(read_text(path, LIMITS.toml_bytes), str(path))


def is_built_in(name: str) -> bool:
    """Whether a method of `methods` is one of ours; a third-party recipe cannot take its name."""
    return has_method(name)


def _foreign_source(name: str) -> dict[str, Any]:
    return _parse(str(plugins.load("recipes", name)), f"{name} of {plugins.origin('recipes', name)}")


def _parse(text: str, where: str) -> dict[str, Any]:
    table = parse_toml(text, f"The recipe {where}")
    known = table.get("presets", {})
    if not isinstance(known, dict) or not all(isinstance(preset, dict) for preset in known.values()):
        raise InputError(f"The 'presets' of {where} are no tables.", "Expected: [presets.NAME], and settings below it.")
    return table


def _value(text: str) -> Any:
    try:
        return parse_toml(f"value = {text}", "--set")["value"]
    except InputError:
        return text
