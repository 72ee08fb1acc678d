"""``renderings.json``: one fitted field by several renderers, and the differences of their pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from invgraphics.runs.schema import Record

OWN = "."
"""Folder of the fit itself, as a rendering."""


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """A renderer's name, as given, and the relative folder of the run rendered with it (`OWN`: the fit itself)."""

    renderer: str
    run: str


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Difference between unrounded pictures of one fit by two renderers, colours in [0, 1] over the scene's background.

    Attributes:
        renderers: as they were named.
        rmse: per test view, root of the mean square over pixels and channels.
        largest: per test view, largest absolute difference.
        depth: median absolute difference of depth, world units, of every test view in which both show a surface (alpha >= 0.5).
    """

    renderers: tuple[str, str]
    rmse: tuple[float, ...]
    largest: tuple[float, ...] = ()
    depth: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Renderings(Record):
    """All renderings of a fit.

    Attributes:
        identity: hash of the fit and of all renderers.
        fitted_by: the method.
        views: names of the test views.
        renderings: the fit's own renderer first.
        differences: of each pair of them.
    """

    FILE: ClassVar[str] = "renderings.json"

    identity: str = ""
    fitted_by: str = ""
    views: tuple[str, ...] = ()
    renderings: tuple[Rendering, ...]
    differences: tuple[Difference, ...]
