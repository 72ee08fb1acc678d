"""Run the notebooks and write each as one self-contained HTML page; ``make notebooks`` calls it.

The pages need no network and no kernel: equations become MathML, solutions fold away, and a slider is left out in favour of
the figure before it, which shows some of its positions.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import nbformat
from latex2mathml.converter import convert
from nbclient import NotebookClient
from nbconvert import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from nbformat import NotebookNode
from pygments.formatters import HtmlFormatter

HERE = Path(__file__).resolve().parent
TEMPLATE = HERE / "page.html.j2"


def execute(path: Path, parameters: str = "", folder: Path | None = None, timeout: int = 600) -> NotebookNode:
    """Run a notebook in a fresh kernel and return it with its outputs; the file is left as it is.

    Args:
        path: the notebook.
        parameters: code to run after the cell tagged ``parameters``, so that a test can shrink the work.
        folder: working directory of the kernel; ``None`` for the notebook's own.
        timeout: longest a single cell may take, in seconds.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed; its traceback is in the message.
    """
    notebook = nbformat.read(path, as_version=4)
    if parameters:
        places = [i for i, cell in enumerate(notebook.cells) if "parameters" in tags(cell)]
        notebook.cells.insert(places[0] + 1, nbformat.v4.new_code_cell(parameters))
    resources = {"metadata": {"path": str(folder or path.parent)}}
    client = NotebookClient(notebook, timeout=timeout, kernel_name="python3", resources=resources)
    client.widget_registry = {}  # it answers a widget's output while it waits for the cell, and so can miss the cell's end
    client.execute()
    return notebook


def tags(cell: NotebookNode) -> list[str]:
    """A cell's tags; ours are parameters, setup, widget and solution."""
    return cell.metadata.get("tags", [])


def printed(notebook: NotebookNode) -> str:
    """Everything an executed notebook printed."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")


def title(notebook: NotebookNode) -> str:
    """The first heading."""
    return notebook.cells[0].source.splitlines()[0].lstrip("# ")


class _Markdown(IPythonRenderer):
    """Markdown whose equations are MathML, which browsers draw themselves."""

    def block_math(self, body: str) -> str:
        return convert(body.strip(), display="block")

    multiline_math = block_math

    def inline_math(self, body: str) -> str:
        return convert(body.strip())


class _Exporter(HTMLExporter):
    """nbconvert with our template and equations."""

    def default_filters(self) -> Any:
        yield from super().default_filters()
        yield "markdown2html", lambda source: MarkdownWithMath(renderer=_Markdown(escape=False)).render(source)


def page(notebook: NotebookNode) -> str:
    """An executed notebook as HTML."""
    notebook.metadata["title"] = title(notebook)
    for cell in notebook.cells:
        if "widget" in tags(cell):
            cell.outputs = []
    style = HtmlFormatter(style="friendly").get_style_defs(".highlight")
    html, _ = _Exporter(template_file=str(TEMPLATE)).from_notebook_node(notebook, {"pygments_css": style})
    return html


def render(path: Path, out: Path) -> Path:
    """Execute a notebook and write ``out/<name>.html``."""
    target = out / f"{path.stem}.html"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(page(execute(path)), encoding="utf-8")
    return target


def main(arguments: list[str]) -> int:
    """Render the named notebooks, or all of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("notebooks", nargs="*", type=Path, default=sorted(HERE.glob("*.ipynb")))
    parser.add_argument("--out", type=Path, default=HERE.parent / "reports" / "notebooks")
    chosen = parser.parse_args(arguments)
    for path in chosen.notebooks:
        began = time.perf_counter()
        target = render(path, chosen.out)
        print(f"{target} ({time.perf_counter() - began:.0f} s, {target.stat().st_size / 1e6:.1f} MB)", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
