"""Rendering jobs, and the hash that is their key in the cache."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from invgraphics.config import fill, to_table
from invgraphics.scenes.mitsuba.build import BUILDERS
from invgraphics.scenes.mitsuba.spec import Counts, SamplesPerPixel, SceneSpec
from invgraphics.tables import parse_json
from invgraphics.text import sha256_of

# What decides pixels besides the scene's own builder, relative to the package; the rest (caching, messages) does not.
_SOURCES = (
    "scenes/mitsuba/rig.py", "scenes/mitsuba/stage.py", "scenes/mitsuba/gbuffer.py", "scenes/mitsuba/render.py",
    "scenes/mitsuba/folder.py", "scenes/mitsuba/ply.py", "core/camera.py", "core/transforms.py", "core/colour.py",
)  # fmt: skip
_AVERAGING_SOURCES = ("scenes/mitsuba/average.py", "scenes/pictures/resize.py")
_CLASS_SOURCES = (*_SOURCES, "scenes/mitsuba/instances.py")
_BUILD = "scenes/mitsuba/build"
_IMPORTED = re.compile(r"^(?:from|import) invgraphics\.scenes\.mitsuba\.build\.(\w+)", re.MULTILINE)


@dataclass(frozen=True)
class Source:
    """Larger rendering of the same scene from which pictures are averaged.

    Attributes:
        size: its width and height in pixels.
        views: how many of each split it has, at least as many as are wanted.
        samples: per pixel, of each split.
    """

    size: tuple[int, int]
    views: Counts
    samples: SamplesPerPixel


@dataclass(frozen=True)
class Job:
    """Settings of one rendering of a scene.

    Attributes:
        spec: the scene's description.
        size: width and height in pixels.
        views: how many of each split.
        samples: per pixel, of each split.
        seed: of the camera positions and of the renderer's noise.
        variant: Mitsuba's.
        source: what the pictures are averaged from; ``None`` where they are rendered. ``samples`` are then the effective ones.
    """

    spec: SceneSpec
    size: tuple[int, int]
    views: Counts
    samples: SamplesPerPixel
    seed: int
    variant: str
    source: Source | None = None

    def table(self) -> dict[str, Any]:
        """Convert the job to plain values."""
        return to_table(self)

    @staticmethod
    def from_json(text: str) -> Job:
        """Parse a job (inverse of ``json.dumps(job.table())``)."""
        return fill(Job, parse_json(text, "the job"))

    @property
    def folder_name(self) -> str:
        """Name of the job's folder in the cache."""
        return f"{self.spec.name}-{self.key()}"

    def rendered_source(self) -> Job:
        """Job of the larger rendering that is averaged."""
        assert self.source is not None, "only an averaged rendering has a source"
        size, views, samples = self.source.size, self.source.views, self.source.samples
        return replace(self, size=size, views=views, samples=samples, source=None)

    @property
    def total(self) -> int:
        """Number of views to render."""
        if (instances := self.spec.instances) is not None:
            seen = instances.train * (self.views.train + self.views.val)
            return seen + instances.unseen * (instances.observed + self.views.test)
        return self.views.train + self.views.val + self.views.test

    def key(self) -> str:
        """Hash of everything the pixels depend on: description, options, our sources, Mitsuba's version and variant."""
        paths = _SOURCES if self.spec.instances is None else _CLASS_SOURCES
        paths += () if self.source is None else _AVERAGING_SOURCES
        sources, versions = _source_hash(self.spec.builder, paths), {name: version(name) for name in ("mitsuba", "drjit")}
        content = {"job": self.table(), "sources": sources, **versions}
        return sha256_of(content)[:16]


def _source_hash(builder: str, paths: tuple[str, ...]) -> str:
    package = Path(__file__).resolve().parents[2]
    sha = hashlib.sha256()
    for path in (*(package / name for name in paths), *_builder_sources(package / _BUILD, builder)):
        sha.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return sha.hexdigest()


def _builder_sources(folder: Path, builder: str) -> list[Path]:
    """A builder's module and the modules of ``folder`` that it imports, directly or not: others build other scenes."""
    module = BUILDERS.get(builder, "").partition(":")[0].rpartition(".")[2]
    found: set[Path] = set()
    waiting = [folder / f"{module}.py"] if module else []  # an unknown builder is refused by the renderer
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += [folder / f"{name}.py" for name in _IMPORTED.findall(path.read_text(encoding="utf-8"))]
    return sorted(found)
