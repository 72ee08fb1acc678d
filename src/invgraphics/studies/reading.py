"""Locating and reading study files, and applying the command line's settings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from invgraphics.config import fill
from invgraphics.data import find
from invgraphics.errors import InputError, did_you_mean
from invgraphics.experiments.request import AblateRequest
from invgraphics.studies.checks import checked, completed
from invgraphics.studies.factors import path_of
from invgraphics.studies.study import Study
from invgraphics.tables import read_toml

FILE = "study.toml"


def locate(name: str) -> Path:
    """Find a study's file: the path of a TOML file or of its folder, else a built-in study's name.

    Raises:
        InputError: there is none; the built-in studies are listed.
    """
    for path in (Path(name), Path(name) / FILE):
        if path.suffix == ".toml" and path.is_file():
            return path
    if name.endswith(".toml"):
        raise InputError(
            f"The file '{name}' does not exist.", f"Expected: the name of a built-in study, or the path of a {FILE}."
        )
    known = [path.parent.name for path in sorted(find("studies").glob(f"*/{FILE}"))]
    if name in known:
        return find("studies", name) / FILE
    guess = did_you_mean(name, known)
    raise InputError(f"There is no study '{name}'.{guess}", f"Built-in studies: {', '.join(known)}; or the path of a {FILE}.")


def name_of(path: Path) -> str:
    """Name of a study: that of its folder, or of its file unless that has the default name."""
    return path.resolve().parent.name if path.name == FILE else path.stem


def read_study(path: Path) -> Study:
    """Read a study, and validate it as far as possible without its methods and scenes.

    Raises:
        InputError: not TOML; a key is unknown, missing or of the wrong type; a factor is empty or repeats a level; a design
            lacks what it needs. The sentence names the file.
    """
    table = read_toml(path)
    try:
        study = fill(Study, table)
    except InputError as error:
        raise InputError(f"{path}: {error.sentence}", error.remedy) from error
    return checked(completed(study, str(path)), str(path))


def with_request(study: Study, request: AblateRequest) -> Study:
    """Override a study's settings with those of the command line.

    Raises:
        InputError: it names a budget, a size or seeds, and the study itself varies them; or a seed twice.
    """
    varied = {path_of(name) for name in study.base} | {name for cell in study.cells for name in cell}
    names = ("seeds", "budget", "size", "test_views", "spp")
    given = {name: getattr(request, name) for name in names if getattr(request, name) is not None}
    if refused := [name for name in given if name in varied]:
        raise InputError(f"--{refused[0]} cannot be given: the study itself sets it in its factors, base or cells.")
    return checked(replace(study, **given), f"The study '{request.study}'")
