"""Report of inferred instances of a class of objects: scores beside baselines with paired intervals, and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from invgraphics.files import write_text
from invgraphics.report.data.assets import Folder, writing
from invgraphics.report.pages.comparison import render
from invgraphics.report.statistics.intervals import Estimate, estimate
from invgraphics.runs.inference import Inference, InstanceScores

SHOWN = {
    "psnr": ("PSNR", "dB"),
    "ssim": ("SSIM", ""),
    "normal_deg": ("normal error", "degrees"),
    "depth_abs_rel": ("depth error", "relative"),
    "alpha_iou": ("silhouette", "IoU"),
}
"""Metric -> its heading and unit, in the order of the table."""
NAMES = {"input": "input view", "truth": "truth, hidden side"}


@dataclass(frozen=True)
class Row:
    """A way of making instances, from one number of observed views.

    Attributes:
        how: its name.
        observed: number of views.
        cells: a text for each metric.
        input_psnr: of the observed views.
        seconds: of optimisation, for all instances.
    """

    how: str
    observed: int
    cells: tuple[str, ...]
    input_psnr: str
    seconds: str


def build_inference_report(folder: Path) -> Path:
    """Write the page of an inference; returns it, ``index.html``. Beside it: ``index.md`` with the table and the sentences.

    Raises:
        InputError: the folder holds no inference, or cannot be written.
    """
    record = Inference.read(folder / Inference.FILE)
    rows, sentences = _rows(record), inference_sentences(folder)
    with writing(folder):
        write_text(folder / "index.md", _markdown(record, rows, sentences))
        context = {
            "record": record,
            "rows": rows,
            "headings": tuple(SHOWN.values()),
            "sentences": sentences,
            "columns": {views: [NAMES.get(name, name) for name in names] for views, names in record.columns.items()},
            "subjects": sorted({one.subject for one in record.instances}),
            "count": len({one.subject for one in record.instances}),
            "environment": {"date": record.date},
        }
        render("inference.html", context, Folder(folder))
    return folder / "index.html"


def inference_sentences(folder: Path) -> list[str]:
    """Differences of the first prior to everything else, from the same views: means over instances, 95 % intervals.

    Raises:
        InputError: the folder holds no inference.
    """
    record = Inference.read(folder / Inference.FILE)
    first = next(iter(record.runs))
    sentences = []
    for observed in sorted({one.observed for one in record.instances}):
        others = dict.fromkeys(one.how for one in record.instances if one.observed == observed and one.how != first)
        for other in others:
            gain = paired(record, "psnr", observed, (first, other))
            if gain is None:
                continue
            views = "1 view" if observed == 1 else f"{observed} views"
            sentence = f"From {views}, {first} against {other}: {_signed(gain)} dB of PSNR on other views"
            errors = [mean_of(record, "normal_deg", observed, how) for how in (first, other)]
            if all(error is not None for error in errors):
                turned = paired(record, "normal_deg", observed, (first, other))
                assert turned is not None
                sentence += f"; normals are off by {errors[0]:.1f} instead of {errors[1]:.1f} degrees ({_signed(turned)})"
            sentences.append(f"{sentence}.")
    return sentences


def paired(record: Inference, metric: str, observed: int, pair: tuple[str, str]) -> Estimate | None:
    """Mean difference of a metric between two ways on the same test views; instances are the sample."""
    first, second = ({one.subject: one for one in _made(record, observed, how)} for how in pair)
    differences = [[_values(first[s], metric) - _values(second[s], metric)] for s in first if s in second]
    return estimate([d for d in differences if np.isfinite(d[0]).any()], over="scenes")


def mean_of(record: Inference, metric: str, observed: int, how: str) -> float | None:
    """Mean of a metric over the test views of each instance, then over instances; ``None`` where there is none."""
    means = [
        values[np.isfinite(values)].mean()
        for one in _made(record, observed, how)
        if np.isfinite(values := _values(one, metric)).any()
    ]
    return float(np.mean(means)) if means else None


def _made(record: Inference, observed: int, how: str) -> list[InstanceScores]:
    return [one for one in record.instances if one.how == how and one.observed == observed]


def _values(scores: InstanceScores, metric: str) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in scores.quality.get(metric, ())], dtype=float)


def _rows(record: Inference) -> list[Row]:
    rows = []
    for observed, how in dict.fromkeys((one.observed, one.how) for one in record.instances):
        cells = []
        for metric in SHOWN:
            mean = mean_of(record, metric, observed, how)
            cells.append(
                "–" if mean is None else f"{mean:.3f}" if metric in ("ssim", "depth_abs_rel", "alpha_iou") else f"{mean:.2f}"
            )
        seen = np.mean([one.input_psnr for one in _made(record, observed, how)])
        spent = record.seconds.get(how, {}).get(str(observed))
        rows.append(Row(how, observed, tuple(cells), f"{seen:.2f}", "–" if spent is None else f"{spent:.0f}"))
    return rows


def _signed(gain: Estimate) -> str:
    interval = "" if gain.p is None else f" [{gain.low:+.2f}, {gain.high:+.2f}]"
    return f"{gain.mean:+.2f}{interval}"


def _markdown(record: Inference, rows: Sequence[Row], sentences: Sequence[str]) -> str:
    head = [
        "observed views",
        "made by",
        *(f"{name} ({unit})" if unit else name for name, unit in SHOWN.values()),
        "PSNR of the input (dB)",
        "seconds",
    ]
    lines = [f"# Unseen {record.scene}", "", *(f"- {sentence}" for sentence in sentences), ""]
    lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += [f"| {row.observed} | {row.how} | " + " | ".join([*row.cells, row.input_psnr, row.seconds]) + " |" for row in rows]
    return "\n".join([*lines, "", f"`{record.command}`, {record.date}", ""])
