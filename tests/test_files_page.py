"""docs/files.md: its examples are read, and its tables are those of the dataclasses that the files fill."""

import dataclasses
import json
import re
import zipfile
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
import torch

from invgraphics.core import Camera, Planes
from invgraphics.formats.mpi import PlaneFile, write_mpi
from invgraphics.report.statistics.rules import RULES
from invgraphics.report.wording import MARGINS
from invgraphics.runs.study import Approximation, KnownDeviation, Prediction
from invgraphics.scenes import npz
from invgraphics.scenes.degrade import TrainingData
from invgraphics.scenes.mitsuba.build import BUILDERS
from invgraphics.scenes.mitsuba.rig import RIGS, Forward, Hemisphere, InsideOut, Sphere, cameras, make_rig
from invgraphics.scenes.mitsuba.spec import Counts, Instances, SamplesPerPixel, SceneSpec, read
from invgraphics.studies.analyses import ANALYSES
from invgraphics.studies.reading import read_study
from invgraphics.studies.study import Study
from invgraphics.tables import inline_toml
from invgraphics.tools.camera_path import CameraPath, Keyframe

PAGE = (Path(__file__).parents[1] / "docs" / "files.md").read_text()
SECTIONS = {
    "## `scene.toml`": SceneSpec,
    "### `views`": Counts,
    "### `samples`": SamplesPerPixel,
    "### `instances`": Instances,
    "#### `sphere` and `hemisphere`": Sphere,
    "#### `forward`": Forward,
    "#### `inside_out`": InsideOut,
    "## `study.toml`": Study,
    "### `data`": TrainingData,
    "### `approximations`": Approximation,
    "### `known`": KnownDeviation,
    "### `predictions`": Prediction,
}


def _rows(heading: str) -> dict[str, list[str]]:
    section = re.split(r"^#+ ", PAGE.split(f"\n{heading}\n")[1], flags=re.M)[0]
    rows = re.findall(r"^\| `(\w+)` \| (.*) \| (.*) \| (.*) \|$", section, flags=re.M)
    return {key: list(cells) for key, *cells in rows}


def _example(heading: str) -> str:
    return re.findall(r"^```toml\n(.*?)^```", PAGE.split(f"\n{heading}\n")[1], flags=re.S | re.M)[0]


def _default(field: dataclasses.Field) -> str:
    """A default as the page writes it; tables of a part say nothing but that it may be absent."""
    if field.default_factory is not dataclasses.MISSING:
        value: Any = field.default_factory()
    elif field.default is dataclasses.MISSING:
        return "needed"
    else:
        value = field.default
    if value is None:
        return "—"
    return "`{}`" if dataclasses.is_dataclass(value) else f"`{inline_toml(value)}`"


@pytest.mark.parametrize("heading", SECTIONS)
def test_keys_and_defaults_are_those_of_the_code(heading: str) -> None:
    fields = dataclasses.fields(SECTIONS[heading])
    assert {key: cells[1] for key, cells in _rows(heading).items()} == {field.name: _default(field) for field in fields}


def test_sections_are_complete_and_name_what_there_is() -> None:
    assert set(re.findall(r"^#+ `.*", PAGE, flags=re.M)) - {"### `rig`"} == set(SECTIONS)
    for name in (*RIGS, *BUILDERS, *ANALYSES, *RULES):
        assert f"`{name}`" in PAGE, name
    for choice in (name for key in ("report", "design") for name in get_args(get_type_hints(Study)[key])):
        assert f"`{choice}`" in PAGE, choice
    assert f"`elevation` being `{inline_toml(Hemisphere.elevation)}`" in PAGE
    assert f"others have {', '.join(f'{name} {margin:g}' for name, margin in MARGINS.items())} |" in PAGE


def test_the_example_of_a_scene_is_read(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(_example("## `scene.toml`"))
    spec = read(path)
    assert spec.builder in BUILDERS and spec.views == Counts(24, 2, 8) and spec.samples.test == 256
    (camera, *_) = cameras(make_rig(spec.rig), "train", spec.views.train, spec.size, seed=0)
    assert (camera.width, camera.height) == (160, 120)


def test_the_example_of_a_study_is_read_and_expands(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    path.write_text(_example("## `study.toml`"))
    study = read_study(path)
    # The base, fewer photographs, and a larger table that only one of the two methods has; two scenes, three seeds.
    assert len(study.expand()) == 2 * 3 * (2 + 2 + 1)
    assert study.margins == {"psnr": 0.3} and study.predictions[0].low == 1.0


def _keys(heading: str) -> list[str]:
    """Every name in code in the first cells of a section's tables."""
    section = re.split(r"^#+ ", PAGE.split(f"\n{heading}\n")[1], flags=re.M)[0]
    cells = re.findall(r"^\| ([^|]*) \|", section, flags=re.M)
    return [key for cell in cells for key in re.findall(r"`(\w+)`", cell)]


def test_keys_of_a_scene_as_npz() -> None:
    found = re.findall(r"^(\w+) {2,}\(", npz.__doc__ or "", flags=re.M)
    assert len(found) > 10
    assert _keys("## Scenes as `.npz`") == found
    needed = {key for key, (_, need, _) in _rows("## Scenes as `.npz`").items() if need == "yes"}
    assert needed == set(npz._REQUIRED)


def test_keys_of_a_camera_path() -> None:
    path = CameraPath((Keyframe(torch.eye(4), 1.0),))
    table = json.loads(path.to_json())
    assert _keys("## Camera paths") == list(table)
    section = PAGE.split("## Camera paths")[1].split("\n## ")[0]
    assert all(f"`{key}`" in section for key in table["keyframes"][0])


def test_keys_of_a_multi_plane_image(tmp_path: Path) -> None:
    camera = Camera(torch.eye(4), torch.tensor([8.0, 8.0]), torch.tensor([4.0, 4.0]), 8, 8)
    planes = Planes(camera, torch.tensor([1.0, 2.0]), torch.zeros(2, 3, 8, 8), torch.zeros(2, 8, 8))
    write_mpi(tmp_path / "a.zip", PlaneFile(planes))
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        table = json.loads(archive.read("mpi.json"))
    section = PAGE.split("## Multi-plane images")[1].split("\n## ")[0]
    assert sorted(set(_keys("## Multi-plane images")) - {"json"}) == sorted(table)
    assert all(f"`{key}`" in section for key in (*table["camera"], *table["layers"][0]))
