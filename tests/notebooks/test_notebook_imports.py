"""A reader meets few modules: every notebook imports five at most, and none defines what another one defines."""

import ast
import json
import re
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

import invgraphics

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))
MOST = 5
"""Modules that a notebook may import: torch, matplotlib.pyplot, invgraphics, invgraphics.notebook, and one more."""


def _code(path: Path) -> ast.Module:
    """All code of a notebook, without IPython's own commands."""
    cells = ["".join(cell["source"]) for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    return ast.parse(re.sub(r"^[%!].*$", "", "\n".join(cells), flags=re.MULTILINE))


def _imported(code: ast.Module) -> set[str]:
    """Modules that import statements name; ``from invgraphics import core, kernels`` names two."""
    found = set()
    for node in ast.walk(code):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = node.module or ""
            found |= {f"{package}.{name.name}" for name in node.names} if package == "invgraphics" else {package}
    return found


def _reached(code: ast.Module) -> set[str]:
    """Modules of the library that are used by their full name after ``import invgraphics as ig``."""
    chains = {ast.unparse(node) for node in ast.walk(code) if isinstance(node, ast.Attribute)}
    names = {name.removeprefix("ig.") for name in chains if re.fullmatch(r"ig(\.[a-z_]+)+", name)}
    return {name for name in names if _is_module(name)}


def _is_module(name: str) -> bool:
    module = invgraphics
    for part in name.split("."):
        module = getattr(module, part, None)
    return isinstance(module, ModuleType)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_imports_from_few_modules(path: Path) -> None:
    code = _code(path)
    imported = _imported(code)
    print(
        f"{path.stem} imports {', '.join(sorted(imported))}; through ig: {', '.join(sorted(_reached(code))) or 'the face only'}"
    )
    assert len(imported) <= MOST


def test_nothing_is_defined_twice() -> None:
    """By name, and by what it does: a copy under another name counts."""
    names, bodies = Counter(), Counter()
    for path in NOTEBOOKS:
        made = [node for node in ast.walk(_code(path)) if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        outer = {node.name for node in _code(path).body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        names.update(outer)
        bodies.update({ast.dump(ast.Module(node.body[1:] or node.body, [])) for node in made})
    assert not [name for name, count in names.items() if count > 1]
    assert not [body for body, count in bodies.items() if count > 1]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_look_is_set_by_the_library(path: Path) -> None:
    source = ast.unparse(_code(path))
    assert source.count("notebook.style()") == 1
    assert "rcParams" not in source and "ipywidgets" not in source
