"""Check which published runs were made by other recipes than today's."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from invgraphics.errors import InputError
from invgraphics.experiments.request import DATA
from invgraphics.recipes.recipe import load_method
from invgraphics.report.wording import listing
from invgraphics.runs.folder import RunFolder
from invgraphics.runs.provenance import Provenance
from invgraphics.scenes.open import longest_edge
from invgraphics.training.budget import Budget


@dataclass(frozen=True)
class RecipeCheck:
    """Outcome for one report.

    Attributes:
        folder: of the report.
        runs: runs whose recipes were compared.
        stale: method -> why, for methods with a run that today's recipe would not make.
    """

    folder: Path
    runs: int
    stale: dict[str, str]

    @property
    def current(self) -> bool:
        """Whether every run was made by a recipe of today."""
        return not self.stale and self.runs > 0

    @property
    def sentence(self) -> str:
        """The outcome in words."""
        if not self.runs:
            return f"{self.folder}: holds no run whose recipe can be compared."
        if self.current:
            runs = "its one run was" if self.runs == 1 else f"all {self.runs} runs were"
            return f"{self.folder}: {runs} made by today's recipes."
        reasons = "; ".join(f"{method} ({why})" for method, why in self.stale.items())
        return f"{self.folder}: made by other recipes than today's: {reasons}."


def check_recipes(folder: Path) -> RecipeCheck:
    """Compare the recipe of every run below ``folder`` with today's under the same preset, overrides and budget.

    Imported and converted runs and renderings do not count: their recipes are parts of other files and runs.

    Raises:
        InputError: there is no such folder, or a record is broken.
    """
    if not folder.is_dir():
        raise InputError(f"'{folder}' is no folder.", "Give the folder of a report.")
    found = [RunFolder(path.parent).read(Provenance) for path in sorted(folder.rglob(Provenance.FILE))]
    # Others are of no recipe alone, or show the field of a fit that is checked itself.
    records = [one for one in found if one.imported is None and one.converted is None and one.fitted_run is None]
    stale: dict[str, str] = {}
    seen: dict[tuple[str, ...], str | None] = {}
    for record in records:
        overrides = _overrides(record.command)
        size = str(record.options.size)
        key = record.method, record.preset or "", record.budget, record.scene, size, record.recipe_sha256, *overrides
        if key not in seen:
            seen[key] = _difference(record, overrides)
        if (why := seen[key]) is not None:
            stale[record.method] = why
    return RecipeCheck(folder, len(records), stale)


def _difference(record: Provenance, overrides: Sequence[str]) -> str | None:
    """Why the same request would not make a run's recipe today: it ``differs``, or none is made; ``None`` where it would."""
    try:
        method = load_method(record.method, record.preset or None, overrides, Budget.parse(record.budget))
    except InputError as error:
        return error.sentence.rstrip(".")
    same = record.recipe_sha256 in method.equivalent_digests(longest_edge(record.scene, record.options.size))
    return None if same else "differs"


def _overrides(command: str) -> list[str]:
    """``key=value`` overrides of the recipe in a ``fit`` command."""
    words = shlex.split(command)
    given = [value for flag, value in itertools.pairwise(words) if flag == "--set"]
    return [item for item in given if not item.startswith(DATA)]


def summary(checks: Sequence[RecipeCheck]) -> str:
    """How many of the reports that have runs to compare are current, in a sentence."""
    compared = [check for check in checks if check.runs]
    stale = [check.folder.name for check in compared if not check.current]
    if not stale:
        return f"All {len(compared)} reports are current."
    verb = "is" if len(stale) == 1 else "are"
    return f"{len(stale)} of {len(compared)} reports {verb} not current: {listing(stale)}."
