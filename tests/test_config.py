"""Settings: what is filled, what is refused, and the round trip through plain tables."""

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest

from invgraphics import plugins
from invgraphics.config import Slot, fill, merge, set_path, to_table
from invgraphics.errors import InputError


@dataclass(frozen=True)
class Inner:
    rate: float = 0.5
    kind: Literal["a", "b"] = "a"


@dataclass(frozen=True)
class Outer:
    count: int
    names: tuple[str, ...] = ()
    inner: Inner = field(default_factory=Inner)
    groups: dict[str, Inner] = field(default_factory=dict)
    maybe: int | None = None
    encoding: Annotated[Any, Slot("encodings")] | None = None


def test_fill_and_back() -> None:
    table = {
        "count": 3,
        "names": ["x"],
        "inner": {"rate": 2},
        "groups": {"g": {"kind": "b"}},
        "encoding": {"type": "frequency", "octaves": 4},
    }
    config = fill(Outer, table)
    assert config.inner == Inner(2.0, "a")
    assert isinstance(config.inner.rate, float)
    assert config.groups == {"g": Inner(0.5, "b")}
    assert config.encoding.octaves == 4
    complete = to_table(config)
    assert complete["inner"] == {"rate": 2.0, "kind": "a"}
    assert complete["encoding"]["type"] == "frequency"
    assert fill(Outer, complete) == config


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({}, "The key 'count' is missing"),
        ({"count": 1, "cuont": 2}, "Unknown key 'cuont'"),
        ({"count": "three"}, "'count' cannot be 'three'"),
        ({"count": True}, "'count' cannot be True"),
        ({"count": 1.5}, "'count' cannot be 1.5"),
        ({"count": 1, "inner": {"rte": 1}}, "Unknown key 'inner.rte'"),
        ({"count": 1, "inner": {"kind": "c"}}, "'inner.kind' cannot be 'c'"),
        ({"count": 1, "names": ["a", 2]}, "'names.1' cannot be 2"),
        ({"count": 1, "encoding": {"octaves": 3}}, "'encoding' needs a 'type' key"),
        ({"count": 1, "encoding": {"type": "fourier"}}, "There is no 'fourier' among the encodings"),
        ({"count": 1, "encoding": {"type": "frequency", "octave": 3}}, "Unknown key 'encoding.octave'"),
    ],
)
def test_refusals_name_the_dotted_path(table: dict, sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        fill(Outer, table)
    assert sentence in caught.value.sentence
    assert caught.value.remedy


def test_set_path_reaches_tables_and_lists() -> None:
    table = {"a": {"b": 1}, "hooks": [{"every": 1}]}
    set_path(table, "a.c.d", 2)
    set_path(table, "hooks.0.every", 5)
    assert table == {"a": {"b": 1, "c": {"d": 2}}, "hooks": [{"every": 5}]}
    for path in ("hooks.3.every", "a.b.x", "hooks.first"):
        with pytest.raises(InputError, match="Unknown key"):
            set_path(table, path, 0)


def test_merge_replaces_a_part_whose_type_changes() -> None:
    base = {"sampler": {"type": "occupancy", "resolution": 64}, "keep": {"x": 1, "y": 2}}
    over = {"sampler": {"type": "stratified"}, "keep": {"y": 3}}
    assert merge(base, over) == {"sampler": {"type": "stratified"}, "keep": {"x": 1, "y": 3}}
    assert merge(base, {"sampler": {"resolution": 32}})["sampler"] == {"type": "occupancy", "resolution": 32}


def test_every_registered_object_exists_and_knows_its_name() -> None:
    for registry in plugins.REGISTRIES:
        for name in plugins.names(registry):
            found = plugins.load(registry, name)
            if isinstance(found, type):
                assert plugins.name_of(registry, found) == name


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(InputError) as caught:
        plugins.load("fields", "voxels-of-gold")
    assert "neural" in caught.value.remedy
