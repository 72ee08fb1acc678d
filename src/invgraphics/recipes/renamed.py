"""Renamed recipe keys, with which recipes and runs of earlier versions still load."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

RENAMED_KEYS: dict[str, dict[str, str]] = {
    "hooks.density_control": {
        "share_opacity": "revised_opacity",
        "pace": "cap_ramp",
        "start_steps": "latest_start_step",
    },
    "hooks.relocation": {"pace": "cap_ramp"},
    "renderer.splatting": {"compensate": "antialiased", "receivers": "max_grad_splats"},
    "renderer.sampler.occupancy": {"wave": "chunk"},
}
"""Part of a recipe -> its keys' first names -> today's.

A part is its dotted path, followed by its ``type`` where it has one: ``hooks.density_control``, ``renderer.splatting``."""


def with_current_names(table: Mapping[str, Any]) -> dict[str, Any]:
    """Rename a recipe table's old keys to their current names."""
    return _renamed(table, RENAMED_KEYS)


def with_first_names(table: Mapping[str, Any]) -> dict[str, Any]:
    """Rename a recipe table's keys to their original names, for hashes that are invariant under renaming."""
    return _renamed(table, {part: {new: old for old, new in keys.items()} for part, keys in RENAMED_KEYS.items()})


def _renamed(table: Mapping[str, Any], names: Mapping[str, Mapping[str, str]], path: str = "") -> dict[str, Any]:
    kind = table.get("type")
    keys = names.get(f"{path}.{kind}" if isinstance(kind, str) else path, {})
    # A table with both keys keeps both, and is refused for the one that is unknown.
    return {
        keys[key] if key in keys and keys[key] not in table else key: _value(value, names, f"{path}.{key}" if path else key)
        for key, value in table.items()
    }


def _value(value: Any, names: Mapping[str, Mapping[str, str]], path: str) -> Any:
    if isinstance(value, Mapping):
        return _renamed(value, names, path)
    return [_value(item, names, path) for item in value] if isinstance(value, list | tuple) else value
