"""``invgraphics list``: list methods, scenes and components with their origins. Imports no implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from invgraphics import plugins
from invgraphics.cli.output import show_table
from invgraphics.data import find
from invgraphics.errors import InputError, did_you_mean
from invgraphics.tables import read_toml

COMPONENTS = {
    "fields": "fields",
    "encodings": "encodings",
    "renderers": "renderers",
    "samplers": "samplers",
    "losses": "losses",
    "penalties": "penalties",
    "hooks": "hooks",
    "metrics": "metrics",
    "formats": "scenes",
    "model-formats": "formats",
    "exporters": "exporters",
    "executors": "executors",
}
"""Title -> registry; the registry of scenes holds the formats of data sets that can be opened."""

TITLES = {"formats": "Formats of data sets", "model-formats": "Formats of Gaussians (invgraphics import FILE)"}

KINDS = ("matrix", "methods", "scenes", "studies", *COMPONENTS, "protocols")
EVERYTHING = KINDS[1:]


@dataclass(frozen=True)
class List:
    """List methods, scenes and the components that recipes are made of, and where each comes from."""

    kinds: Annotated[Positional[tuple[str, ...]], arg(metavar="[KIND ...]", help_behavior_hint="(default: everything)")] = ()
    """What to list: methods, scenes, studies, fields, encodings, renderers, samplers, losses, hooks, metrics, formats,
    model-formats, exporters, executors, protocols; or matrix, the table of fields and renderers as Markdown."""

    def run(self) -> int:
        """Print the tables; returns exit status 0."""
        for kind in self.kinds:
            if kind not in KINDS:
                raise InputError(f"There is no list of '{kind}'.{did_you_mean(kind, KINDS)}", f"Lists: {', '.join(KINDS)}.")
        for kind in self.kinds or EVERYTHING:
            if kind == "matrix":
                _print_matrix()
            elif kind == "methods":
                _list_methods()
            elif kind == "scenes":
                _list_scenes()
            elif kind == "studies":
                _list_studies()
            elif kind == "protocols":
                _list_protocols()
            else:
                _list_components(kind)
            if kind == "metrics":
                _list_surface_metrics()
        return 0


def _print_matrix() -> None:
    from invgraphics.recipes.table import markdown

    print(markdown())


def _list_methods() -> None:
    from invgraphics.recipes.presets import preset_summary
    from invgraphics.recipes.recipe import is_built_in, methods, source

    rows = [
        (
            name,
            summary,
            preset_summary(source(name).get("presets", {})),
            "built in" if is_built_in(name) else plugins.origin("recipes", name),
        )
        for name, summary in methods().items()
    ]
    columns = ("name", "summary", "presets (chosen on)", "from")
    show_table("Methods (field x renderer recipes)", columns, rows)


def _list_scenes() -> None:
    rows = []
    for path in sorted(find("scenes").glob("*/scene.toml")):
        table = read_toml(path)
        rows.append((path.parent.name, str(table.get("summary", "")), str(table.get("stresses", ""))))
    show_table("Scenes (rendered by Mitsuba; a path to a data set serves as well)", ("name", "what it shows", "stresses"), rows)


def _list_studies() -> None:
    from invgraphics.studies.reading import FILE, read_study

    rows = []
    for path in sorted(find("studies").glob(f"*/{FILE}")):
        study = read_study(path)
        rows.append((path.parent.name, study.question, str(len(study.expand()))))
    show_table("Studies (invgraphics ablate NAME)", ("name", "question", "runs"), rows)


def _list_protocols() -> None:
    from invgraphics.metrics.conventions import PROTOCOLS

    rows = [(name, protocol.summary, protocol.source or "built in") for name, protocol in PROTOCOLS.items()]
    show_table("Protocols (for --protocol of rescore; fit and evaluate take ours)", ("name", "summary", "as read in"), rows)


def _list_surface_metrics() -> None:
    from invgraphics.metrics.surface_metrics import SURFACE_METRICS

    rows = [(metric.name, metric.unit, metric.summary) for metric in SURFACE_METRICS.values()]
    show_table("Geometry scores of distances and meshes", ("name", "unit", "definition"), rows)


def _list_components(kind: str) -> None:
    registry = COMPONENTS[kind]
    rows = [(name, plugins.origin(registry, name), target) for name, target in plugins.names(registry).items()]
    title = TITLES.get(kind, kind.capitalize())
    show_table(title, ("name", "from", "implementation"), rows)
