"""Page content of one scene: tables, plots and pictures, of a comparison or of one scene of a study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from invgraphics.report.data.assets import Folder
from invgraphics.report.data.comparison import Comparison
from invgraphics.report.data.factors import METHOD, Factor, FailedFit, Observation
from invgraphics.report.figures.curves import draw_curves
from invgraphics.report.figures.distributions import draw_distributions
from invgraphics.report.figures.effects import draw_intervals
from invgraphics.report.figures.style import Figure
from invgraphics.report.figures.tradeoffs import draw_tradeoffs
from invgraphics.report.figures.views import ViewPage, draw_views, publish_truth
from invgraphics.report.statistics.clocks import disturbed_fits
from invgraphics.report.statistics.cross_render import CrossTable, cross_table
from invgraphics.report.statistics.effects import Effect, contrasts_of, effects_of
from invgraphics.report.statistics.pairing import Contrast
from invgraphics.report.statistics.sentences import disturbed_words, effect_sentence
from invgraphics.report.statistics.summary import Row, Summary, quality_columns, summarise
from invgraphics.report.statistics.time_to_quality import TimeToQuality, time_to_quality
from invgraphics.report.statistics.verdict import verdict
from invgraphics.report.wording import MeasuredQuantity
from invgraphics.runs.study import Approximation

TINY = 320
"""Pictures narrower than this are enlarged on the page, with hard pixel edges: what is compared is pixels."""


@dataclass(frozen=True)
class Drawn:
    """Plots and view maps of one scene.

    Attributes:
        curves: time to quality.
        tradeoffs: quality against each cost.
        distributions: per metric, its spread over views.
        views: the chosen test views.
    """

    curves: Figure | None
    tradeoffs: list[Figure]
    distributions: list[tuple[MeasuredQuantity, Figure]]
    views: tuple[ViewPage, ...]

    @property
    def figures(self) -> list[Figure]:
        """Every plot, in the order of the page."""
        return [*([self.curves] if self.curves else []), *self.tradeoffs, *(figure for _, figure in self.distributions)]


@dataclass(frozen=True)
class Thumbnail:
    """A small picture of the truth; ``anchor`` is empty where the page does not show that view in full."""

    url: str
    name: str
    anchor: str


@dataclass(frozen=True)
class Contrasts:
    """Effects of factor levels on every quality metric.

    Attributes:
        tables: (metric, its effects); the first metric is the one that sentences and plot are about.
        figure: interval plot of the first metric.
        disturbed: how many fits' times are compared with nothing, in a sentence; empty for none.
    """

    tables: tuple[tuple[MeasuredQuantity, list[Effect]], ...]
    figure: Figure | None
    disturbed: str = ""

    @property
    def first(self) -> list[Effect]:
        """Effects on the first metric."""
        return self.tables[0][1] if self.tables else []

    @property
    def sentences(self) -> list[str]:
        """Effects on the first metric in words."""
        return list(map(effect_sentence, self.first))


@dataclass(frozen=True)
class Part:
    """Page content of one scene: summary, verdict, plots and pictures.

    Attributes:
        key: prefix of its anchors and folders; empty where the page has a single part.
        comparison: its methods or variants.
        summary: their table.
        verdict: its sentences.
        time_to_quality: seconds to reach PSNR levels; ``None`` without monitored runs.
        drawn: plots and pictures.
        thumbnails: the truth of every test view.
        cross_table: the same fits through other renderers, where they were rendered.
    """

    key: str
    comparison: Comparison
    summary: Summary
    verdict: list[str]
    time_to_quality: TimeToQuality | None
    drawn: Drawn
    thumbnails: list[Thumbnail]
    cross_table: CrossTable | None

    @property
    def groups(self) -> list[tuple[str, str, list[int]]]:
        """(heading, explanation, columns) of the tables: pictures with costs, geometry apart so that both fit a page."""
        columns = list(enumerate(self.summary.columns))
        pictures = [index for index, column in columns if column.group != "geometry"]
        geometry = [index for index, column in columns if column.group == "geometry"]
        groups = [("", "", pictures)]
        if geometry:
            groups.append(("Geometry", "Depth and normals are scored where truth and prediction are both opaque.", geometry))
        return groups

    @property
    def several_seeds(self) -> bool:
        """Whether any method has several seeds, and so a spread."""
        return any(row.seeds > 1 for row in self.summary.methods)

    def has_values(self, row: Row, columns: Sequence[int]) -> bool:
        """Whether a row has a value in any of the columns."""
        return any(row.cells[index].mean is not None for index in columns)

    @property
    def tiny(self) -> bool:
        """Whether pictures are shown enlarged, with hard pixel edges."""
        return bool(self.drawn.views) and self.drawn.views[0].width < TINY

    def anchor(self, name: str) -> str:
        """HTML id of ``name`` in this part, unique on the page."""
        return f"{self.key}-{name}" if self.key else name


def draw_part(comparison: Comparison, folder: Folder, approximations: Sequence[Approximation] = (), tables: int = 1) -> Part:
    """Summarise a scene, derive its verdict, and draw its plots and pictures below ``folder.figures``.

    Args:
        comparison: the scene's runs.
        folder: where to write.
        approximations: pairs of renderers that a study compares on every fit.
        tables: tables of the page, over which tests are corrected.

    Raises:
        InputError: a picture or an array is missing or broken.
    """
    summary = summarise(comparison, tables)
    drawn = Drawn(
        views=draw_views(comparison, folder),  # first, because it reads the files that may be broken
        curves=draw_curves(comparison, summary, folder.figures),
        tradeoffs=draw_tradeoffs(summary, folder.figures),
        distributions=draw_distributions(comparison, summary, folder.figures),
    )
    return Part(
        key=folder.part,
        comparison=comparison,
        summary=summary,
        verdict=verdict(comparison, summary),
        time_to_quality=time_to_quality(comparison),
        drawn=drawn,
        thumbnails=_thumbnails(comparison, drawn, folder),
        cross_table=cross_table(comparison, approximations, folder, tables),
    )


def draw_contrasts(
    quantities: Sequence[MeasuredQuantity],
    contrasts: Sequence[Contrast],
    observed: tuple[Sequence[Observation], Sequence[FailedFit]],
    folder: Folder,
    factors: Sequence[Factor] = (),
) -> Contrasts:
    """Estimate contrasts in every metric; interval plot of the first.

    Args:
        quantities: metrics and costs.
        contrasts: what is compared.
        observed: finished runs, and fits that failed.
        folder: of the page.
        factors: of the study, whose words name the levels of other factors.
    """
    every = ((quantity, effects_of(contrasts, quantity, *observed, factors=factors)) for quantity in quantities)
    tables = tuple((quantity, found) for quantity, found in every if found)
    told = (disturbed_words(len(disturbed_fits(observed[0], quantity)), quantity) for quantity in quantities)
    words = " ".join(dict.fromkeys(filter(None, told)))
    return Contrasts(tables, draw_intervals(tables[0][1], folder.figures) if tables else None, words)


def method_contrasts(comparison: Comparison, folder: Folder) -> Contrasts:
    """Effects between a comparison's methods; empty where a single seed gives no interval."""
    methods = tuple(method for method in comparison.methods if comparison.runs_of(method))
    if len(methods) < 2 or len({run.seed for run in comparison.runs}) < 2:
        return Contrasts((), None)
    runs = [Observation(run, comparison.scene, {METHOD: run.method}) for run in comparison.runs]
    lost = [FailedFit(comparison.scene, {METHOD: failure.method}) for failure in comparison.failures]
    pairs = contrasts_of([Factor(METHOD, methods, methods[0])])
    return draw_contrasts(quality_columns(comparison), pairs, (runs, lost), folder)


def _thumbnails(comparison: Comparison, drawn: Drawn, folder: Folder) -> list[Thumbnail]:
    if not comparison.runs:
        return []
    run, shown = comparison.runs[0], {view.index for view in drawn.views}
    prefix = f"{folder.part}-" if folder.part else ""
    return [
        Thumbnail(publish_truth(run, index, folder), name, f"{prefix}view-{index}" if index in shown else "")
        for index, name in enumerate(run.scores.views)
    ]
