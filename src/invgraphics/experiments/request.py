"""Requests of fits, comparisons and studies: plain values, light to import, serialisable as JSON."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from numbers import Integral
from pathlib import Path
from typing import Any, Literal, TypeGuard

from invgraphics.errors import InputError
from invgraphics.text import slug

Existing = Literal["refuse", "resume", "reuse"]

DATA = "data."
"""How the keys begin that change the training data rather than the recipe (`invgraphics.scenes.degrade.TrainingData`)."""

LARGEST_SEED = 2**63 - 1
"""The largest whole number that TOML and torch's generators both hold."""


def check_size(size: object) -> None:
    """Check the form of a size of pictures, whichever way it came in; ``None`` passes, and scenes check the numbers.

    Raises:
        InputError: it is neither a number of pixels nor a width and a height.
    """
    sides = size if isinstance(size, tuple) and len(size) == 2 else (size,)
    if size is not None and not all(_is_whole(side) for side in sides):
        raise InputError(f"The size cannot be {size!r}.", "Expected: the longest side in pixels, or (width, height).")


def check_seeds(seeds: Sequence[object]) -> None:
    """Check that there are seeds, and that each can be used.

    Raises:
        InputError: there is none, or one of them is no whole number between 0 and `LARGEST_SEED`.
    """
    expected = f"Expected: whole numbers from 0 to {LARGEST_SEED}."
    if not seeds:
        raise InputError("There are no seeds.", expected)
    for seed in seeds:
        if not (_is_whole(seed) and 0 <= seed <= LARGEST_SEED):
            raise InputError(f"A seed cannot be {seed!r}.", expected)


def python_ints(value: Any) -> Any:
    """Convert NumPy's whole numbers, alone or in tuples, to Python's, which JSON and messages spell; all else stays."""
    if isinstance(value, tuple):
        return tuple(python_ints(item) for item in value)
    return int(value) if _is_whole(value) else value


def _make_ints_plain(request: Settings | AblateRequest) -> None:
    """Convert all numbers of a request in place, while it is made."""
    for field in fields(request):
        object.__setattr__(request, field.name, python_ints(getattr(request, field.name)))


def _is_whole(value: object) -> TypeGuard[int]:
    return isinstance(value, Integral) and not isinstance(value, bool)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings shared by fits and comparisons.

    Attributes:
        scene: built-in scene or path of a data set.
        out: folder to write.
        budget: of each fit, ``60s`` or ``5000steps``.
        preset: preset of the recipes; ``None`` for the one that suits the budget (see `recipes.presets`).
        overrides: ``key=value`` items laid over the recipes, or over the training data where the key begins with ``data.``.
        size: longest side in pixels, or (width, height); ``None`` for the scene's own.
        test_views: how many test views to score; ``None`` for all.
        spp: samples per pixel of a scene that is rendered; ``None`` for its own.
        device: ``cpu`` or ``cuda``; ``None`` for the CPU.
        kernels: implementation to force; ``None`` for the best one here.
        protocol: how to score.
        checkpoint_every: for instance ``30s``, ``5m`` or ``100steps``.
        render_with: renderers that show the fitted field besides its own (see `invgraphics.experiments.renderings`).
    """

    scene: str
    out: str
    budget: str = "60s"
    preset: str | None = None
    overrides: tuple[str, ...] = ()
    size: int | tuple[int, int] | None = None
    test_views: int | None = 16
    spp: int | None = None
    device: str | None = None
    kernels: str | None = None
    protocol: str = "default"
    checkpoint_every: str = "30s"
    render_with: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_size(self.size)
        _make_ints_plain(self)

    @property
    def recipe_overrides(self) -> tuple[str, ...]:
        """``key=value`` overrides of the recipe."""
        return tuple(item for item in self.overrides if not item.startswith(DATA))

    @property
    def data_overrides(self) -> tuple[str, ...]:
        """``data.key=value`` overrides of the training data, prefix included."""
        return tuple(item for item in self.overrides if item.startswith(DATA))

    def flags(self) -> list[str]:
        """Command-line flags of the shared settings."""
        words = ["--budget", self.budget]
        words += ["--preset", self.preset] if self.preset else []
        if self.size is not None:
            words += ["--size", str(self.size) if isinstance(self.size, int) else f"{self.size[0]}x{self.size[1]}"]
        words += ["--test-views", "all" if self.test_views is None else str(self.test_views)]
        words += ["--spp", str(self.spp)] if self.spp is not None else []
        words += [word for item in self.overrides for word in ("--set", item)]
        words += ["--device", self.device] if self.device else []
        words += ["--kernels", self.kernels] if self.kernels else []
        words += ["--protocol", self.protocol] if self.protocol != "default" else []
        words += ["--render-with", ",".join(self.render_with)] if self.render_with else []
        return [*words, "--out", self.out]


@dataclass(frozen=True, kw_only=True)
class FitRequest(Settings):
    """Request of one fit: method, scene, seed and folder.

    Attributes:
        method: ``renderer/recipe`` or the path of a recipe; changes may follow (see `invgraphics.recipes.recipe.split_name`).
        seed: of initial values and of the fit.
        existing: what to do with a run that is already there: ``refuse``; ``resume`` it, if it is the same; or ``reuse`` what
            is the same and replace what is not.
        keep: whether an unfinished run is resumed, or a finished one reused, although code, threads or kernels have changed
            since; the record of a resumed one names the earlier code.
        truth: folder for truth images, shared by runs; ``None`` for ``OUT/truth``.
        snapshots: how many states of the model are kept between start and end, for time-lapses.
    """

    method: str
    seed: int = 0
    existing: Existing = "refuse"
    keep: bool = False
    truth: str | None = None
    snapshots: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_seeds([self.seed])
        if not _is_whole(self.snapshots) or self.snapshots < 0:
            raise InputError(f"The number of snapshots cannot be {self.snapshots!r}.", "Expected: a whole number, 0 or more.")
        if self.snapshots and not self.out:
            raise InputError("Snapshots are files of a run's folder, and this fit has none.", "Name one by out.")

    def shell(self) -> str:
        """Shell command that repeats this fit."""
        kept = ["--snapshots", str(self.snapshots)] if self.snapshots else []
        return shlex.join(["invgraphics", "fit", self.method, self.scene, "--seed", str(self.seed), *kept, *self.flags()])

    def to_json(self) -> dict[str, Any]:
        """Convert the request to plain JSON values."""
        return asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> FitRequest:
        """Parse a request (inverse of `to_json`; lists become tuples)."""
        plain: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
        return FitRequest(**plain)


@dataclass(frozen=True, kw_only=True)
class CompareRequest(Settings):
    """Request of a comparison: several methods on one scene.

    Attributes:
        methods: in the order of the report; empty leaves the choice to the scene (`recipes.suitable`).
        seeds: each method is fitted once per seed.
        optional: methods that are skipped, with the reason, where they do not go with the scene; others are an error.
        requested: the methods as requested, patterns included; empty for ``methods`` themselves.
        keep: whether finished runs are kept although the code has changed since, if recipe, scene and request are the same.
    """

    methods: tuple[str, ...]
    seeds: tuple[int, ...] = (0,)
    optional: frozenset[str] = frozenset()
    requested: str = ""
    keep: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_seeds(self.seeds)

    def fits(self) -> list[FitRequest]:
        """List the fit requests, one per method and seed."""
        shared: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(Settings)}
        shared |= {"existing": "reuse", "keep": self.keep, "truth": str(Path(self.out) / "truth")}
        return [
            FitRequest(**shared | {"method": method, "seed": seed, "out": str(self.folder(method, seed))})
            for method in self.methods
            for seed in self.seeds
        ]

    def folder(self, method: str, seed: int) -> Path:
        """Run folder of one method and seed."""
        return Path(self.out) / "runs" / slug(method) / f"seed-{seed}"

    def shell(self) -> str:
        """Shell command that repeats this comparison."""
        chosen = ["--methods", self.requested or ",".join(self.methods), "--seeds", ",".join(map(str, self.seeds))]
        kept = ["--keep"] if self.keep else []
        return shlex.join(["invgraphics", "compare", self.scene, *chosen, *self.flags(), *kept])


@dataclass(frozen=True, kw_only=True)
class AblateRequest:
    """Request of a study, with the overrides of the command line.

    Attributes:
        study: a built-in study's name, or the path of a ``study.toml``.
        out: folder to write.
        executor: what runs the cells, see `invgraphics.experiments.executors`.
        jobs: cells that share one machine; each gets an equal part of its cores.
        gpus: GPUs of each cell, for executors that hand them out.
        address: of the cluster, for executors that have one.
        seeds: instead of the study's; also ``budget``, ``size``, ``test_views`` and ``spp``, where they are not ``None``.
        budget: of each fit.
        size: longest side in pixels, or (width, height).
        test_views: number of test views, or ``all``.
        spp: samples per pixel of scenes that are rendered.
        device: ``cpu`` or ``cuda``; ``None`` for the CPU.
        kernels: implementation to force; ``None`` for the best one here.
        checkpoint_every: for instance ``30s``, ``5m`` or ``100steps``.
        keep: whether finished cells are kept although the code has changed since, if recipe, scene and request are the same.
        cells: pattern of the labels of the cells to run (`invgraphics.studies.cells.Planned.label`); ``None`` for all.
        most_seconds: fits with a longer budget are left for later; ``None`` for none.
    """

    study: str
    out: str
    executor: str = "local"
    jobs: int = 1
    gpus: float = 0.0
    address: str | None = None
    seeds: tuple[int, ...] | None = None
    budget: str | None = None
    size: int | tuple[int, int] | None = None
    test_views: int | Literal["all"] | None = None
    spp: int | None = None
    device: str | None = None
    kernels: str | None = None
    checkpoint_every: str = "30s"
    keep: bool = False
    cells: str | None = None
    most_seconds: float | None = None

    def __post_init__(self) -> None:
        check_size(self.size)
        if self.seeds is not None:
            check_seeds(self.seeds)
        _make_ints_plain(self)

    def shell(self) -> str:
        """Shell command that repeats this study."""
        size = self.size if not isinstance(self.size, tuple) else "x".join(map(str, self.size))
        given = {
            "--out": self.out,
            "--executor": self.executor if self.executor != "local" else None,
            "--jobs": self.jobs if self.jobs != 1 else None,
            "--gpus": f"{self.gpus:g}" if self.gpus else None,
            "--seeds": ",".join(map(str, self.seeds)) if self.seeds else None,
            "--budget": self.budget,
            "--size": size,
            "--test-views": self.test_views,
            "--spp": self.spp,
            "--device": self.device,
            "--kernels": self.kernels,
            "--cells": self.cells,
            "--most-seconds": None if self.most_seconds is None else f"{self.most_seconds:g}",
        }
        words = [word for flag, value in given.items() if value is not None for word in (flag, str(value))]
        words += ["--keep"] if self.keep else []
        return shlex.join(["invgraphics", "ablate", self.study, *words])
