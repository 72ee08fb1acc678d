"""Results of rescoring: scores files, the table of the same pictures under all protocols, and the spread between them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from invgraphics.files import write_text, writing_text
from invgraphics.metrics.conventions import PROTOCOLS, Colour, Protocol
from invgraphics.runs.folder import RunFolder, output_folder
from invgraphics.runs.scores import DEFAULT, Score, Scores
from invgraphics.tools.predictions import PictureSet

COLUMNS = {"psnr": ("PSNR (dB)", 3), "ssim": ("SSIM", 4), "lpips": ("LPIPS", 4), "lpips_vgg": ("LPIPS (VGG)", 4)}
"""Metric -> heading and decimals, in the table's order."""


@dataclass(frozen=True, eq=False)
class Rescored:
    """Scores of one set of pictures under several protocols.

    Attributes:
        pictures: what was scored.
        label: short name, unique among those scored together.
        scores: protocol -> scores.
    """

    pictures: PictureSet
    label: str
    scores: dict[str, Scores]


def background_name(colour: Colour | None) -> str:
    """Human-readable name of a background colour."""
    named = {(1.0, 1.0, 1.0): "white", (0.0, 0.0, 0.0): "black", None: "not stated"}
    return named.get(colour) or "({:.3g}, {:.3g}, {:.3g})".format(*colour or ())


def labels(folders: Sequence[Path]) -> list[str]:
    """Shortest distinguishing suffix of each path; numbered where whole paths are equal."""
    parts = [folder.resolve().parts[1:] or ("root",) for folder in folders]
    for length in range(1, max(map(len, parts)) + 1):
        ends = ["/".join(part[-length:]) for part in parts]
        if len(set(ends)) == len(ends):
            return ends
    return [f"{part[-1]} {number}" for number, part in enumerate(parts, 1)]


def write_scores(rescored: Rescored, out: Path | None) -> list[Path]:
    """Write a scores file for each protocol under which something was scored; returns their paths.

    They go into the run itself; or into ``out``, which other tools' folders need, since nothing is written into them. Scores
    that `evaluate` made from the model are never replaced, and a run that was interrupted before it had any stays unfinished.
    """
    pictures = rescored.pictures
    if out is None and not pictures.provenance:
        return []
    folder = pictures.folder if out is None else out
    written = []
    with output_folder(folder):
        for protocol, scores in rescored.scores.items():
            if not scores.quality or (out is None and has_model_scores(pictures, protocol)):
                continue
            if out is None and protocol == DEFAULT and not RunFolder(folder).finished:
                continue  # they would mark the run as finished
            written.append(folder / scores.file)
            scores.write(written[-1])
    return written


def scores_of(pictures: PictureSet, protocol: str) -> Scores | None:
    """Read the run's scores under a protocol; ``None`` without any.

    Raises:
        InputError: they cannot be read.
    """
    run = RunFolder(pictures.folder)
    return run.read_scores(protocol) if pictures.provenance and run.scores_path(protocol).is_file() else None


def has_model_scores(pictures: PictureSet, protocol: str) -> bool:
    """Whether the run has scores under a protocol that were made from its model."""
    scores = scores_of(pictures, protocol)
    return scores is not None and not scores.rescored


def rows_of(rescored: Rescored) -> tuple[list[str], list[list[str]]]:
    """Table of one set of pictures: headings and rows per protocol, the last row the spread over protocols."""
    shown = {key: column for key, column in COLUMNS.items() if _values(rescored, key)}
    rows = []
    for name, scores in rescored.scores.items():
        cells = [_cell(scores.quality.get(key), decimals) for key, (_, decimals) in shown.items()]
        rows.append([name, *cells, *protocol_words(PROTOCOLS[name])])
    if len(rows) > 1 and shown:
        spread = [f"{spread_of(rescored, key):.{decimals}f}" for key, (_, decimals) in shown.items()]
        rows.append(["spread", *spread, "", "", ""])
    return ["protocol", *(heading for heading, _ in shown.values()), "background", "prediction", "truth"], rows


def spread_of(rescored: Rescored, metric: str) -> float:
    """Largest less smallest mean of a metric over the protocols that have it."""
    values = _values(rescored, metric)
    return max(values) - min(values)


def protocol_words(protocol: Protocol) -> tuple[str, str, str]:
    """Describe a protocol's background and its rounding of prediction and truth."""
    words = {"none": "float", "nearest": "8-bit, rounded", "down": "8-bit, truncated"}
    background = protocol.background if isinstance(protocol.background, str) else background_name(protocol.background)
    return background, words[protocol.prediction], words[protocol.truth]


def best_sets(results: Sequence[Rescored], metric: str) -> str:
    """Name the best set under each protocol in a sentence; empty for a single set, or without the metric."""
    best: dict[str, list[str]] = {}
    for protocol in results[0].scores:
        found = {one.label: one.scores[protocol].quality.get(metric) for one in results}
        known = {label: score.mean for label, score in found.items() if score is not None and score.mean is not None}
        if len(known) == len(results) > 1:
            sign = 1 if all(score is not None and score.higher_is_better for score in found.values()) else -1
            best.setdefault(max(known, key=lambda label: sign * known[label]), []).append(protocol)
    if not best:
        return ""
    if len(best) == 1:
        return f"Best {metric}: {next(iter(best))}, whatever the protocol."
    parts = "; ".join(f"{label} under {', '.join(protocols)}" for label, protocols in best.items())
    return f"Best {metric} depends on the protocol: {parts}."


def skip_reasons(rescored: Rescored) -> list[str]:
    """List the skipped protocols with their reasons, then the assumptions, one line each."""
    skipped: dict[str, dict[str, list[str]]] = {}
    noted: dict[str, list[str]] = {}
    for protocol, scores in rescored.scores.items():
        for metric, reason in scores.skipped.items():
            skipped.setdefault(reason, {}).setdefault(protocol, []).append(metric)
        for note in scores.notes:
            noted.setdefault(note, []).append(protocol)
    lines = []
    for reason, where in skipped.items():
        places = "; ".join(f"{protocol} ({', '.join(metrics)})" for protocol, metrics in where.items())
        lines.append(f"Skipped: {places}: {reason}.")
    everywhere = len(rescored.scores)
    return lines + [note if len(names) == everywhere else f"{note} ({', '.join(names)})" for note, names in noted.items()]


def write_tables(results: Sequence[Rescored], out: Path) -> list[Path]:
    """Write ``rescore.md`` (the tables) and ``rescore.csv`` (one line for each number) into ``out``."""
    lines = ["# The same pictures under several protocols", ""]
    for one in results:
        columns, rows = rows_of(one)
        width, height = one.pictures.size
        lines += [f"## {one.label}", "", f"{len(one.pictures.names)} views of {width}x{height} pixels.", ""]
        lines += [_markdown(row) for row in (columns, ["---"] * len(columns), *rows)]
        lines += ["", *(f"- {line}" for line in skip_reasons(one)), ""]
    lines += ["## Sources", ""]
    lines += [
        f"- {name}: {protocol.summary}. {_source(protocol)}"
        for name, protocol in PROTOCOLS.items()
        if name in results[0].scores
    ]
    page = out / "rescore.md"
    with output_folder(out):
        write_text(page, "\n".join(line for line in lines).strip() + "\n")
        return [page, _write_csv(results, out / "rescore.csv")]


def _write_csv(results: Sequence[Rescored], path: Path) -> Path:
    with writing_text(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["pictures", "protocol", "metric", "mean", "unit", "background", "prediction", "truth", "skipped"])
        for one in results:
            for protocol, scores in one.scores.items():
                rest = protocol_words(PROTOCOLS[protocol])
                for metric, entry in scores.quality.items():
                    writer.writerow([one.label, protocol, metric, repr(entry.mean), entry.unit, *rest, ""])
                for metric, reason in scores.skipped.items():
                    writer.writerow([one.label, protocol, metric, "", "", *rest, reason])
    return path


def _values(rescored: Rescored, metric: str) -> list[float]:
    found = [scores.quality[metric].mean for scores in rescored.scores.values() if metric in scores.quality]
    return [value for value in found if value is not None]


def _cell(entry: Score | None, decimals: int) -> str:
    return "-" if entry is None or entry.mean is None else f"{entry.mean:.{decimals}f}"


def _markdown(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _source(protocol: Protocol) -> str:
    return f"Read in {protocol.source}." if protocol.source else "Our own."
