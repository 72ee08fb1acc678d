"""Size budgets that keep the code readable: lines per file and function, parameters, public names, files per folder."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "src" / "invgraphics"
FILES = sorted(ROOT.rglob("*.py"))
FILE_LINES, FUNCTION_LINES, PARAMETERS, PUBLIC_NAMES, FOLDER_FILES = 300, 60, 8, 40, 25


def _id(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def _functions(path: Path) -> list[ast.FunctionDef]:
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)]


@pytest.mark.parametrize("path", FILES, ids=_id)
def test_file_stays_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= FILE_LINES


@pytest.mark.parametrize("path", FILES, ids=_id)
def test_functions_stay_short_and_narrow(path: Path) -> None:
    # Compiled kernels take flat arrays, so their parameters are not counted; their length is.
    kernels = {"numba", "cuda"} & {*path.relative_to(ROOT).parts}
    for function in _functions(path):
        lines = (function.end_lineno or function.lineno) - function.lineno + 1
        arguments = [arg for arg in (*function.args.args, *function.args.kwonlyargs) if arg.arg not in ("self", "cls")]
        assert lines <= FUNCTION_LINES, f"{function.name} has {lines} lines"
        assert kernels or len(arguments) <= PARAMETERS, f"{function.name} has {len(arguments)} parameters"


@pytest.mark.parametrize("path", [path for path in FILES if path.name == "__init__.py"], ids=_id)
def test_packages_export_few_names(path: Path) -> None:
    body = ast.parse(path.read_text()).body
    defined = [node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    imported = [alias.asname or alias.name for node in body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert len({name for name in defined + imported if not name.startswith("_")}) <= PUBLIC_NAMES


@pytest.mark.parametrize("path", [path for path in FILES if path.name == "__init__.py"], ids=_id)
def test_folders_stay_small(path: Path) -> None:
    assert len(list(path.parent.glob("*.py"))) <= FOLDER_FILES


def test_test_files_have_names_of_their_own() -> None:
    """Pytest imports them by name, and refuses the second of one name."""
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))
