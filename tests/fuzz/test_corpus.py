"""The smallest inputs that once hung, filled the memory, ended in a traceback or were read as something else."""

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path

import folders
import numpy as np
import pytest
import seeds

from invgraphics.config import InputError
from invgraphics.formats.base import read_gaussians
from invgraphics.recipes.recipe import load_method
from invgraphics.report.data.pictures import read_arrays
from invgraphics.runs.history import cut_history
from invgraphics.scenes.open import open_scene
from invgraphics.studies.reading import read_study
from invgraphics.tools.camera_path import read_camera_path
from invgraphics.tools.predictions import open_pictures


def table(change: Callable[[dict], object]) -> Callable[[Path], Path]:
    """A ``transforms.json`` after ``change``."""

    def make(root: Path) -> Path:
        path = root / seeds.nerfstudio(root)
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content).replace('"DIGITS"', "9" * 400))
        return root

    return make


def first(key: str, value: object) -> Callable[[Path], Path]:
    """A ``transforms.json`` whose first frame says something else."""
    return table(lambda content: content["frames"][0].update({key: value}))


def rows(change: Callable[[np.ndarray], object]) -> Callable[[Path], Path]:
    """A ``poses_bounds.npy`` after ``change``."""

    def make(root: Path) -> Path:
        path = root / seeds.llff(root)
        array = np.load(path)
        change(array)
        np.save(path, array)
        return root

    return make


def archive(seed: Callable[[Path], str], **values: object) -> Callable[[Path], Path]:
    """An NPZ file with other arrays."""

    def make(root: Path) -> Path:
        path = root / seed(root)
        with np.load(path) as file:
            arrays = dict(file)
        np.savez(path, **(arrays | values))  # type: ignore[arg-type]
        return path if seed is seeds.npz else root

    return make


def text(name: str, old: str, new: str) -> Callable[[Path], Path]:
    """A COLMAP model in text with a word replaced."""

    def make(root: Path) -> Path:
        seeds.colmap_text(root)
        path = root / "sparse" / "0" / name
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))
        return root

    return make


def far_pose(distance: float) -> list[list[float]]:
    """OpenGL pose of a camera very far away."""
    pose = np.eye(4)
    pose[0, 3] = distance
    return pose.tolist()


def numbered(root: Path) -> Path:
    """A folder whose name's digit is no number, as `str.isdigit` has it."""
    seeds.llff(root)
    (root / "images").rename(root / "images_²")
    return root


def long_names(root: Path) -> Path:
    """A COLMAP model whose names are longer than a file system takes."""
    seeds.colmap_text(root)
    path = root / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace(".png", "9" * 400))
    return root


def large_quaternion(root: Path) -> Path:
    """A COLMAP model whose first image has a rotation of that length."""
    seeds.colmap_text(root)
    path = root / "sparse" / "0" / "images.txt"
    words = path.read_text().split(" ")
    path.write_text(" ".join([words[0], "1e200", *words[2:]]))
    return root


def points_at(value: float) -> np.ndarray:
    """Points of which one is elsewhere."""
    points = np.zeros((4, 3))
    points[0] = value
    return points


poses = np.stack([eye.cam_to_world for eye in seeds.eyes()])
poses_far = poses.copy()
poses_far[0, 0, 3] = 1e30


def no_utf8(root: Path) -> Path:
    """A COLMAP model with a name that is no UTF-8."""
    seeds.colmap_binary(root)
    path = root / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"0.png", b"\x80.png"))
    return root


def long_chunk(root: Path) -> Path:
    """A PNG file whose pixels claim 4 GB, which Pillow once reserved."""
    seeds.images(root)
    path = root / "images" / "0.png"
    data = path.read_bytes()
    path.write_bytes(data[:33] + b"\xff\xff\xff\x7f" + data[37:])
    return root


BAD_SCENES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "k1 = 1e30": (table(lambda t: t.update(k1=1e30)), "smear its picture"),
    "k1 = -9": (table(lambda t: t.update(k1=-900.0)), "fold its picture"),
    "cx = 1e30": (table(lambda t: t.update(cx=1e30, k1=0)), "principal point 1e\\+30"),
    "fl_x = 1e-30": (table(lambda t: t.update(fl_x=1e-30, k1=0)), "focal length"),
    "fl_x = fl_y = 1e-30": (table(lambda t: t.update(fl_x=1e-30, fl_y=1e-30, k1=0)), "look backwards"),
    "fl_x = 1e30": (table(lambda t: t.update(fl_x=1e30, fl_y=1e30, k1=0)), "field of view is zero"),
    "pose at 1e30": (first("transform_matrix", far_pose(1e30)), "units of the data set's world|as far away"),
    "pose at 1e300": (first("transform_matrix", far_pose(1e300)), "farther apart"),
    "file_path = /": (first("file_path", "/"), "no 'file_path'"),
    "file_path with NUL": (first("file_path", "a\0b"), "no 'file_path'"),
    "long file_path": (first("file_path", "x" * 5000), "no 'file_path'"),
    "file_path of 400 characters": (table(lambda t: [f.update(file_path="9" * 400) for f in t["frames"]]), "None of the 3"),
    "400 digits": (table(lambda t: t.update(w="DIGITS")), "400 digits"),
    "h = 1e300": (table(lambda t: t.update(h=1e300)), "not a size in pixels"),
    "deep JSON": (table(lambda t: t.update(deep=json.loads("[" * 300 + "]" * 300))), "64 deep"),
    "H = inf": (rows(lambda a: a.__setitem__((0, 4), np.inf)), "Height, width"),
    "far = inf": (rows(lambda a: a.__setitem__((0, 16), np.inf)), "depth bounds"),
    "images_²": (numbered, "no pictures"),
    "singular scale": (archive(seeds.idr, **{f"scale_mat_{i}": np.diag([0.0, 1, 1, 1]) for i in range(3)}), "no similarity"),
    "text points": (archive(seeds.npz, points=np.array([["a", "b", "c"]])), "'points'"),
    "points of 1e300": (archive(seeds.npz, points=points_at(1e300)), "points"),
    "points of 1e30": (archive(seeds.npz, points=points_at(1e30)), "points"),
    "infinite bounds": (archive(seeds.npz, bounds=np.array([[-np.inf] * 3, [np.inf] * 3])), "bounds"),
    "bounds of 1e300": (archive(seeds.npz, bounds=np.array([[-1e300] * 3, [1e300] * 3])), "bounds"),
    "camera far from its box": (archive(seeds.npz, cam_to_world=poses_far), "far away"),
    "0 x 0": (text("cameras.txt", "12 9 11 11", "0 0 11 11"), "0x0 pixels"),
    "COLMAP name of 400 characters": (long_names, "None of the 3"),
    "COLMAP name that is no UTF-8": (no_utf8, "name is no text in UTF-8"),
    "PNG chunk of 4 GB": (long_chunk, "is damaged: the chunk at byte 33 is cut off"),
    "COLMAP quaternion of 1e200": (large_quaternion, "quaternion|rotation|pose"),
    "COLMAP point of NaN": (text("points3D.txt", " 0.0 0.0 0.0 ", " nan 0.0 0.0 "), "cannot be read"),
    "COLMAP point of 1e300": (text("points3D.txt", " 0.0 0.0 0.0 ", " 1e300 0.0 0.0 "), "points|near plane"),
}


@pytest.mark.parametrize("name", BAD_SCENES)
def test_scenes_are_refused(tmp_path: Path, name: str) -> None:
    make, sentence = BAD_SCENES[name]
    with pytest.raises(InputError, match=sentence) as caught:
        open_scene(str(make(tmp_path)))
    assert len(str(caught.value).splitlines()) <= 2


def with_floats(values: dict[str, float]) -> Callable[[Path], Path]:
    """A PLY file whose first Gaussian has other properties."""

    def make(root: Path) -> Path:
        path = root / seeds.ply(root)
        data = bytearray(path.read_bytes())
        start = data.index(b"end_header\n") + len(b"end_header\n")
        names = [line.split()[-1].decode() for line in bytes(data[:start]).splitlines() if line.startswith(b"property")]
        for name, value in values.items():
            struct.pack_into("<f", data, start + 4 * names.index(name), value)
        path.write_bytes(data)
        return path

    return make


BAD_GAUSSIANS = {
    "quaternion of 1e30": (with_floats({"rot_0": 1e30, "rot_1": 1e30}), "the rotations of 1 of 20"),
    "scale of exp(80)": (with_floats({"scale_0": 80.0}), "the scales of 1 of 20"),
    "centre at 1e30": (with_floats({"x": 1e30}), "the centres of 1 of 20"),
    "colour of 1e30": (with_floats({"f_dc_0": 1e30}), "the colours of 1 of 20"),
}


@pytest.mark.parametrize("name", BAD_GAUSSIANS)
def test_gaussians_are_refused(tmp_path: Path, name: str) -> None:
    make, sentence = BAD_GAUSSIANS[name]
    with pytest.raises(InputError, match=sentence):
        read_gaussians(make(tmp_path))


BAD_RECIPES = {
    "presets = 5": (lambda body: "presets = 5\n" + body, "'presets'"),
    "presets.laptop = 5": (lambda body: "[presets]\nlaptop = 5\n", "'presets'"),
    "eps = nan": (lambda body: re.sub(r"(?m)^eps = .*$", "eps = nan", body), "'optimiser.eps' cannot be nan"),
    "no UTF-8": (lambda body: body + "\udcff", "UTF-8"),
    "deep": (lambda body: body + "\nx = " + "[" * 200 + "]" * 200, "64 deep"),
}


@pytest.mark.parametrize("name", BAD_RECIPES)
def test_recipes_are_refused(tmp_path: Path, name: str) -> None:
    change, sentence = BAD_RECIPES[name]
    path = tmp_path / seeds.recipe(tmp_path)
    body = path.read_text().partition("[presets")[0] if name.startswith("presets") else path.read_text()
    path.write_bytes(change(body).encode("utf-8", errors="surrogateescape"))
    with pytest.raises(InputError, match=sentence):
        load_method(str(path))


def test_a_study_of_too_many_cells_is_refused_before_it_is_expanded(tmp_path: Path) -> None:
    path = tmp_path / seeds.study(tmp_path)
    levels = ", ".join(map(str, range(1, 1001)))
    path.write_text(path.read_text() + f'"a.b" = [{levels}]\n"a.c" = [{levels}]\n"a.d" = [{levels}]\n')
    with pytest.raises(InputError, match="16,000,000,000 cells"):
        read_study(path)


SAVED = {
    "text": ({"rgb": np.full((9, 12, 3), "a")}, "<U1, not real numbers"),
    "complex": ({"depth": np.ones((9, 12), np.complex64)}, "complex64, not real numbers"),
    "sizes that differ": ({"rgb": np.ones((4, 4, 3))}, "differ in size"),
}


@pytest.mark.parametrize("name", SAVED)
def test_saved_arrays_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "run").mkdir()
    folders.run_pictures(tmp_path / "run")
    change, sentence = SAVED[name]
    path = tmp_path / "run" / "test" / "0000.npz"
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | change))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=sentence):
        open_pictures(tmp_path / "run").prediction(0, True)
    with pytest.raises(InputError, match="has the shape" if "size" in name else sentence):
        read_arrays(path, (9, 12))


@pytest.mark.parametrize("step", ['"3"', "null", "true", "[1]", "9" * 400])
def test_a_history_without_steps_is_not_resumed(tmp_path: Path, step: str) -> None:
    path = tmp_path / "history.jsonl"
    path.write_text(f'{{"step": {step}, "seconds": 1.0}}\n{{"step": 9, "seconds": 2.0}}\n')
    with pytest.raises(InputError, match="line 1, is"):
        cut_history(path, 5)


RENDERED: dict[str, tuple[str, dict[str, np.ndarray], str]] = {
    "points of another shape": ("points.npz", {"position": np.ones((3, 1), np.float32)}, "position of .* is float32 of shape"),
    "points of text": ("points.npz", {"position": np.full((3, 3), "a")}, "position of .* is <U1"),
    "depth of another size": ("test/0000.npz", {"depth": np.ones((4, 4), np.float32)}, "depth of .* is float32 of shape"),
}


@pytest.mark.parametrize("name", RENDERED)
def test_rendered_scenes_are_refused(tmp_path: Path, name: str) -> None:
    file, change, sentence = RENDERED[name]
    folders.rendered_scene(tmp_path)
    path, truth = tmp_path / file, tmp_path / "truth.json"
    with np.load(path) as found:
        arrays = dict(found)
    np.savez(path, **(arrays | change))  # type: ignore[arg-type]
    table = json.loads(truth.read_text())
    truth.write_text(json.dumps(table | {"files": {}}))
    with pytest.raises(InputError, match=sentence):
        open_scene(str(tmp_path))


def test_camera_paths_are_refused(tmp_path: Path) -> None:
    path = tmp_path / folders.camera_path(tmp_path)
    good = path.read_text()
    for place, value, sentence in (("fov_degrees", 1e-300, "fov_degrees"), ("camera_to_world", 1e300, "too far away")):
        table = json.loads(good)
        if place == "fov_degrees":
            table["keyframes"][0][place] = value
        else:
            table["keyframes"][0][place][0][3] = value
        path.write_text(json.dumps(table))
        with pytest.raises(InputError, match=sentence):
            read_camera_path(path)
