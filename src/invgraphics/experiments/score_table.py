"""Scores as an object of the public interface: a mapping from metrics to means that shows itself in notebooks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import final

from invgraphics.experiments.display import table_html
from invgraphics.runs.scores import Scores


@final
@dataclass(frozen=True, eq=False)
class ScoreTable(Mapping[str, float]):
    """Scores of a model on a scene's test views: metric -> mean over the views.

    Attributes:
        record: everything, as a run folder holds it: ``quality``, ``cost``, ``views``, ``skipped``, ``protocol``.

    Example:
        >>> import invgraphics as ig
        >>> from invgraphics.testing import TwoBalls, toy_scene
        >>> scene = toy_scene(views=2, size=16)
        >>> renderer = ig.load_method("volumetric/nerf").recipe.renderer.build(scene)
        >>> scores = ig.evaluate(ig.Model(TwoBalls(), renderer, scene.bounds), scene)
        >>> scores["psnr"] > 25 and scores.unit("psnr") == "dB" and len(scores.per_view("psnr")) == len(scene.test)
        True
    """

    record: Scores

    def __getitem__(self, metric: str) -> float:
        mean = self.record.quality[metric].mean
        return math.nan if mean is None else mean

    def __iter__(self) -> Iterator[str]:
        return iter(self.record.quality)

    def __len__(self) -> int:
        return len(self.record.quality)

    def per_view(self, metric: str) -> tuple[float, ...]:
        """One value for each test view, in the scene's order; NaN where a view has none."""
        return tuple(math.nan if value is None else value for value in self.record.quality[metric].per_view)

    def unit(self, metric: str) -> str:
        """The metric's unit; empty where it has none."""
        return self.record.quality[metric].unit

    def _title(self) -> str:
        return f"{self.record.scene}, {len(self.record.views)} test views, protocol {self.record.protocol}"

    def __repr__(self) -> str:
        return "\n".join([self._title(), *(f"  {name:20} {value:10.4g} {self.unit(name)}" for name, value in self.items())])

    def _repr_html_(self) -> str:
        better = {True: "higher", False: "lower"}
        rows = [
            (name, f"{value:.4g}", self.unit(name), better[self.record.quality[name].higher_is_better])
            for name, value in self.items()
        ]
        return table_html(self._title(), ("metric", "mean", "unit", "better"), rows)
