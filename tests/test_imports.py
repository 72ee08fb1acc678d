"""No circle of imports, not even one that a late or a type-checking import hides."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = "invgraphics"
ROOT = Path(__file__).parents[1] / "src" / PACKAGE


def imports(root: Path, package: str) -> dict[str, set[str]]:
    """Module -> modules of the package that it imports, wherever in the file."""
    paths = {_module(path, root, package): path for path in root.rglob("*.py")}
    graph: dict[str, set[str]] = {}
    for module, path in paths.items():
        found: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                full = [f"{node.module}.{alias.name}" for alias in node.names]
                found |= {name if name in paths else node.module for name in full}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
        graph[module] = (found & paths.keys()) - {module}
    return graph


def _module(path: Path, root: Path, package: str) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join([package, *(parts[:-1] if parts[-1] == "__init__" else parts)])


def test_there_is_no_circle() -> None:
    graph = imports(ROOT, PACKAGE)
    assert len(graph) > 300
    list(TopologicalSorter(graph).static_order())  # names the circle where there is one


def test_a_circle_is_found(tmp_path: Path) -> None:
    (tmp_path / "__init__.py").write_text("")
    (tmp_path / "a.py").write_text("from p.b import x\n")
    (tmp_path / "b.py").write_text("def f():\n    from p import a\n")
    with pytest.raises(CycleError):
        list(TopologicalSorter(imports(tmp_path, "p")).static_order())
