"""Quality of inferred instances against the number of views that they were inferred from."""

from __future__ import annotations

from pathlib import Path

from invgraphics.report.figures.style import PAGE, Figure, canvas, save, series_style
from invgraphics.report.statistics.instances import counts_of, mean_of, methods_of
from invgraphics.runs.inference import Inference

SIZE = (480.0, 400.0)
DODGE = 0.045
"""Of neighbouring methods, in powers of two, so that their intervals stay apart."""


def draw_few_views(record: Inference, metric: str, label: str, folder: Path) -> Figure | None:
    """Mean of a metric over instances, with 95 % intervals, over numbers of views; ``None`` for one number, or no values.

    Args:
        record: of the inference.
        metric: its key.
        label: of the axis, with unit.
        folder: of the figure.
    """
    counts = counts_of(record)
    methods = [method for method in methods_of(record) if any(mean_of(record, metric, n, method) for n in counts)]
    if len(counts) < 2 or not methods:
        return None
    words = []
    with canvas(*SIZE) as (figure, axes):
        for index, method in enumerate(methods):
            found = [(n, value) for n in counts if (value := mean_of(record, metric, n, method)) is not None]
            look, shift = series_style(index), 2.0 ** (DODGE * (index - (len(methods) - 1) / 2))
            axes.errorbar(
                [n * shift for n, _ in found],
                [value.mean for _, value in found],
                yerr=[value.half_width for _, value in found],
                color=look.colour,
                marker=look.marker,
                linestyle=look.dash,
                linewidth=1.8,
                elinewidth=1.2,
                markersize=6,
                markeredgecolor=PAGE.light,
                markeredgewidth=0.6,
                label=method,
            )
            words.append(f"{method} {', '.join(f'{value.mean:.1f} from {n}' for n, value in found)}")
        axes.set_xscale("log", base=2)
        axes.set_xticks(counts, [str(n) for n in counts])
        axes.set_xlabel("observed views")
        axes.set_ylabel(label)
        figure.legend(loc="outside upper left", ncols=1, frameon=False, fontsize=11)
        path = save(figure, folder / f"{metric}-over-views")
    title = f"{label} against observed views"
    return Figure(path, None, title, f"{title}: {'; '.join(words)}.")
