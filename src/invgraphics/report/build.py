"""Report of a comparison or of single runs: HTML, Markdown, CSV, LaTeX and figures."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
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
from invgraphics.runs.comparison import Failure
from invgraphics.runs.run import Run, read_run, truth_picture
from invgraphics.text import common_value


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


def build_from_runs(runs: Sequence[Path], out: Path, public: bool = False, failures: Sequence[Failure] = ()) -> Path:
    """Write a report of any run folders; files that the page shows are copied into ``out`` unless they lie there already.

    Args:
        runs: run folders.
        out: folder to write; created where absent.
        public: leave out everything private.
        failures: failed fits of the comparisons that the runs come from.

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
        scene=common_value([run.scores.scene for run in labelled]),
        question=f"How {'does' if len(methods) == 1 else 'do'} {listing(methods)} show new views, and at what cost?",
        methods=methods,
        runs=tuple(labelled),
        budget=common_value([run.provenance.budget for run in labelled]),
        preset=common_value([run.scores.preset for run in labelled]),
        size=(picture.shape[1], picture.shape[0]),
        protocol={"name": first.scores.protocol},
        failures=tuple(failures),
    )
    base = None if public else out
    return _write(comparison, out, base, public)


def _write(comparison: Comparison, out: Path, base: Path | None, public: bool) -> Path:
    """Write all outputs of a comparison into ``out``; tables name runs by their path from ``base``, if there is one."""
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


def _with_unique_names(runs: Sequence[Run]) -> list[Run]:
    """Name runs such that those of one name are repetitions of one experiment with other seeds.

    Where a method has several experiments (recipe, budget or training data differ, or a seed is there twice), its name gets the
    preset, the budget or else the folder.
    """
    experiments: dict[tuple[str, ...], list[list[Run]]] = {}
    for run in runs:
        alike = experiments.setdefault(_settings(run), [])
        room = next((group for group in alike if all(run.seed != other.seed for other in group)), None)
        if room is None:
            alike.append([run])
        else:
            room.append(run)
    of_method: dict[str, list[list[Run]]] = {}
    for groups in experiments.values():
        of_method.setdefault(groups[0][0].method, []).extend(groups)
    names = {id(run): name for groups in of_method.values() for group, name in _named(groups) for run in group}
    return [replace(run, method=names[id(run)]) for run in runs]


def _settings(run: Run) -> tuple[str, ...]:
    """Everything that runs of one name must share."""
    data = json.dumps(run.provenance.data, sort_keys=True)
    made = run.provenance
    return run.method, made.recipe_sha256, run.scores.preset, made.budget, data, made.device


def _named(groups: Sequence[list[Run]]) -> Iterator[tuple[list[Run], str]]:
    """Each experiment of one method with a name of its own."""
    method = groups[0][0].method
    folders = [_folder_of(group) for group in groups]
    if len(set(folders)) < len(folders):
        folders = [group[0].folder.resolve() for group in groups]
    details = (
        [group[0].scores.preset for group in groups],
        [group[0].provenance.budget for group in groups],
        [_shortest_suffix(folder, folders) for folder in folders],
    )
    distinct = next(words for words in details if len(set(words)) == len(groups))
    for group, words in zip(groups, distinct, strict=True):
        yield group, method if len(groups) == 1 else f"{method} ({words})"


def _folder_of(group: Sequence[Run]) -> Path:
    return Path(os.path.commonpath([run.folder.resolve() for run in group]))


def _shortest_suffix(folder: Path, folders: Sequence[Path]) -> str:
    """Shortest end of a path that is unique among ``folders``."""
    parts = [other.parts for other in folders]
    own = folder.parts
    length = next((n for n in range(1, len(own) + 1) if sum(path[-n:] == own[-n:] for path in parts) == 1), len(own))
    return "/".join(own[-length:]).lstrip("/")
