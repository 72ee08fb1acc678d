"""Studies: a question, factors and their levels as data, and the cells that they expand to. Imports nothing heavy.

A factor's name is the dotted path of what it sets: a key of the recipes (``field.encoding.log2_size``), a key of the training
data (``data.train_views``, see `invgraphics.scenes.corrupt.TrainingData`), or ``budget``. A factor that only some methods have
names them first, ``volumetric/hash:field.encoding.log2_size`` or ``volumetric/*:batches.rays``; cells of the other methods
carry its base level in the table, and are not multiplied by it.
"""

from __future__ import annotations

import itertools
import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal

from invgraphics.config import fill
from invgraphics.data import find
from invgraphics.errors import InputError, did_you_mean
from invgraphics.experiments.analyses import check_analyses
from invgraphics.experiments.request import AblateRequest, FitRequest
from invgraphics.training.budget import Budget

FILE = "study.toml"
BUDGET = "budget"

Levels = dict[str, Any]
"""Factor -> level."""


@dataclass(frozen=True)
class Approximation:
    """Two renderers that differ in one approximation only, to be compared on every fit.

    Attributes:
        name: of the approximation.
        exact: renderer without it, one of the study's ``render_with``.
        approximate: renderer with it, likewise.
    """

    name: str
    exact: str
    approximate: str


@dataclass(frozen=True)
class Study:
    """What a ``study.toml`` says.

    Attributes:
        question: what the study is to answer, one sentence.
        scenes: built-in scenes or paths of data sets.
        methods: ``renderer/recipe``, or paths of recipes.
        design: ``factorial`` runs every combination of levels; ``one-at-a-time`` the base, and each other level of one factor
            with the rest at the base; ``list`` the ``cells``.
        factors: factor -> its levels; tables within are joined by dots. A ``list`` takes them from its cells.
        base: values that hold where nothing else is said, of factors and of other keys. A factor that is not in it has its
            first level as base.
        cells: for ``list``: levels that differ from the base.
        seeds: each cell is fitted once per seed.
        budget: of each fit, ``60s`` or ``5000steps``.
        protocol: how to score.
        test_views: how many test views to score, or ``all``.
        size: longest side in pixels, or [width, height]; ``None`` for the scenes' own.
        preset: preset of the recipes; ``None`` for their default.
        render_with: renderers that show every fitted field besides its own (see `invgraphics.experiments.renderings`).
        approximations: pairs of these renderers whose pictures of the same fit are compared.
        analyses: computations beside the fits (see `invgraphics.experiments.analyses`).
    """

    question: str
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    design: Literal["factorial", "one-at-a-time", "list"] = "factorial"
    factors: dict[str, Any] = default(default_factory=dict)
    base: dict[str, Any] = default(default_factory=dict)
    cells: tuple[dict[str, Any], ...] = ()
    seeds: tuple[int, ...] = (0,)
    budget: str = "60s"
    protocol: str = "default"
    test_views: int | Literal["all"] = 16
    size: int | tuple[int, int] | None = None
    preset: str | None = None
    render_with: tuple[str, ...] = ()
    approximations: tuple[Approximation, ...] = ()
    analyses: tuple[str, ...] = ()

    def points(self) -> list[Levels]:
        """Every combination of levels that the design asks for, in the order of the factors; at least the base."""
        base = {name: self.base[name] for name in self.factors}
        if self.design == "factorial":
            return [dict(zip(self.factors, levels, strict=True)) for levels in itertools.product(*self.factors.values())]
        if self.design == "one-at-a-time":
            others = [base | {name: level} for name, levels in self.factors.items() for level in levels if level != base[name]]
            return [base, *others]
        return [base | cell for cell in self.cells]

    def expand(self) -> list[Cell]:
        """Every run that the study needs, each once: seeds outermost, so that an unfinished study is balanced."""
        cells: dict[str, Cell] = {}
        for seed, scene, point, method in itertools.product(self.seeds, self.scenes, self.points(), self.methods):
            levels = {name: level if in_scope(name, method) else self.base[name] for name, level in point.items()}
            cells.setdefault(json.dumps([scene, method, seed, levels]), Cell(scene, method, seed, levels))
        return list(cells.values())

    def fit_request(self, cell: Cell, request: AblateRequest) -> FitRequest:
        """The run of one cell; its folder is still to be named."""
        values = self.base | cell.levels
        settings = {path_of(name): value for name, value in values.items() if in_scope(name, cell.method)}
        budget = str(settings.pop(BUDGET, self.budget))
        return FitRequest(
            method=cell.method,
            scene=cell.scene,
            seed=cell.seed,
            out=request.out,
            budget=budget,
            preset=self.preset,
            overrides=tuple(f"{path}={_written(value)}" for path, value in settings.items()),
            size=self.size,
            test_views=None if self.test_views == "all" else self.test_views,
            device=request.device,
            kernels=request.kernels,
            protocol=self.protocol,
            checkpoint_every=request.checkpoint_every,
            existing="reuse",
            truth=str(Path(request.out) / "truth"),
            render_with=self.render_with,
        )

    def overridden(self, request: AblateRequest) -> Study:
        """The study with what the command line says instead.

        Raises:
            InputError: it names a budget, and the study varies budgets; or a seed twice.
        """
        if request.budget is not None and any(path_of(name) == BUDGET for name in self.base):
            raise InputError("--budget cannot be given: the study itself says budgets in its factors or its base.")
        names = ("seeds", "budget", "size", "test_views")
        given = {name: getattr(request, name) for name in names if getattr(request, name) is not None}
        return _checked(replace(self, **given), f"The study '{request.study}'")


@dataclass(frozen=True)
class Cell:
    """One run of a study.

    Attributes:
        scene: its scene.
        method: its method.
        seed: its seed.
        levels: level of every factor; of one that the method does not have, the base level.
    """

    scene: str
    method: str
    seed: int
    levels: Levels


def in_scope(factor: str, method: str) -> bool:
    """Whether a method has a factor (or a key of the base)."""
    scope, colon, _ = factor.rpartition(":")
    return not colon or fnmatch(method, scope)


def path_of(factor: str) -> str:
    """What a factor sets, without its scope."""
    return factor.rpartition(":")[2]


def locate(name: str) -> Path:
    """The file of a built-in study, or of one's own: the path of a TOML file or of its folder.

    Raises:
        InputError: there is none; the built-in studies are listed.
    """
    for path in (Path(name), Path(name) / FILE):
        if path.suffix == ".toml" and path.is_file():
            return path
    known = [path.parent.name for path in sorted(find("studies").glob(f"*/{FILE}"))]
    if name in known:
        return find("studies", name) / FILE
    guess = did_you_mean(name, known)
    raise InputError(f"There is no study '{name}'.{guess}", f"Built-in studies: {', '.join(known)}; or the path of a {FILE}.")


def name_of(path: Path) -> str:
    """A study's name: that of its folder, or of its file where that has a name of its own."""
    return path.resolve().parent.name if path.name == FILE else path.stem


def read_study(path: Path) -> Study:
    """Read a study and check all that can be checked without its methods and scenes.

    Raises:
        InputError: not TOML; a key is unknown, missing or of the wrong type; a factor is empty or repeats a level; a design
            lacks what it needs. The sentence names the file.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}.") from error
    try:
        study = fill(Study, table)
    except InputError as error:
        raise InputError(f"{path}: {error.sentence}", error.remedy) from error
    return _checked(_completed(study, str(path)), str(path))


def _completed(study: Study, where: str) -> Study:
    """The study with flat names, the factors of a list, and a base level for every factor."""
    base = _flat(study.base)
    cells = tuple(_flat(cell) for cell in study.cells)
    factors = _flat(study.factors)
    for name, levels in factors.items():
        if not isinstance(levels, list):
            raise InputError(f"{where}: the factor '{name}' is not a list of levels.", f"Expected: [{levels!r}, ...].")
    if (study.design == "list") != bool(cells) or (study.design == "list" and factors):
        raise InputError(f"{where}: the design 'list' needs [[cells]] and no [factors], the others the contrary.")
    for name in dict.fromkeys(name for cell in cells for name in cell):
        absent = [index for index, cell in enumerate(cells) if name not in cell]
        if absent and name not in base:
            raise InputError(f"{where}: cell {absent[0] + 1} does not say '{name}', and neither does [base].")
        found = ([base[name]] if absent else []) + [cell[name] for cell in cells if name in cell]
        factors[name] = [level for index, level in enumerate(found) if level not in found[:index]]
    first = {name: levels[0] for name, levels in factors.items() if levels}
    return replace(study, base=first | base, factors=factors, cells=cells)


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one with dotted names."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat


def _checked(study: Study, where: str) -> Study:
    """Refuse what cannot be expanded, or would run in vain."""
    for what in ("scenes", "methods", "seeds"):
        _check_list(getattr(study, what), f"{where}: '{what}'")
    for name, levels in study.factors.items():
        _check_list(levels, f"{where}: the factor '{name}'")
        if study.base[name] not in levels:
            raise InputError(f"{where}: [base] gives '{name}' the value {study.base[name]!r}, which is none of its levels.")
    for name, value in study.base.items():
        values = study.factors.get(name, [value])
        if strange := [value for value in values if not _is_plain(value)]:
            raise InputError(f"{where}: '{name}' cannot be {strange[0]!r}.", _PLAIN)
        if not any(in_scope(name, method) for method in study.methods):
            raise InputError(f"{where}: '{name}' belongs to none of the study's methods ({', '.join(study.methods)}).")
        for budget in values if path_of(name) == BUDGET else ():
            Budget.parse(str(budget))
    for method in study.methods:
        paths = [path_of(name) for name in study.base if in_scope(name, method)]
        if twice := [path for path in paths if paths.count(path) > 1]:
            raise InputError(
                f"{where}: '{twice[0]}' is set by two entries for {method}.", "Let their scopes exclude each other."
            )
    check_analyses(study.analyses, where)
    for name in (name for pair in study.approximations for name in (pair.exact, pair.approximate)):
        if name not in study.render_with:
            raise InputError(f"{where}: an approximation names '{name}', which is not in 'render_with'.")
    Budget.parse(study.budget)
    views = study.test_views
    if any(seed < 0 for seed in study.seeds) or (views != "all" and views < 1):
        raise InputError(f"{where}: seeds must be 0 or more, and 'test_views' 1 or more or 'all'.")
    return study


_PLAIN = "Expected: a number, a text, true, false, or a list of such."


def _is_plain(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_is_plain, value))
    return isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value))


def _check_list(items: Sequence[Any], what: str) -> None:
    if not items:
        raise InputError(f"{what} has no entries.")
    for index, item in enumerate(items):
        if item in items[:index]:
            raise InputError(f"{what} has {item!r} twice.")


def _written(value: Any) -> str:
    """A level as ``--set`` takes it, in TOML, which for plain values is JSON."""
    return json.dumps(value, ensure_ascii=False)
