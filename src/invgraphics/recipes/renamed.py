"""Renamed and added recipe keys, with which recipes and runs of earlier versions still load under the digests they had."""

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


_ADDED_TO_NEURAL = {
    "density_scale": 1.0,
    "density_interpolation": "post",
    "appearance_basis": 0,
    "feature_octaves": 0,
    "geometry_head": "mlp",
    "head": "mlp",
    "hidden_activation": "relu",
    "colour_activation": "sigmoid",
    "colour_padding": 0.0,
}
_ADDED_TO_HASH = {"min_spacing": 0.0}

ADDED_KEYS: dict[str, dict[str, Any]] = {
    "field.neural": _ADDED_TO_NEURAL,
    "hooks.density_control": {"reset_spacing": 0, "split_threshold": 0.0},
    "hooks.relocation": {"gate": 0.005},
    "hooks.upsample": {"min_spacing": 0.0},
    "optimiser": {"muon": 0.0, "muon_weight_decay": 0.0},
    "field.gaussians": {"dropout": 0.0, "dropout_views": 0},
    "renderer.sampler.proposal.neural": _ADDED_TO_NEURAL,
    "renderer.sampler.proposals": {"anneal_until": 1.0},
    "field.encoding.hash": _ADDED_TO_HASH,
    "field.appearance.hash": _ADDED_TO_HASH,
    "renderer.sampler.fields.encoding.hash": _ADDED_TO_HASH,
    "renderer.sampler.proposal.encoding.hash": _ADDED_TO_HASH,
    "renderer.volumetric": {"colour_threshold": 0.0},
    "renderer.volsdf": {"min_deviation": 0.0},
    "renderer.neus": {"min_deviation": 0.0},
    "batches": {"foreground_until": 1.0, "foreground_least": 0.0, "start_size": 0, "start_until": 0.5},
}
"""Part of a recipe -> keys that later versions added, with the values that change nothing."""


def with_current_names(table: Mapping[str, Any]) -> dict[str, Any]:
    """Rename a recipe table's old keys to their current names."""
    return _renamed(table, RENAMED_KEYS)


def with_first_names(table: Mapping[str, Any]) -> dict[str, Any]:
    """Rename a recipe table's keys to their original names and drop added ones that change nothing, for lasting hashes."""
    first = {part: {new: old for old, new in keys.items()} for part, keys in RENAMED_KEYS.items()}
    return _renamed(table, first, ADDED_KEYS)


def _renamed(
    table: Mapping[str, Any],
    names: Mapping[str, Mapping[str, str]],
    dropped: Mapping[str, Mapping[str, Any]] | None = None,
    path: str = "",
) -> dict[str, Any]:
    dropped = dropped or {}
    kind = table.get("type")
    part = f"{path}.{kind}" if isinstance(kind, str) else path
    keys, without = names.get(part, {}), dropped.get(part, {})
    # A table with both keys keeps both, and is refused for the one that is unknown.
    return {
        keys[key] if key in keys and keys[key] not in table else key: _value(value, names, dropped, _join(path, key))
        for key, value in table.items()
        if not (key in without and value == without[key])
    }


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _value(value: Any, names: Mapping[str, Mapping[str, str]], dropped: Mapping[str, Mapping[str, Any]], path: str) -> Any:
    if isinstance(value, Mapping):
        return _renamed(value, names, dropped, path)
    return [_value(item, names, dropped, path) for item in value] if isinstance(value, list | tuple) else value
