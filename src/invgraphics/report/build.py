"""Report of a comparison or of single runs: HTML, Markdown, CSV, LaTeX and figures."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from invgraphics.errors import InputError
from invgraphics.report.data.assets import Folder, writing
from invgraphics.report.data.comparison import Comparison, check_comparable, read_comparison
from invgraphics.report.data.pictures import read_picture
from invgraphics.report.data.redact import check_runs_outside, redactor_for
from invgraphics.report.pages.comparison import write_html, write_markdown
from invgraphics.report.pages.longtable import write_comparison_table
from invgraphics.report.pages.parts import draw_part, method_contrasts
from invgraphics.report.pages.tables import effects_caption, write_latex, write_latex_effects
from invgraphics.report.wording import listing
from invgraphics.runs.run import Run, read_run, truth_picture


def build_report(folder: Path, out: Path | None = None, public: bool = False) -> Path:
    """Write the report of a comparison into its own folder, or into another one.

    Args:
        folder: what ``compare`` wrote.
        out: where to write; ``None`` for the comparison's own folder.
        public: leave out everything private, which needs a folder of its own.

    Returns:
        The page, ``index.html``; beside it lie ``index.md``, ``results.csv`` and ``.parquet``, ``table.tex`` and ``figures/``.

    Raises:
        InputError: a file is missing or broken, or the folder cannot be written.
    """
    return _write(read_comparison(folder), folder if out is None else out, folder, public)


def build_from_runs(runs: Sequence[Path], out: Path, public: bool = False) -> Path:
    """Write a report of any run folders; files that the page shows are copied into ``out`` unless they lie there already.

    Args:
        runs: run folders.
        out: folder to write; created where absent.
        public: leave out everything private.

    Returns:
        The page, ``out/index.html``.

    Raises:
        InputError: no runs, a file is missing or broken, or the runs were scored against different ground truth.
    """
    if not runs:
        raise InputError("There are no runs to report.", "Give at least one run folder.")
    folders = list({path.resolve(): path for path in runs}.values())
    read = [read_run(path) for path in folders]
    check_comparable(tuple(read))
    labelled = _with_unique_names(read)
    methods = tuple(dict.fromkeys(run.method for run in labelled))
    first = labelled[0]
    picture = read_picture(truth_picture(first.truth, 0))
    comparison = Comparison(
        scene=_common([run.scores.scene for run in labelled]),
        question=f"How {'does' if len(methods) == 1 else 'do'} {listing(methods)} show new views, and at what cost?",
        methods=methods,
        runs=tuple(labelled),
        budget=_common([run.provenance.budget for run in labelled]),
        preset=_common([run.scores.preset for run in labelled]),
        size=(picture.shape[1], picture.shape[0]),
        protocol={"name": first.scores.protocol},
    )
    base = Path(os.path.commonpath([path.resolve().parent for path in folders])) if public else out
    return _write(comparison, out, base, public)


def _write(comparison: Comparison, out: Path, base: Path, public: bool) -> Path:
    """Write all outputs of a comparison into ``out``; tables name runs by their path from ``base``."""
    redactor = None
    if public:
        check_runs_outside(out, [run.folder for run in comparison.runs])
        redactor = redactor_for([comparison])
        comparison = redactor.value(comparison)
    folder = Folder(out, redactor=redactor)
    with writing(out):
        part = draw_part(comparison, folder)
        contrasts = method_contrasts(comparison, folder)
        write_comparison_table(comparison, out / "results", base)
        write_latex(comparison, part.summary, out / "table.tex")
        if contrasts.tables:
            write_latex_effects(contrasts.first, effects_caption(contrasts.first), out / "effects.tex")
        write_markdown(part, contrasts, folder)
        write_html(part, contrasts, folder)
    return out / "index.html"


def _common(values: Sequence[str]) -> str:
    """The value that all share; empty where they differ."""
    return values[0] if len(set(values)) == 1 else ""


def _with_unique_names(runs: Sequence[Run]) -> list[Run]:
    """Make (method, seed) unique: append the preset, the budget or else the folder to the method's name."""
    cells = [(run.method, run.seed) for run in runs]
    if len(set(cells)) == len(cells):
        return list(runs)
    for detail in ("preset", "budget"):
        details = [run.scores.preset if detail == "preset" else run.provenance.budget for run in runs]
        named = [(f"{run.method} ({what})", run.seed) for run, what in zip(runs, details, strict=True)]
        if len(set(named)) == len(named):
            return [replace(run, method=name) for run, (name, _) in zip(runs, named, strict=True)]
    return [replace(run, method=f"{run.method} ({_folder_name(run, runs)})") for run in runs]


def _folder_name(run: Run, runs: Sequence[Run]) -> str:
    """Shortest suffix of a run's path that is unique among ``runs``."""
    paths = [other.folder.resolve().parts for other in runs]
    own = run.folder.resolve().parts
    length = next(n for n in range(1, len(own) + 1) if sum(path[-n:] == own[-n:] for path in paths) == 1)
    return "/".join(own[-length:]).lstrip("/")
