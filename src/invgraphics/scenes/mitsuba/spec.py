"""Schema and reader of a scene description, ``scene.toml``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from invgraphics import data
from invgraphics.config import fill
from invgraphics.errors import InputError, did_you_mean
from invgraphics.tables import read_toml

FILE = "scene.toml"

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class SamplesPerPixel:
    """Samples per pixel of each split; ``test`` is rendered in two independent halves."""

    train: int = 256
    val: int = 256
    test: int = 1024

    def __post_init__(self) -> None:
        if min(self.train, self.val) < 1 or self.test < 2 or self.test % 2:
            raise ValueError("samples per pixel must be positive, and even for the test views")

    def scaled(self, train: int) -> SamplesPerPixel:
        """Scale all splits to another number of samples per training pixel."""
        factor = train / self.train
        return SamplesPerPixel(train, max(1, round(self.val * factor)), 2 * max(1, round(self.test * factor / 2)))


@dataclass(frozen=True)
class Counts:
    """Number of views of each split."""

    train: int = 40
    val: int = 4
    test: int = 16

    def __post_init__(self) -> None:
        if min(self.train, self.test) < 1 or self.val < 0:
            raise ValueError("there must be at least one training view and one test view")


@dataclass(frozen=True)
class Instances:
    """Instances of a class of objects; the model of instance k is built from the scene's seed + k.

    Attributes:
        train: instances that train a prior, the first ones.
        unseen: instances that score it, the last ones.
        observed: views of each unseen instance from which it is inferred; besides them it has test views.
    """

    train: int = 128
    unseen: int = 16
    observed: int = 8

    def __post_init__(self) -> None:
        if min(self.train, self.unseen, self.observed) < 1:
            raise ValueError("there must be at least one instance to train and one unseen instance, with an observed view")

    @property
    def total(self) -> int:
        """Number of instances."""
        return self.train + self.unseen

    def scaled(self, total: int) -> Instances:
        """Change the number of instances; the share of unseen ones stays, at least one of each kind."""
        unseen = min(max(1, round(total * self.unseen / self.total)), total - 1)
        return Instances(total - unseen, unseen, self.observed)


@dataclass(frozen=True)
class SceneSpec:
    """Description of a scene, as in its ``scene.toml``.

    Attributes:
        name: short name, shown everywhere.
        builder: which procedural model (`invgraphics.scenes.mitsuba.build.BUILDERS`) is rendered.
        summary: one sentence about what is seen.
        stresses: one sentence about what the scene is hard for.
        lo: lowest corner of a box that holds every visible surface, world units.
        hi: highest corner of that box.
        rig: where the cameras stand: a ``kind`` and its parameters, see `invgraphics.scenes.mitsuba.rig`.
        size: default width and height in pixels.
        views: default numbers of views.
        samples: default samples per pixel.
        background: colour put behind the scene when it is scored, display sRGB; ``None`` where the scene is opaque.
        depth: longest light path, in vertices.
        seed: of the model's own randomness (textures, placement), apart from the renderer's noise.
        instances: of a class of objects, whose ``views`` are then those of each instance; ``None`` for a single scene.
    """

    name: str
    builder: str
    summary: str
    stresses: str
    lo: Vector
    hi: Vector
    rig: dict[str, Any]
    size: tuple[int, int] = (128, 128)
    views: Counts = Counts()
    samples: SamplesPerPixel = SamplesPerPixel()
    background: Vector | None = None
    depth: int = 8
    seed: int = 0
    instances: Instances | None = None

    def __post_init__(self) -> None:
        if not self.name.isprintable() or not self.name.strip(". ") or set("/\\:") & set(self.name):
            raise ValueError("'name' must be a word: it becomes a folder's")
        if not all(low < high for low, high in zip(self.lo, self.hi, strict=True)):
            raise ValueError("every coordinate of 'lo' must be below that of 'hi'")
        if min(self.size) < 8:
            raise ValueError("images must be at least 8 pixels wide and high")
        if self.depth < 2:
            raise ValueError("'depth' must be at least 2, which is direct light only")

    def with_instances(self, total: int) -> SceneSpec:
        """The same class with another number of instances, unseen ones included.

        Raises:
            InputError: it is a single scene, or the number leaves none to train on or none unseen.
        """
        if self.instances is None:
            raise InputError(f"'{self.name}' is a single scene, not a class of objects.", "Leave out --instances.")
        if total < 2:
            raise InputError(
                f"The number of instances cannot be {total}.", "Expected: at least 2, one to train and one unseen."
            )
        return replace(self, instances=self.instances.scaled(total))


@cache
def names() -> tuple[str, ...]:
    """List the built-in scenes."""
    return tuple(sorted(path.parent.name for path in data.find("scenes").glob(f"*/{FILE}")))


@cache
def class_names() -> tuple[str, ...]:
    """List the built-in scenes that are classes of objects."""
    return tuple(name for name in names() if read(data.find("scenes", name) / FILE).instances is not None)


def description_path(name: str) -> Path:
    """Find the description of a scene: built in, or the path of a ``scene.toml`` or of its folder.

    Raises:
        InputError: there is none; the built-in scenes are listed.
    """
    if name in names():
        return data.find("scenes", name) / FILE
    for path in (Path(name), Path(name) / FILE):
        if path.name == FILE and path.is_file():
            return path
    guess = did_you_mean(name, names())
    raise InputError(
        f"There is no scene '{name}'.{guess}", f"Built-in scenes: {', '.join(names())}; or give a path to a {FILE}."
    )


def read(path: Path) -> SceneSpec:
    """Read and validate a ``scene.toml``.

    Raises:
        InputError: not TOML, or a key is unknown, missing or wrong.
    """
    table = read_toml(path)
    try:
        return fill(SceneSpec, table)
    except InputError as error:
        raise InputError(f"{path}: {error.sentence}", error.remedy) from error
