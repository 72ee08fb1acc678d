"""Runs of a comparison or of a study, found from its record."""

from __future__ import annotations

from pathlib import Path

from invgraphics.errors import InputError
from invgraphics.runs.comparison import ComparisonRecord
from invgraphics.runs.folder import check_run
from invgraphics.runs.inside import inside
from invgraphics.runs.study import StudyRecord


def runs_of(folder: Path) -> list[Path]:
    """Folders of the finished runs of a comparison or study, in its order; of a run, that folder alone.

    Raises:
        InputError: the folder holds no finished run, or its record is broken.
    """
    if inside(folder, StudyRecord.FILE).is_file():
        cells = StudyRecord.read(folder / StudyRecord.FILE).cells
        names = [cell.run for cell in cells if cell.status == "done"]
    elif inside(folder, ComparisonRecord.FILE).is_file():
        names = list(ComparisonRecord.read(folder / ComparisonRecord.FILE).runs)
    else:
        check_run(folder)
        return [folder]
    found = [inside(folder, name) for name in dict.fromkeys(names)]
    if not found:
        raise InputError(f"{folder} has no finished run.", "Give its command again, which continues it.")
    for path in found:
        check_run(path)
    return found
