"""The project's idea as a table: field parameterisation x renderer, from the recipes themselves."""

from __future__ import annotations

from typing import Any

from invgraphics.recipes.recipe import methods, source

FIELD_WORDS = {"neural": "network", "gaussians": "anisotropic 3D Gaussians"}
ENCODING_WORDS = {"frequency": "frequency encoding", "hash": "multi-resolution hash grid"}
RENDERER_WORDS = {
    "volumetric": "volume rendering",
    "splatting": "splatting",
    "gaussian_exact": "exact line integrals",
    "gaussian_sorted": "line integrals in ray order",
}


def matrix() -> tuple[list[str], list[str], dict[tuple[str, str], list[str]]]:
    """Rows (fields), columns (renderers), and the methods in each cell, in the order of `methods`."""
    cells: dict[tuple[str, str], list[str]] = {}
    for name in methods():
        table = source(name)
        renderer = str(table["renderer"]["type"])
        cells.setdefault((_field_words(table["field"]), RENDERER_WORDS.get(renderer, renderer)), []).append(name)
    rows = list(dict.fromkeys(row for row, _ in cells))
    columns = list(dict.fromkeys(column for _, column in cells))
    return rows, columns, cells


def markdown() -> str:
    """The table as Markdown, for the README."""
    rows, columns, cells = matrix()
    lines = ["| field | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for row in rows:
        entries = [", ".join(f"`{name}`" for name in cells.get((row, column), [])) for column in columns]
        lines.append(f"| {row} | " + " | ".join(entries) + " |")
    return "\n".join(lines)


def _field_words(field: dict[str, Any]) -> str:
    kind = str(field["type"])
    words = FIELD_WORDS.get(kind, kind)
    encoding = str(field.get("encoding", {}).get("type", ""))
    return f"{ENCODING_WORDS.get(encoding, encoding)} + {words}" if encoding else words
