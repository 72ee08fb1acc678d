"""Size budgets that keep the code readable: lines per file and function, parameters, public names, files per folder."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "src" / "invgraphics"
FILES = sorted(ROOT.rglob("*.py"))
PACKAGES = [path for path in FILES if path.name == "__init__.py"]
FILE_LINES, FUNCTION_LINES, PARAMETERS, PUBLIC_NAMES, FOLDER_FILES = 300, 60, 8, 40, 25


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def _functions(path: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def test_files_stay_short() -> None:
    lengths = {_name(path): len(path.read_text().splitlines()) for path in FILES}
    assert len(lengths) > 500
    assert not {name: length for name, length in lengths.items() if length > FILE_LINES}


def test_functions_stay_short_and_narrow() -> None:
    long, wide = {}, {}
    for path in FILES:
        # Compiled kernels take flat arrays, so their parameters are not counted; their length is.
        kernels = {"numba", "cuda"} & {*path.relative_to(ROOT).parts}
        for function in _functions(path):
            name = f"{_name(path)}:{function.name}"
            lines = (function.end_lineno or function.lineno) - function.lineno + 1
            given = (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)
            arguments = [arg for arg in given if arg.arg not in ("self", "cls")]
            long |= {name: lines} if lines > FUNCTION_LINES else {}
            wide |= {name: len(arguments)} if len(arguments) > PARAMETERS and not kernels else {}
    assert (long, wide) == ({}, {})


@pytest.mark.parametrize("path", PACKAGES, ids=_name)
def test_packages_stay_small_and_export_few_names(path: Path) -> None:
    assert len(list(path.parent.glob("*.py"))) <= FOLDER_FILES
    body = ast.parse(path.read_text()).body
    defined = [node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    imported = [alias.asname or alias.name for node in body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert len({name for name in defined + imported if not name.startswith("_")}) <= PUBLIC_NAMES


def test_test_files_have_names_of_their_own() -> None:
    """Pytest imports them by name, and refuses the second of one name."""
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))
