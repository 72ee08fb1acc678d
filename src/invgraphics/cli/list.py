"""``invgraphics list``: list methods, scenes and components with their origins, importing no implementation; or one method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from invgraphics import plugins
from invgraphics.cli.output import show_table
from invgraphics.data import find
from invgraphics.errors import InputError, did_you_mean
from invgraphics.tables import read_toml

if TYPE_CHECKING:
    from invgraphics.recipes.recipe import Method

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
    """List methods, scenes and the components that recipes are made of, and where each comes from.

    Of one method: its paper, its presets, and every setting with its value and what it means.

    Attributes:
        kinds: What to list: methods, scenes, studies, fields, encodings, renderers, samplers, losses, penalties, hooks,
            metrics, formats, model-formats, exporters, executors, protocols; matrix, the table of fields and renderers as
            Markdown; or a method (volumetric/hash, volumetric/hash:preset=long, or the path of a recipe): its keys for --set,
            under its laptop preset unless one is named.
    """

    kinds: Annotated[
        Positional[tuple[str, ...]], arg(metavar="[KIND|METHOD ...]", help_behavior_hint="(default: all kinds but matrix)")
    ] = ()

    def run(self) -> int:
        """Print the tables; returns exit status 0."""
        chosen = {kind: _method(kind) for kind in self.kinds if kind not in KINDS}
        for kind in self.kinds or EVERYTHING:
            if kind in chosen:
                _show_method(chosen[kind])
            elif kind == "matrix":
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


def _method(name: str) -> Method:
    """The method of a name that is no list's.

    Raises:
        InputError: there is none.
    """
    from invgraphics.recipes.aliases import suggested_method
    from invgraphics.recipes.recipe import load_method, methods, split_name

    recipe = split_name(name)[0]
    if "/" not in recipe and not recipe.endswith(".toml") and recipe not in methods():
        guess = did_you_mean(name, KINDS) or suggested_method(recipe, methods())
        raise InputError(f"There is no list of '{name}'.{guess}", f"Lists: {', '.join(KINDS)}; or a method.")
    return load_method(name)


def _show_method(method: Method) -> None:
    """Print a method's summary, paper and presets, and a table of its settings."""
    from invgraphics.recipes.presets import preset_summary
    from invgraphics.recipes.recipe import source
    from invgraphics.recipes.settings import settings_of

    presets = source(method.name).get("presets", {})
    print(f"{method.name}: {method.recipe.summary.rstrip('.') or 'no summary'}.")
    print(f"Paper: {method.recipe.paper or 'none named'}")
    print(f"Presets (chosen on): {preset_summary(presets) or 'none'}")
    rows = [(setting.key, setting.value, setting.meaning) for setting in settings_of(method.recipe)]
    under = f"under the preset {method.preset}" if method.preset else "without a preset"
    show_table(f"Settings {under} (--set KEY=VALUE)", ("key", "value", "meaning"), rows)
    print("A value of - is not set; values in parentheses are those of a part that is not there until one of its keys is set.")


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
