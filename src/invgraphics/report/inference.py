"""Report of inferred instances of a class of objects: scores beside baselines with paired intervals, and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from invgraphics.files import write_text
from invgraphics.report.data.assets import Folder, writing
from invgraphics.report.figures.few_views import draw_few_views
from invgraphics.report.figures.style import Figure
from invgraphics.report.pages.comparison import markdown_figures, render
from invgraphics.report.pages.tables import escape_markdown
from invgraphics.report.statistics.instances import (
    Cell,
    counts_of,
    flattered,
    lacking,
    lost,
    mean_of,
    methods_of,
    paired,
    scores_of,
    subjects_of,
    table_of,
)
from invgraphics.report.statistics.intervals import Estimate
from invgraphics.report.statistics.values import PERFECT_DB
from invgraphics.runs.inference import Inference

SHOWN = {
    "psnr": ("PSNR", "dB"),
    "ssim": ("SSIM", ""),
    "normal_deg": ("normal error", "degrees"),
    "depth_abs_rel": ("depth error", "relative"),
    "alpha_iou": ("silhouette", "IoU"),
}
"""Metric -> its heading and unit, in the order of the table."""
DRAWN = {"psnr": "PSNR (dB)", "normal_deg": "normal error (degrees)"}
"""Metrics that have a plot and tables of differences."""


@dataclass(frozen=True)
class Row:
    """One inference method, from one number of observed views.

    Attributes:
        method: its name.
        observed: number of views.
        cells: a text for each metric.
        input_psnr: of the observed views.
        seconds: of optimisation, for all instances.
    """

    method: str
    observed: int
    cells: tuple[str, ...]
    input_psnr: str
    seconds: str


ONE_FIT = "One fit of each: intervals are over instances, and say nothing of another fit."
"""Beside differences between fits."""


@dataclass(frozen=True)
class Differences:
    """Table of a metric over numbers of views: each way's mean, and its difference from the first way.

    Attributes:
        label: the metric with its unit.
        rows: name -> (mean, difference with interval, whether beyond chance) for each number of views.
    """

    label: str
    rows: dict[str, list[tuple[str, str, bool]]]


@dataclass(frozen=True)
class Strip:
    """Pictures of an instance: number, file, and the PSNR of each model in words."""

    subject: int
    url: str
    scores: tuple[str, ...]


def build_inference_report(folder: Path) -> Path:
    """Write the page of an inference; returns it, ``index.html``. Beside it: ``index.md`` with tables and sentences.

    Raises:
        InputError: the folder holds no inference, or cannot be written.
    """
    record = Inference.read(folder / Inference.FILE)
    rows, sentences, counts = _rows(record), inference_sentences(folder), counts_of(record)
    priors, first = list(record.runs), next(iter(record.runs))
    baselines = [method for method in methods_of(record) if method not in record.runs]
    with writing(folder):
        place = Folder(folder)
        figures = [
            one for key, label in DRAWN.items() if (one := draw_few_views(record, key, label, folder / "figures")) is not None
        ]
        worth = [_differences(record, key, [first, *baselines], bold=True) for key in DRAWN] if len(counts) > 1 else []
        fits = [_differences(record, key, priors, bold=False) for key in DRAWN] if len(priors) > 1 else []
        context = {
            "record": record,
            "rows": rows,
            "headings": tuple(SHOWN.values()),
            "sentences": sentences,
            "counts": counts,
            "first": first,
            "worth": worth,
            "fits": fits,
            "figures": figures,
            "strips": {n: _strips(record, n) for n in counts if n in record.pictures},
            "one_fit": ONE_FIT,
            "count": len({one.subject for one in record.instances}),
            "environment": {"date": record.date},
        }
        write_text(folder / "index.md", _markdown(context, place))
        render("inference.html", context, place)
    return folder / "index.html"


def inference_sentences(folder: Path) -> list[str]:
    """Differences of the first prior to everything else, from the fewest views: means over instances, 95 % intervals.

    Raises:
        InputError: the folder holds no inference.
    """
    record = Inference.read(folder / Inference.FILE)
    first, observed = next(iter(record.runs)), min(counts_of(record), default=1)
    sentences = []
    for other in sorted(methods_of(record), key=lambda method: method in record.runs):  # the baselines first
        gain = None if other == first else paired(record, "psnr", observed, (first, other))
        if gain is None:
            continue
        sentence, pair = f"From {_views(observed)}, {first} against {other}: ", (first, other)
        lacks = lost(record, "psnr", observed, pair)
        if flattered("psnr", gain, lacks):
            sentences.append(f"{sentence}not compared, since {_lost_words(pair, lacks)}.")
            continue
        sentence += f"{_signed(gain)} dB of PSNR on other views" + (f", where {_lost_words(pair, lacks)}" if any(lacks) else "")
        sentences.append(f"{sentence}{_normals_words(record, observed, pair)}.")
    return sentences


def _normals_words(record: Inference, observed: int, pair: tuple[str, str]) -> str:
    """Difference of the errors of normals, as the end of a sentence; empty where it is not known, or says too much."""
    errors = [mean_of(record, "normal_deg", observed, method) for method in pair]
    turned, lacks = paired(record, "normal_deg", observed, pair), lost(record, "normal_deg", observed, pair)
    if errors[0] is None or errors[1] is None or turned is None or flattered("normal_deg", turned, lacks):
        return ""
    lost_words = f", where {_lost_words(pair, lacks)}" if any(lacks) else ""
    return f"; normals are off by {errors[0].mean:.1f} instead of {errors[1].mean:.1f} degrees ({_signed(turned)}){lost_words}"


def _lost_words(pair: tuple[str, str], lacks: tuple[int, int]) -> str:
    """Say which of two methods lacks scores of how many instances that the other one has."""
    sentences = [f"{name} lacks scores of {_instances(count)}" for name, count in zip(pair, lacks, strict=True) if count]
    return " and ".join(sentences)


def _instances(count: int) -> str:
    return "1 instance" if count == 1 else f"{count} instances"


def _views(count: int) -> str:
    return "1 view" if count == 1 else f"{count} views"


def _text(metric: str, value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}" if metric in ("ssim", "depth_abs_rel", "alpha_iou") else f"{value:.2f}"


def _signed(gain: Estimate) -> str:
    interval = "" if gain.p is None else f" [{gain.low:+.2f}, {gain.high:+.2f}]"
    return f"{gain.mean:+.2f}{interval}"


def _rows(record: Inference) -> list[Row]:
    rows = []
    for observed in counts_of(record):
        for method in methods_of(record):
            found = scores_of(record, observed, method)
            if not found:
                continue
            means = {metric: mean_of(record, metric, observed, method) for metric in SHOWN}
            cells = tuple(
                _text(metric, None if mean is None else mean.mean) + _counted(record, metric, observed, method)
                for metric, mean in means.items()
            )
            spent = [one.seconds for one in found if one.seconds is not None]
            seen = [one.input_psnr for one in found if one.input_psnr is not None]
            text = _text("psnr", float(np.mean(seen)) if seen else None)
            rows.append(Row(method, observed, cells, text, f"{sum(spent):.0f}" if spent else "–"))
    return rows


def _counted(record: Inference, metric: str, observed: int, method: str) -> str:
    """Number of instances of which all is known, in brackets; empty where a method lacks no score that another one has."""
    total, lacks = len(subjects_of(record, observed)), lacking(record, metric, observed, method)
    return f" ({total - lacks} of {total})" if lacks else ""


def _differences(record: Inference, metric: str, methods: Sequence[str], *, bold: bool) -> Differences:
    """Table of a metric; ``bold`` where chance is that of the instances alone, as it is not between two fits."""

    def words(cell: Cell) -> tuple[str, str, bool]:
        gain = "" if cell.gain is None else _signed(cell.gain)
        if gain and any(cell.lost):
            gain += f", {_instances(sum(cell.lost))} incomplete"
        return _text(metric, cell.mean), gain, bold and cell.certain

    table = table_of(record, metric, methods)
    return Differences(DRAWN[metric], {method: [words(cell) for cell in cells.values()] for method, cells in table.items()})


def _strips(record: Inference, observed: int) -> list[Strip]:
    strips = []
    for subject in subjects_of(record, observed):
        texts = []
        for method in record.columns[str(observed)]:
            own = [one for one in scores_of(record, observed, method) if one.subject == subject]
            values = [min(value, PERFECT_DB) for one in own for value in one.quality.get("psnr", ()) if value is not None]
            texts.append(f"{np.mean(values):.1f} dB" if values else "")
        strips.append(Strip(subject, f"pictures/{observed}/{subject:04d}.png", tuple(texts)))
    return strips


def _markdown(context: dict, place: Folder) -> str:
    record: Inference = context["record"]
    figures: list[Figure] = context["figures"]
    text, counts = escape_markdown, context["counts"]
    lines = [f"# Unseen {record.scene}", "", *(f"- {text(sentence)}" for sentence in context["sentences"]), ""]
    titles = [("What the prior is worth", context["worth"]), ("The fits compared", context["fits"])]
    for title, one in ((title, one) for title, tables in titles for one in tables):
        lines += [f"{title}: {one.label}, mean over instances; in brackets the difference from the first row.", ""]
        lines += ["| made by | " + " | ".join(_views(n) for n in counts) + " |", "|---" * (1 + len(counts)) + "|"]
        for method, cells in one.rows.items():
            words = [f"{mean} ({'**' + gain + '**' if sure else gain})" if gain else mean for mean, gain, sure in cells]
            lines.append(f"| {text(method)} | {' | '.join(words)} |")
        lines.append("")
    if context["fits"]:
        lines += [ONE_FIT, ""]
        lines += ["| fit | parameters | budget | steps | seconds |", "|---|---|---|---|---|"]
        for method, fit in record.fits.items():
            seconds = "–" if fit.seconds is None else f"{fit.seconds:.0f}"
            lines.append(f"| {text(method)} | {fit.parameters:,} | {fit.budget} | {fit.steps or '–'} | {seconds} |")
        lines.append("")
    names = (f"{name} ({unit})" if unit else name for name, unit in SHOWN.values())
    head = ["observed views", "made by", *names, "PSNR of the input (dB)", "seconds"]
    lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in context["rows"]:
        lines.append(f"| {row.observed} | {text(row.method)} | " + " | ".join([*row.cells, row.input_psnr, row.seconds]) + " |")
    lines += markdown_figures(figures, place)
    return "\n".join([*lines, "", f"`{record.command}`, {record.date}", ""])
