"""``invgraphics rescore``: score saved pictures under the conventions of other tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from invgraphics.cli.output import show_table
from invgraphics.cli.report import runs_in
from invgraphics.errors import InputError
from invgraphics.runs.comparison import ComparisonRecord
from invgraphics.runs.folder import RUNS, RunFolder
from invgraphics.runs.study import StudyRecord

COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


@dataclass(frozen=True)
class Rescore:
    """Score saved pictures again under named protocols: those of a run, or of any tool. `list protocols` explains them.

    Attributes:
        folders: Runs, comparisons, or folders of predicted pictures (3DGS's renders/ + gt/ and nerfbaselines' color/ +
            gt-color/ contain their truth). Several must share their truth.
        protocol: Protocols, with commas between them.
        truth: True pictures, matched by equal names, else in order.
        background: The data set's background, and what pictures without alpha show where the scene is transparent; runs know
            theirs.
        allow_8bit: Accept 8-bit pictures where a protocol needs unrounded predictions.
        out: Where to write scores, and the table as Markdown and CSV.
    """

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN|FOLDER ...", help_behavior_hint="(one or more)")]
    protocol: Annotated[str, arg(metavar="NAME,NAME|all")] = "all"
    truth: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: the folder's own)")] = None
    background: Annotated[str | None, arg(metavar="white|black|R,G,B", help_behavior_hint="(default: not stated)")] = None
    allow_8bit: bool = False
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: into the run)")] = None

    def run(self) -> int:
        """Score; prints a table for each set of pictures. Returns exit status 0."""
        background = None if self.background is None else parse_colour(self.background)
        if not self.folders:
            raise InputError("There is nothing to score.", "Give a run, or a folder of predicted pictures.")

        from invgraphics.tools.predictions import open_pictures
        from invgraphics.tools.rescore import protocols_named, rescore
        from invgraphics.tools.rescoring import best_sets, rows_of, skip_reasons, write_scores, write_tables

        protocols = protocols_named(self.protocol)
        for folder in self.folders:
            if RunFolder(folder).has(StudyRecord):
                remedy = f"Give runs of one scene at one size: {folder / RUNS}/SCENE-*."
                raise InputError(f"'{folder}' is a study, whose runs do not share their truth.", remedy)
        compared = {folder: RunFolder(folder).has(ComparisonRecord) for folder in self.folders}
        folders = [one for folder in self.folders for one in (runs_in(folder) if compared[folder] else [folder])]
        results = rescore([open_pictures(folder, self.truth, background) for folder in folders], protocols, self.allow_8bit)
        for one in results:
            width, height = one.pictures.size
            title = f"{one.label}: {len(one.pictures.names)} views of {width}x{height}, truth {one.pictures.sha256[:12]}"
            show_table(title, *rows_of(one))
            for line in skip_reasons(one):
                print(line)
            write_scores(one, None if self.out is None else self.out / one.label.replace("/", "-"))
        for sentence in (best_sets(results, "psnr"), best_sets(results, "ssim")):
            if sentence:
                print(sentence)
        if self.out is not None:
            for path in write_tables(results, self.out):
                print(path)
        return 0


def parse_colour(text: str) -> tuple[float, float, float]:
    """Parse ``white``, ``black``, or three numbers in [0, 1].

    Raises:
        InputError: anything else.
    """
    if text.strip() in COLOURS:
        return COLOURS[text.strip()]
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        red = green = blue = -1.0
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise InputError(
            f"--background cannot be '{text}'.", "Expected white, black, or three numbers from 0 to 1: 0.5,0.5,0.5."
        )
    return red, green, blue
