"""Study definitions: question, factors and levels as data, and their expansion to cells, without heavy imports.

A factor's name is the dotted path of what it sets: a key of the recipes (``field.encoding.log2_size``), a key of the training
data (``data.train_views``, see `invgraphics.scenes.degrade.TrainingData`), or ``budget``, ``size`` or ``preset``. A factor that
only some methods have names them first, ``volumetric/hash:field.encoding.log2_size`` or ``volumetric/*:batches.rays``; cells of
the other methods carry its base level in the table, and are not multiplied by it.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass
from dataclasses import field as default
from pathlib import Path
from typing import Any, Literal

from invgraphics.experiments.request import AblateRequest, FitRequest
from invgraphics.runs.study import Approximation, KnownDeviation, Prediction
from invgraphics.studies.factors import (
    BUDGET,
    PRESET,
    SETTINGS,
    SIZE,
    Levels,
    covers,
    in_scope,
    levels_of,
    override,
    path_of,
)


@dataclass(frozen=True)
class Study:
    """Definition of a study, as read from ``study.toml``.

    Attributes:
        question: what the study is to answer, one sentence.
        scenes: built-in scenes or paths of data sets. One that begins with a variable, ``$INVGRAPHICS_DATA/fox``, is left out
            where that data is not there, and the record says why.
        methods: ``renderer/recipe``, or paths of recipes.
        report: what the page is about: ``effects`` of the factors, or ``verdicts`` on every cell.
        design: ``factorial`` runs every combination of levels; ``one-at-a-time`` the base, and each other level of one factor
            with the rest at the base; ``list`` the ``cells``.
        factors: factor -> its levels; tables within are joined by dots. A ``list`` takes them from its cells.
        base: values that hold where nothing else is said, of factors and of other keys. A factor that is not in it has its
            first level as base.
        cells: for ``list``: levels that differ from the base, and ``scenes``, ``methods`` and ``seeds`` of its own where a cell
            is not for all of the study's.
        seeds: each cell is fitted once per seed.
        budget: of each fit, ``60s`` or ``5000steps``.
        protocol: how to score.
        test_views: how many test views to score, or ``all``.
        size: longest side in pixels, or [width, height]; ``None`` for the scenes' own.
        spp: samples per pixel of scenes that are rendered; ``None`` for their own.
        preset: preset of the recipes; ``None`` for the one that suits each cell's budget.
        render_with: renderers that show every fitted field besides its own (see `invgraphics.experiments.renderings`).
        approximations: pairs of these renderers whose pictures of the same fit are compared.
        analyses: computations beside the fits (see `invgraphics.studies.analyses`).
        known: for ``verdicts``: what is known to deviate, and why.
        metric: key of the score that the question is about, for instance ``psnr_at_1_8`` or ``normal_deg``.
        each: factor (or ``method``) that the question asks about level by level; the report then answers for each.
        interactions: pairs of factors whose interaction is the question; the report tests it first.
        margins: metric -> difference, in its stored unit, below which levels count as equal (the report's equivalence tests);
            others have the margins of `invgraphics.report.wording.MARGINS`.
        predictions: differences that are stated before anything runs, which the report judges.
        words: ``factor level`` -> what the report calls that level, where its key says little.
    """

    question: str
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    report: Literal["effects", "verdicts"] = "effects"
    design: Literal["factorial", "one-at-a-time", "list"] = "factorial"
    factors: dict[str, Any] = default(default_factory=dict)
    base: dict[str, Any] = default(default_factory=dict)
    cells: tuple[dict[str, Any], ...] = ()
    seeds: tuple[int, ...] = (0,)
    budget: str = "60s"
    protocol: str = "default"
    test_views: int | Literal["all"] = 16
    size: int | tuple[int, int] | None = None
    spp: int | None = None
    preset: str | None = None
    render_with: tuple[str, ...] = ()
    approximations: tuple[Approximation, ...] = ()
    analyses: tuple[str, ...] = ()
    known: tuple[KnownDeviation, ...] = ()
    metric: str = "psnr"
    each: str = ""
    interactions: tuple[tuple[str, str], ...] = ()
    margins: dict[str, float] = default(default_factory=dict)
    predictions: tuple[Prediction, ...] = ()
    words: dict[str, str] = default(default_factory=dict)

    def points(self) -> list[Levels]:
        """List the design's combinations of levels, in the order of the factors; at least the base."""
        base = {name: self.base[name] for name in self.factors}
        if self.design == "factorial":
            return [dict(zip(self.factors, levels, strict=True)) for levels in itertools.product(*self.factors.values())]
        if self.design == "one-at-a-time":
            others = [base | {name: level} for name, levels in self.factors.items() for level in levels if level != base[name]]
            return [base, *others]
        return [base | levels_of(cell) for cell in self.cells]

    def expand(self) -> list[Cell]:
        """Expand the study to its unique runs, seeds outermost, so that an unfinished study is balanced."""
        cells: dict[str, Cell] = {}
        points = list(zip(self.points(), self.cells, strict=True)) if self.cells else [(point, {}) for point in self.points()]
        for seed, scene, (point, listed), method in itertools.product(self.seeds, self.scenes, points, self.methods):
            if not covers(listed, scene, method, seed):
                continue
            levels = {name: level if in_scope(name, method) else self.base[name] for name, level in point.items()}
            cells.setdefault(json.dumps([scene, method, seed, levels]), Cell(scene, method, seed, levels))
        return list(cells.values())

    def fit_request(self, cell: Cell, request: AblateRequest) -> FitRequest:
        """Make the fit request of one cell, its output folder still unset."""
        values = self.base | cell.levels
        settings = {path_of(name): value for name, value in values.items() if in_scope(name, cell.method)}
        given = {name: settings.pop(name, getattr(self, name)) for name in SETTINGS}
        size = given[SIZE]
        return FitRequest(
            method=cell.method,
            scene=cell.scene,
            seed=cell.seed,
            out=request.out,
            budget=str(given[BUDGET]),
            preset=given[PRESET],
            overrides=tuple(override(path, value) for path, value in settings.items()),
            size=(size[0], size[1]) if isinstance(size, list) else size,
            spp=self.spp,
            test_views=None if self.test_views == "all" else self.test_views,
            device=request.device,
            kernels=request.kernels,
            protocol=self.protocol,
            checkpoint_every=request.checkpoint_every,
            existing="reuse",
            keep=request.keep,
            truth=str(Path(request.out) / "truth"),
            render_with=self.render_with,
        )


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

    @property
    def scene_name(self) -> str:
        """The scene without its path."""
        return Path(self.scene).name if self.scene.startswith("$") else Path(self.scene).resolve().name
