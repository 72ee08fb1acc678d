"""Search for a larger cached rendering of a scene whose pictures can be area-averaged instead of rendering smaller ones."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from invgraphics.scenes.mitsuba import cache
from invgraphics.scenes.mitsuba.job import Job, Source
from invgraphics.scenes.mitsuba.rig import SPLITS
from invgraphics.scenes.mitsuba.spec import Counts, SamplesPerPixel


def averaged(job: Job, exact: bool = False) -> Job | None:
    """Job that averages a larger cached rendering to the same pictures; ``None`` where none has enough samples.

    Of several, one that has been averaged before is taken, then one whose pixels are whole parts of the new ones, then the
    smallest.

    Args:
        job: what is wanted.
        exact: whether the effective samples per pixel must be those of the job, as where they were asked for: such noise must
            not depend on what the cache holds.
    """
    if job.spec.instances is not None:
        return None  # a class is rendered at each size
    found = [replace(job, samples=effective, source=source) for source, effective in _sources(job, exact)]
    return min(found, key=_preference, default=None)


def _preference(job: Job) -> tuple[bool, bool, int]:
    assert job.source is not None
    width, height = job.source.size
    made = cache.read_truth(cache.root() / job.folder_name) is not None
    return not made, width % job.size[0] != 0 or height % job.size[1] != 0, width * height


def _sources(job: Job, exact: bool) -> Iterator[tuple[Source, SamplesPerPixel]]:
    """List usable larger renderings of the scene, with the effective samples per pixel of their averages."""
    for folder in sorted(cache.root().glob(f"*/{cache.TRUTH}")):
        truth = cache.read_truth(folder.parent)
        if truth is None or truth.get("name") != job.spec.name or cache.AVERAGED_FROM in truth:
            continue
        source = _source_of(truth)
        if source is None or not _is_larger(source, job):
            continue
        effective = _effective(source, job.size)
        enough = _is_exactly(source, job) if exact else _at_least(effective, job.samples)
        views = all(getattr(source.views, split) >= getattr(job.views, split) for split in SPLITS)
        # The key stands for description, seed, variant, our sources and the renderer's version: all must be today's.
        if enough and views and replace(job, source=source).rendered_source().folder_name == folder.parent.name:
            yield source, effective


def _at_least(samples: SamplesPerPixel, wanted: SamplesPerPixel) -> bool:
    return all(getattr(samples, split) >= getattr(wanted, split) for split in SPLITS)


def _is_exactly(source: Source, job: Job) -> bool:
    """Whether averages have the job's samples per pixel to the last one: `_effective` rounds down."""
    pixels, new_pixels = math.prod(source.size), math.prod(job.size)
    return all(getattr(source.samples, split) * pixels == getattr(job.samples, split) * new_pixels for split in SPLITS)


def _source_of(truth: Mapping[str, Any]) -> Source | None:
    try:
        width, height = truth["size"]
        views = Counts(**{split: len(truth["cameras"][split]) for split in SPLITS})
        return Source((width, height), views, SamplesPerPixel(**truth["samples_per_pixel"]))
    except (KeyError, TypeError, ValueError):
        return None


def _is_larger(source: Source, job: Job) -> bool:
    (width, height), (new_width, new_height) = source.size, job.size
    return width > new_width and width * new_height == height * new_width


def _effective(source: Source, size: tuple[int, int]) -> SamplesPerPixel:
    """Effective samples per averaged pixel."""
    pixels, new_pixels = math.prod(source.size), math.prod(size)
    train, val, half = (
        count * pixels // new_pixels for count in (source.samples.train, source.samples.val, source.samples.test // 2)
    )
    return SamplesPerPixel(train, val, 2 * half)
