"""``invgraphics list``: list methods, scenes and components with their origins; or one method.

Without a kind nothing is imported but the recipes; of a kind that is named, implementations are, for what they mean.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from invgraphics import plugins
from invgraphics.cli.output import show_table
from invgraphics.data import find, has_scene
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
                _list_scenes(in_full=bool(self.kinds))
            elif kind == "studies":
                _list_studies()
            elif kind == "protocols":
                _list_protocols()
            else:
                _list_components(kind, in_full=bool(self.kinds))
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
        if has_scene(name):
            guess = " It is a scene: `invgraphics list scenes`."
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


def _list_scenes(in_full: bool) -> None:
    rows, columns = [], ("name", "what it shows", "stresses")
    for path in sorted(find("scenes").glob("*/scene.toml")):
        table = read_toml(path)
        rows.append((path.parent.name, str(table.get("summary", "")), str(table.get("stresses", "")), *_size(path, in_full)))
    columns += ("size", "views (train, test)", "samples per pixel") if in_full else ()
    show_table("Scenes (rendered by Mitsuba; a path to a data set serves as well)", columns, rows)


def _size(path: Path, in_full: bool) -> tuple[str, ...]:
    """A scene's default size, numbers of views and samples per training pixel, as texts; nothing unless ``in_full``."""
    if not in_full:
        return ()
    from invgraphics.scenes.mitsuba.spec import read

    spec = read(path)
    each = f" of {spec.instances.total} objects" if spec.instances else ""
    views = f"{spec.views.train}, {spec.views.test}{each}"
    return f"{spec.size[0]}x{spec.size[1]}", views, str(spec.samples.train)


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


def _list_components(kind: str, in_full: bool) -> None:
    registry = COMPONENTS[kind]
    rows = [
        (name, *([_meaning(registry, name)] if in_full else []), plugins.origin(registry, name), target)
        for name, target in plugins.names(registry).items()
    ]
    title = TITLES.get(kind, kind.capitalize())
    show_table(title, ("name", *(["meaning"] if in_full else []), "from", "implementation"), rows)


def _meaning(registry: str, name: str) -> str:
    """A component's summary, or the first paragraph of its docstring; empty where it cannot be imported, or says nothing."""
    try:
        part = plugins.load(registry, name)
    except InputError:
        return ""
    if summary := getattr(part, "summary", ""):
        return f"{summary} ({part.unit})" if getattr(part, "unit", "") else str(summary)
    return " ".join((inspect.getdoc(part) or "").partition("\n\n")[0].split())
