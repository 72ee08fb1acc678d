"""Records are read back as they were written, from older schemas too; what is broken or newer gets one sentence."""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest
from made_up_runs import provenance_table

from invgraphics.errors import InputError
from invgraphics.runs.analysis import Analysis, Curve
from invgraphics.runs.comparison import ComparisonRecord, Failure
from invgraphics.runs.environment import Environment
from invgraphics.runs.explanation import ExplanationRecord
from invgraphics.runs.fit import FitRecord
from invgraphics.runs.folder import RunFolder, check_run
from invgraphics.runs.history import Moment, append_history, cut_history, read_history
from invgraphics.runs.inference import Inference
from invgraphics.runs.location import Location
from invgraphics.runs.provenance import Provenance
from invgraphics.runs.renderings import Renderings
from invgraphics.runs.schema import Record
from invgraphics.runs.scores import Score, Scores
from invgraphics.runs.study import CellRecord, StudyRecord

RECORDS = (
    Scores, Provenance, Environment, FitRecord, ComparisonRecord, StudyRecord, Renderings, ExplanationRecord, Analysis,
    Location, Inference,
)  # fmt: skip


def example(hint: Any) -> Any:
    """A value of a type, every field filled with something that is not its default."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is typing.Literal:
        return args[-1]
    if origin is tuple:
        return (example(args[0]), example(args[0])) if args[1:] == (...,) else tuple(map(example, args))
    if origin is dict:
        return {"a b": example(args[1]), "c": example(args[1])}
    if origin is not None:  # a union
        return example(next(arg for arg in args if arg is not type(None)))
    if dataclasses.is_dataclass(hint):
        hints = get_type_hints(hint)
        return hint(**{field.name: example(hints[field.name]) for field in dataclasses.fields(hint)})
    return {int: 7, float: 2.5, str: "words “here”", bool: True, Any: ["x", 1, None, {"y": 0.5}]}[hint]


@pytest.mark.parametrize("kind", RECORDS)
def test_what_is_written_is_read_back(kind: type[Record], tmp_path: Path) -> None:
    record = example(kind)
    path = tmp_path / "file.json"
    record.write(path)
    assert kind.read(path) == record
    table = json.loads(path.read_text())
    assert next(iter(table)) == "schema" and table["schema"] == kind.SCHEMA
    assert not path.with_name("file.json.tmp").exists()


@pytest.mark.parametrize("kind", RECORDS)
def test_newer_files_are_refused_and_unknown_keys_ignored(kind: type[Record], tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    table = example(kind).to_table()
    path.write_text(json.dumps(table | {"added later": {"x": 1}}))
    assert kind.read(path) == example(kind)
    path.write_text(json.dumps(table | {"schema": kind.SCHEMA + 1}))
    with pytest.raises(
        InputError, match=rf"file\.json' has schema {kind.SCHEMA + 1}, .* reads schema {kind.SCHEMA} "
    ) as caught:
        kind.read(path)
    assert "Install the version that wrote it" in caught.value.remedy
    for wrong in (0, "1", True, 1.5):
        path.write_text(json.dumps(table | {"schema": wrong}))
        with pytest.raises(InputError, match=r"'schema' cannot be"):
            kind.read(path)


@pytest.mark.parametrize("kind", RECORDS)
def test_every_missing_key_and_wrong_type_is_named(kind: type[Record], tmp_path: Path) -> None:
    """Each key that has to be there taken away, and each key given a value that no field takes."""
    path, whole = tmp_path / "file.json", example(kind).to_table()
    for field in dataclasses.fields(kind):
        rest = {key: value for key, value in whole.items() if key != field.name}
        path.write_text(json.dumps(rest))
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            with pytest.raises(InputError, match=rf"file\.json' lacks the key '{field.name}'"):
                kind.read(path)
        else:
            kind.read(path)
        if get_type_hints(kind)[field.name] is not Any:
            path.write_text(json.dumps(whole | {field.name: [[[]]]}))
            with pytest.raises(InputError, match=rf"file\.json': '{field.name}[.\d]*' cannot be "):
                kind.read(path)


def test_the_key_in_the_depths_is_named(tmp_path: Path) -> None:
    table = example(StudyRecord).to_table()
    table["cells"][1]["seed"] = 1.5
    (tmp_path / "study.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match=r"study\.json': 'cells\.1\.seed' cannot be 1\.5\.\nExpected: a whole number\."):
        RunFolder(tmp_path).read(StudyRecord)
    table["cells"][1]["seed"] = 2.0  # JSON has one kind of number
    (tmp_path / "study.json").write_text(json.dumps(table))
    assert RunFolder(tmp_path).read(StudyRecord).cells[1].seed == 2


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "7", "\x00", '{"views": ' + "[" * 100000, '{"seed": ' + "9" * 9000 + "}"])
def test_what_is_no_table_is_refused_in_words(tmp_path: Path, text: str) -> None:
    (tmp_path / "scores.json").write_text(text)
    with pytest.raises(InputError, match=r"scores\.json"):
        RunFolder(tmp_path).read_scores()


def test_what_a_record_itself_refuses_is_named(tmp_path: Path) -> None:
    """A prediction without bounds, in the depths of a study's record."""
    table = example(StudyRecord).to_table()
    table["predictions"][1] |= {"low": None, "high": None}
    (tmp_path / "study.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match=r"study\.json', key 'predictions\.1': A prediction needs 'low', 'high' or both"):
        StudyRecord.read(tmp_path / "study.json")


def test_numbers_that_json_cannot_hold(tmp_path: Path) -> None:
    """NaN counts as missing, infinity (the PSNR of equal pictures) stays; neither is ever written."""
    table = {"method": "m", "views": [], "cost": {"dead": math.nan}, "quality": {}}
    table["quality"] = {"psnr": {"mean": math.inf, "higher_is_better": True, "per_view": [math.nan, math.inf]}}
    (tmp_path / "scores.json").write_text(json.dumps(table))
    scores = RunFolder(tmp_path).read_scores()
    assert scores.cost == {"dead": None} and scores.quality["psnr"].per_view == (None, math.inf)
    with pytest.raises(ValueError, match="not JSON compliant"):
        scores.write(tmp_path / "other.json")
    assert not list(tmp_path.glob("other*"))


def test_environments_of_schema_1_had_packages_among_their_keys(tmp_path: Path) -> None:
    old = {"cpu": "A machine", "threads": 2, "torch": "2.13", "numpy": "2.4", "scikit-image": "0.26", "gsplat": None}
    (tmp_path / "environment.json").write_text(json.dumps(old))
    found = RunFolder(tmp_path).read(Environment)
    assert found == Environment(
        cpu="A machine", threads=2, torch="2.13", packages={"numpy": "2.4", "scikit-image": "0.26", "gsplat": None}
    )
    assert list(found.facts()) == ["torch", "cpu", "threads", "numpy", "scikit-image", "gsplat"]
    # Within another record as well.
    table = {"schema": 1, "scene": "s", "methods": [], "runs": [], "environment": old}
    (tmp_path / "compare.json").write_text(json.dumps(table))
    assert RunFolder(tmp_path).read(ComparisonRecord).environment == found


def test_locations_of_schema_1_had_rounds_among_their_keys(tmp_path: Path) -> None:
    table = example(Location).to_table() | {"schema": 1}
    table["starts"] = [{"start": 3, "loss_at_start": 0.5, "loss_at_scale_0.25": 0.2, "loss_at_scale_1": 0.1}]
    (tmp_path / "x.json").write_text(json.dumps(table))
    assert Location.read(tmp_path / "x.json").starts[0].rounds == {"0.25": 0.2, "1": 0.1}
    (tmp_path / "x.json").write_text(json.dumps(table | {"starts": [1]}))
    with pytest.raises(InputError, match=r"'starts\.0' cannot be 1"):
        Location.read(tmp_path / "x.json")


@pytest.mark.parametrize(
    ("kind", "first", "today"),
    [
        (Scores, {"shortfall": "why"}, {"below_baseline": "why"}),
        (Provenance, {"notes": {"summary": "s", "suspicion": "why"}}, {"notes": {"summary": "s", "inconsistent_poses": "why"}}),
        (
            ComparisonRecord,
            {"scene_info": {"train": 3, "notes": {"suspicion": "why"}}},
            {"scene_info": {"train": 3, "notes": {"inconsistent_poses": "why"}}},
        ),
    ],
)
def test_keys_are_read_under_their_first_names(
    kind: type[Record], first: dict[str, Any], today: dict[str, Any], tmp_path: Path
) -> None:
    table = {key: value for key, value in example(kind).to_table().items() if key not in today}
    (tmp_path / "first.json").write_text(json.dumps(table | first))
    (tmp_path / "today.json").write_text(json.dumps(table | today))
    found = kind.read(tmp_path / "first.json")
    assert found == kind.read(tmp_path / "today.json")
    written = found.to_table()
    assert {key: written[key] for key in today} == today and not first.keys() - today.keys() & written.keys()


def test_a_history_is_read_to_the_line_that_was_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "history.jsonl"
    for step in (0, 10, 20):
        append_history(path, Moment(step=step, seconds=0.5 * step, psnr=20.0 + step))
    whole = path.read_text()
    assert json.loads(whole.splitlines()[1]) == {"step": 10, "seconds": 5.0, "psnr": 30.0}
    path.write_text(whole + '{"step": 30, "seco')
    assert [moment.step for moment in read_history(path)] == [0, 10, 20]
    cut_history(path, 10)
    assert path.read_text() == "".join(whole.splitlines(keepends=True)[:2])
    path.write_text('{"step": 0, "seconds": 1.0, "psnr": NaN, "loss": Infinity}\n')
    (moment,) = read_history(path)
    assert (moment.psnr, moment.loss, moment.not_finite) == (None, math.inf, ("psnr", "loss"))
    path.write_text('{"step"\n' + whole)
    with pytest.raises(InputError, match=r"history\.jsonl', line 1, is not valid JSON"):
        read_history(path)


def test_protocols_have_files_of_their_own(tmp_path: Path) -> None:
    score = Score(mean=30.0, unit="dB", higher_is_better=True)
    folder = RunFolder(tmp_path)
    for protocol, name in (("float", "scores.float.json"), ("default", "scores.json")):
        folder.write(Scores(method="m", protocol=protocol, views=(), cost={}, quality={"psnr": score}))
        assert (tmp_path / name).is_file() and folder.read_scores(protocol).protocol == protocol
        assert folder.finished == (protocol == "default")


def test_folders_that_are_no_runs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is not a run: it has no recipe\.toml"):
        check_run(tmp_path)
    (tmp_path / "recipe.toml").write_text("")
    with pytest.raises(InputError, match=r"is not a run: it has no provenance\.json"):
        check_run(tmp_path)
    (tmp_path / "provenance.json").write_text(json.dumps(provenance_table(cell_sha256="abc")))
    check_run(tmp_path)
    assert RunFolder(tmp_path).identity == "abc"


def test_what_says_nothing_is_left_out() -> None:
    cell = CellRecord(id="a", scene="s", method="m", seed=0, run="runs/a", status="missing")
    study = StudyRecord(name="n", scenes=("s",), methods=("m",), cells=(cell,))
    wanted = {"id": "a", "scene": "s", "method": "m", "seed": 0, "run": "runs/a", "status": "missing"}
    table = {"schema": 1, "name": "n", "design": "factorial", "scenes": ["s"], "methods": ["m"], "report": "effects"}
    table |= {"metric": "psnr"}
    assert study.to_table() == table | {"cells": [wanted]}
    failed = ComparisonRecord(scene="s", methods=(), runs=(), failures=(Failure(method="m", seed=1, error="no"),))
    assert failed.to_table()["failures"] == [{"method": "m", "seed": 1, "error": "no"}]
    assert Analysis("t", "s", "x", "y", (Curve("c", (0.0,), (1.0,)),)).to_table()["curves"] == [
        {"label": "c", "x": [0.0], "y": [1.0]}
    ]


def test_one_folder_is_created_by_several_at_a_time(tmp_path: Path) -> None:
    """As by the fits of a study that share it: the check that it can be written leaves nothing, and disturbs no other."""

    def create(_: int) -> None:
        RunFolder(tmp_path / "run").create()

    with ThreadPoolExecutor(4) as pool:
        assert len(list(pool.map(create, range(2000)))) == 2000
    assert not list((tmp_path / "run").iterdir())
