"""Matrix of methods, field parameterisation x renderer, generated from the recipes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from invgraphics import plugins
from invgraphics.recipes.recipe import is_built_in, methods, source


def matrix() -> tuple[list[str], list[str], dict[tuple[str, str], list[str]]]:
    """Build the matrix of methods: fields as rows, renderers as columns, methods in each cell in the order of `methods`.

    A third-party recipe that names no usable field or renderer is left out, with a warning.
    """
    cells: dict[tuple[str, str], list[str]] = {}
    for name in methods():
        try:
            cell = cell_of(source(name))
        except Exception as error:
            if is_built_in(name):
                raise
            plugins.leave_out(f"'{name}' of {plugins.origin('recipes', name)}: {type(error).__name__}: {error}.")
        else:
            cells.setdefault(cell, []).append(name)
    rows = list(dict.fromkeys(row for row, _ in cells))
    columns = list(dict.fromkeys(column for _, column in cells))
    return rows, columns, cells


def cell_of(table: Mapping[str, Any]) -> tuple[str, str]:
    """Titles of a recipe's field and renderer, the row and the column of its cell in the matrix."""
    return _field_title(table["field"]), _title("renderers", table["renderer"])


def markdown() -> str:
    """Format the matrix as Markdown, for the README."""
    rows, columns, cells = matrix()
    lines = ["| field | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for row in rows:
        entries = [", ".join(f"`{name}`" for name in cells.get((row, column), [])) for column in columns]
        lines.append(f"| {row} | " + " | ".join(entries) + " |")
    return "\n".join(lines)


def _field_title(field: dict[str, Any]) -> str:
    title = _title("fields", field)
    if "encoding" not in field:
        return title
    encoding = _title("encodings", field["encoding"])
    without_network = field.get("geometry_head") == "none" and field.get("head") in ("sh", "none")
    return encoding if without_network else f"{encoding} + {title}"


def _title(registry: str, part: dict[str, Any]) -> str:
    """Display title of a component: declared by its config, else its type."""
    kind = str(part["type"])
    return str(getattr(plugins.load(registry, kind), "title", kind))
