"""Studies: factors and levels from a TOML file, each cell fitted in its own process, effects with confidence intervals."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Unpack

from invgraphics.api.keeping import ReuseOptions
from invgraphics.api.loading import whole_seeds
from invgraphics.errors import InputError
from invgraphics.experiments.request import AblateRequest
from invgraphics.report.data.studies import Study, read_study
from invgraphics.report.study import build_study_report, study_sentences
from invgraphics.studies import ablate as ablating
from invgraphics.studies import reading as studies
from invgraphics.studies.forecast import Forecast
from invgraphics.studies.study import Study as Design


@dataclass(frozen=True)
class Figure:
    """Figure of a report as SVG, which a notebook displays.

    Attributes:
        path: of the SVG file.
    """

    path: Path

    def _repr_svg_(self) -> str:
        return self.path.read_text(encoding="utf-8")


class StudyResult:
    """Results of a study so far; a notebook displays its sentences.

    Args:
        folder: that `ablate` wrote.

    Attributes:
        folder: of the report and its runs.
        page: the report, an HTML file.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.page = folder, build_study_report(folder)

    def figure(self, name: str) -> Figure:
        """Select one of the report's figures by name, for instance ``effects-psnr``.

        Raises:
            InputError: the report has no such drawing; it names those that there are.
        """
        path = self.folder / "figures" / f"{name}.svg"
        if not path.is_file():
            known = ", ".join(sorted(file.stem for file in path.parent.glob("*.svg")))
            raise InputError(f"The report in {self.folder} has no figure '{name}'.", f"It has: {known or 'none'}.")
        return Figure(path)

    @cached_property
    def record(self) -> Study:
        """The study's data, from which the report is written: design, cells and scores."""
        return read_study(self.folder)

    def sentences(self) -> list[str]:
        """Effects of the factors in sentences, with confidence intervals."""
        return study_sentences(self.folder)

    def _repr_markdown_(self) -> str:
        return "\n".join(f"- {sentence}" for sentence in self.sentences())


def load_study(study: str | os.PathLike[str]) -> Design:
    r"""Read a study and check it, without running anything.

    Args:
        study: a built-in study's name, or the path of a ``study.toml``.

    Raises:
        InputError: there is none, or it is not a study; the sentence names the key.

    Example:
        >>> import invgraphics as ig
        >>> from pathlib import Path
        >>> head = 'question = "?"\nscenes = ["toy.npz"]\nmethods = ["splatting/gaussians"]\nseeds = [0, 1]\n'
        >>> _ = Path("views.toml").write_text(head + "[factors]\ndata.train_views = [4, 8]\n")
        >>> study = ig.load_study("views.toml")
        >>> len(study.points()), [(cell.seed, cell.levels) for cell in study.expand()][:2]
        (2, [(0, {'data.train_views': 4}), (0, {'data.train_views': 8})])
    """
    return studies.read_study(studies.locate(os.fspath(study)))


def _announce(forecast: Forecast) -> None:
    print(forecast, file=sys.stderr)


def ablate(
    study: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str] | None = None,
    seeds: Sequence[int] | None = None,
    budget: str | None = None,
    size: int | tuple[int, int] | None = None,
    device: Literal["cpu", "cuda"] | None = None,
    jobs: int = 1,
    confirm: Callable[[Forecast], None] = _announce,
    **more: Unpack[ReuseOptions],
) -> StudyResult:
    r"""Run every cell of a study that is missing, and write its report.

    Args:
        study: a built-in study's name, or the path of a ``study.toml``.
        out: folder of the report and its runs; ``None`` for ``reports/STUDY``.
        seeds: instead of the study's own.
        budget: of each fit, instead of the study's own.
        size: of the pictures, instead of the study's own.
        device: ``cpu`` or ``cuda``; ``None`` for the CPU.
        jobs: cells that share this machine at the same time; each gets an equal part of its cores.
        confirm: is shown the forecast before the first fit, and may raise to call it off.
        **more: ``keep=True``: finished cells stay although code or packages have changed since.

    Raises:
        InputError: something cannot be used; found before the first fit.
        KeyboardInterrupt: interrupted; the same call goes on.

    Example:
        >>> import invgraphics as ig
        >>> from pathlib import Path
        >>> head = 'question = "?"\nscenes = ["toy.npz"]\nmethods = ["splatting/gaussians"]\nbudget = "3steps"\n'
        >>> _ = Path("views.toml").write_text(head + "[factors]\ndata.train_views = [4, 8]\n")
        >>> result = ig.ablate("views.toml", out="views")
        >>> [(run.levels["data.train_views"], run.run.scores.quality["psnr"].unit) for run in result.record.observations()]
        [('4', 'dB'), ('8', 'dB')]
    """
    name = os.fspath(study)
    folder = Path("reports") / studies.name_of(studies.locate(name)) if out is None else Path(out)
    given: dict[str, Any] = {"budget": budget, "size": size, "device": device, "jobs": jobs, **more}
    given |= {} if seeds is None else {"seeds": whole_seeds(seeds)}
    root, _ = ablating.ablate(AblateRequest(study=name, out=str(folder), **given), confirm)
    return StudyResult(root)
