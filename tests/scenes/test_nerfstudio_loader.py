"""``transforms.json`` of nerfstudio and instant-ngp, distorted lenses included."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dots import COLOURS, GL, POINTS, Eye, assert_dots_are_found, composited, ring, save
from PIL import Image

from invgraphics.errors import InputError
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.nerfstudio import Nerfstudio
from invgraphics.scenes.open import validate
from invgraphics.scenes.ply_points import read_points

K1, K2, P1, P2, K3 = 0.6, -0.3, 0.01, -0.008, 0.2


def opencv(x: np.ndarray, y: np.ndarray, k3: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Brown and Conrady's model, as OpenCV's documentation writes it."""
    r2 = x * x + y * y
    radial = 1 + K1 * r2 + K2 * r2**2 + k3 * r2**3
    return x * radial + 2 * P1 * x * y + P2 * (r2 + 2 * x * x), y * radial + P1 * (r2 + 2 * y * y) + 2 * P2 * x * y


def opencv_k3(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return opencv(x, y, K3)


def rational(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's rational model: six coefficients, of which three divide."""
    r2 = x * x + y * y
    radial = (1 + K1 * r2 + K2 * r2**2 + K3 * r2**3) / (1 + 0.1 * r2 + 0.2 * r2**2 - 0.05 * r2**3)
    return x * radial + 2 * P1 * x * y + P2 * (r2 + 2 * x * x), y * radial + P1 * (r2 + 2 * y * y) + 2 * P2 * x * y


def fisheye(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kannala and Brandt's equidistant model with one coefficient."""
    r = np.sqrt(x * x + y * y).clip(1e-9)
    theta = np.arctan(r)
    scale = theta * (1 + 0.05 * theta**2) / r
    return x * scale, y * scale


def write(path: Path, eyes, top: dict, listed_only: int = 0, suffix: str = ".png") -> Path:
    frames = []
    for index, eye in enumerate(eyes):
        if index >= listed_only:
            save(eye.picture(), path / "images" / f"{index:04}.png")
        pose = (eye.cam_to_world @ GL).tolist()
        frames.append({"file_path": f"images/{index:04}{suffix}", "transform_matrix": pose})
    eye = eyes[0]
    intrinsics = {"fl_x": eye.focal[0], "fl_y": eye.focal[1], "cx": eye.centre[0], "cy": eye.centre[1], "w": 160, "h": 120}
    (path / "transforms.json").write_text(json.dumps({**intrinsics, **top, "frames": frames[::-1]}))
    return path


def edit(path: Path, change) -> None:
    table = json.loads((path / "transforms.json").read_text())
    change(table)
    (path / "transforms.json").write_text(json.dumps(table))


DISTORTED = {"k1": K1, "k2": K2, "p1": P1, "p2": P2}


@pytest.mark.parametrize(
    ("distortion", "top"),
    [
        (None, {}),
        (opencv, DISTORTED),
        (opencv_k3, {**DISTORTED, "k3": K3}),
        (rational, {**DISTORTED, "camera_model": "FULL_OPENCV", "k3": K3, "k4": 0.1, "k5": 0.2, "k6": -0.05}),
        (fisheye, {"camera_model": "OPENCV_FISHEYE", "k1": 0.05}),
        (fisheye, {"is_fisheye": True, "k1": 0.05}),
        (None, {"camera_model": "PINHOLE", "k1": 0.3}),
    ],
)
def test_dots_are_where_the_cameras_say(tmp_path: Path, distortion, top: dict) -> None:
    write(tmp_path, ring(distortion=distortion), top)
    scene = validate(Nerfstudio().load(tmp_path, SceneOptions()))
    assert_dots_are_found(scene)
    assert ("undistortion" in scene.notes) == (distortion is not None)


@pytest.mark.parametrize("model", [None, "OPENCV", "RADIAL"])
def test_a_fourth_radial_term_is_not_taken_for_a_denominator(tmp_path: Path, model: str | None) -> None:
    """Nerfstudio's polynomial, 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸, is no model of COLMAP's."""
    named = {} if model is None else {"camera_model": model}
    write(tmp_path, ring(9), {"k1": 0.05, "k4": -0.05, **named})
    with pytest.raises(InputError, match=r"frame 0 .* has a 'k4' that is not 0, .* (OPENCV|RADIAL) .*\n.*FULL_OPENCV"):
        Nerfstudio().load(tmp_path, SceneOptions())
    edit(tmp_path, lambda table: table.update(k4=0.0, k6=0.1))
    with pytest.raises(InputError, match="'k6' that is not 0"):
        Nerfstudio().load(tmp_path, SceneOptions())
    edit(tmp_path, lambda table: table.update(k6=0.0))
    assert Nerfstudio().load(tmp_path, SceneOptions()).notes["undistortion"].startswith("OPENCV removed")


def point_file(kind: str) -> bytes:
    """The dots as nerfstudio writes them (text), or with doubles and normals between the columns (binary)."""
    if kind == "ascii":
        head = "ply\nformat ascii 1.0\nelement vertex 6\n"
        head += "".join(f"property float {name}\n" for name in "xyz")
        head += "".join(f"property uint8 {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
        rows = [
            f"{x:.8f} {y:.8f} {z:.8f} {r:.0f} {g:.0f} {b:.0f}"
            for (x, y, z), (r, g, b) in zip(POINTS, 255 * COLOURS, strict=True)
        ]
        return (head + "\n".join(rows) + "\n").encode()
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    head = f"ply\nformat {kind} 1.0\ncomment written by hand\nelement vertex 7\n"
    head += "".join(f"property double {name}\n" for name in "xyz") + "property float nx\n"
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    head += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [
        struct.pack(f"{order}dddfBBB", *point, 0.5, *np.rint(255 * c).astype(int))
        for point, c in zip(POINTS, COLOURS, strict=True)
    ]
    return head.encode() + b"".join(rows) + struct.pack(f"{order}dddfBBB", np.nan, 0, 0, 0, 1, 2, 3)


@pytest.mark.parametrize(
    ("kind", "white"), [("uchar", 255), ("ushort", 65535), ("ushort", 255), ("int", 255), ("float", 1), ("double", 255)]
)
def test_colours_of_points_in_every_type(tmp_path: Path, kind: str, white: int) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {name}\n" for name in "xyz")
    head += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    rows = [f"0 0 0 {white} {0.2 * white:.{0 if white > 1 else 1}f} 0", "1 0 0 0 0 0"]
    (tmp_path / "a.ply").write_text(head + "\n".join(rows) + "\n")
    points = read_points(tmp_path / "a.ply")
    assert points is not None
    assert points.rgb[0].tolist() == pytest.approx([1.0, 0.2, 0.0])


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_beside_the_poses_are_kept(tmp_path: Path, kind: str) -> None:
    """They are in the frame of the poses, whatever transform both have been through; one that is not finite is left out."""
    write(tmp_path, ring(9), {"ply_file_path": "sparse_pc.ply", "applied_transform": np.eye(4)[[1, 0, 2]].tolist()})
    (tmp_path / "sparse_pc.ply").write_bytes(point_file(kind))
    scene = validate(Nerfstudio().load(tmp_path, SceneOptions()))
    assert scene.points is not None
    world = scene.points.position @ scene.world_from_local[:3, :3].T + scene.world_from_local[:3, 3]
    np.testing.assert_allclose(world.numpy(), POINTS, atol=1e-5)
    np.testing.assert_allclose(scene.points.rgb.numpy(), COLOURS, atol=0.003)
    assert scene.notes["points"] == "6 from sparse_pc.ply"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"plain text", "is no PLY file: its header has no beginning"),
        (b"ply\nformat ascii 1.0\n", "is no PLY file: its header has no end"),
        (point_file("ascii")[:-60], "is cut off: it has 4 of 6 vertices"),
        (point_file("binary_little_endian")[:-40], "is cut off: it has 5 of 7 vertices"),
        (point_file("ascii").replace(b"vertex 6", b"vertex 999999999999999999"), "is cut off: it has 6 of 9"),
        (point_file("ascii").replace(b"0.8", b"abc"), "vertex that is no numbers"),
        (point_file("ascii").replace(b"float z", b"float w"), "is no PLY file of points"),
        (point_file("ascii").replace(b"property float z", b"property list uchar int z"), "cannot be read"),
    ],
)
def test_bad_points_are_a_sentence(tmp_path: Path, content: bytes, sentence: str) -> None:
    write(tmp_path, ring(9), {"ply_file_path": "sparse_pc.ply"})
    (tmp_path / "sparse_pc.ply").write_bytes(content)
    with pytest.raises(InputError, match=rf"sparse_pc\.ply.* {sentence}"):
        Nerfstudio().load(tmp_path, SceneOptions())


def test_absent_points_are_noted(tmp_path: Path) -> None:
    scene = Nerfstudio().load(write(tmp_path, ring(9), {"ply_file_path": "./sparse_pc.ply"}), SceneOptions())
    assert (scene.points, scene.notes["points"]) == (None, "./sparse_pc.ply is absent")
    edit(tmp_path, lambda table: table.update(ply_file_path=3))
    with pytest.raises(InputError, match=r"'ply_file_path' of .* is 3, not the path"):
        Nerfstudio().load(tmp_path, SceneOptions())


def test_distortion_matters(tmp_path: Path) -> None:
    """The check above can fail: the same pictures without their coefficients put the dots elsewhere."""
    write(tmp_path, ring(distortion=opencv), {})
    with pytest.raises(AssertionError, match="px"):
        assert_dots_are_found(Nerfstudio().load(tmp_path, SceneOptions()))


def test_dots_are_found_after_resizing(tmp_path: Path) -> None:
    write(tmp_path, ring(distortion=opencv), DISTORTED)
    scene = Nerfstudio().load(tmp_path, SceneOptions(size=100))
    assert scene.train[0].image.shape == (75, 100, 3)
    assert_dots_are_found(scene)


def test_split_absent_files_and_missing_suffix(tmp_path: Path) -> None:
    write(tmp_path, ring(20), {}, listed_only=3, suffix="")
    scene = Nerfstudio().load(tmp_path / "transforms.json", SceneOptions())
    assert [view.name for view in scene.test] == ["images/0003", "images/0011", "images/0019"]
    assert len(scene.train) == 14
    assert scene.notes["missing"] == "3 of 20 listed files are absent: images/0002, images/0001, images/0000"
    assert scene.name == tmp_path.name


def test_the_file_s_own_split_is_kept(tmp_path: Path) -> None:
    write(tmp_path, ring(10), {})
    name = "images/{:04}.png".format

    def names(**lists: list[str]) -> tuple[list[str], ...]:
        edit(tmp_path, lambda table: [table.pop(key, None) for key in ("train_filenames", "val_filenames", "test_filenames")])
        edit(tmp_path, lambda table: table.update(lists))
        scene = Nerfstudio().load(tmp_path, SceneOptions())
        return tuple([view.name for view in views] for views in (scene.train, scene.val, scene.test))

    rest = [name(index) for index in range(9, 2, -1)]  # in the order of the file's frames
    split = {"val_filenames": [name(0)], "test_filenames": ["./" + name(1), name(2)]}
    assert names(train_filenames=[name(5), name(4)], **split) == ([name(5), name(4)], [name(0)], [name(2), name(1)])
    assert names(**split) == (rest, [name(0)], [name(2), name(1)])
    assert names(val_filenames=[name(2), name(1), name(0)]) == (rest, [], [name(2), name(1), name(0)]), "val is scored"
    for wrong, sentence in (
        ({"test_filenames": ["images/none.png"]}, "which no frame has"),
        ({"test_filenames": "images"}, "is not a list of file names"),
        ({"train_filenames": rest, "test_filenames": [name(4)]}, "both to fit and to score"),
    ):
        with pytest.raises(InputError, match=sentence):
            names(**wrong)
    for without in ({"train_filenames": rest}, {"train_filenames": [], "val_filenames": [], "test_filenames": []}):
        assert names(**without)[2] == [name(0), name(8)], "every eighth, where the file names none to score"


def test_the_end_of_a_full_turn_is_no_training_view_of_its_beginning(tmp_path: Path) -> None:
    eyes = ring(9)
    write(tmp_path, [*eyes, eyes[0], eyes[3]], {})
    scene = validate(Nerfstudio().load(tmp_path, SceneOptions()))
    assert [view.name[-8:-4] for view in scene.test] == ["0000", "0008"]
    assert [view.name[-8:-4] for view in scene.train] == ["0001", "0002", "0003", "0004", "0005", "0006", "0007", "0010"]
    assert scene.notes["split"] == "every 8th photograph by name; 1 with the pose of one of them are left out"


def test_a_file_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = write(tmp_path, ring(9), {}) / "transforms.json"
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert_dots_are_found(Nerfstudio().load(tmp_path, SceneOptions()))


def test_local_frame(tmp_path: Path) -> None:
    """The subject is at the origin, cameras reach distance 1, their up is +z, and the similarity leads back to the world."""
    write(tmp_path, ring(12), {})
    scene = Nerfstudio().load(tmp_path, SceneOptions(test_views=None))
    views = scene.train + scene.test
    distances = torch.stack([view.camera.position.norm() for view in views])
    assert float(distances.max()) == pytest.approx(1.0, abs=1e-5)
    assert float(distances.min()) == pytest.approx(1.0, abs=1e-5), "all axes meet in one point, which is the origin"
    up = -torch.stack([view.camera.cam_to_world[:3, 1] for view in views]).mean(0)
    assert float(up[2] / up.norm()) == pytest.approx(1.0, abs=1e-5)
    assert scene.scale == pytest.approx(np.linalg.norm(ring(12)[0].cam_to_world[:3, 3]), rel=1e-5)
    by_name = {view.name: view for view in views}
    for index, eye in enumerate(ring(12)):
        local = by_name[f"images/{index:04}.png"].camera.position
        world = scene.world_from_local[:3, :3] @ local + scene.world_from_local[:3, 3]
        np.testing.assert_allclose(world.numpy(), eye.cam_to_world[:3, 3], atol=1e-5)
    assert scene.bounds.space == "contracted"


def test_intrinsics_per_frame(tmp_path: Path) -> None:
    eyes = ring(8)
    write(tmp_path, eyes, {"fl_x": 1.0, "cx": 5.0})

    def own(table: dict) -> None:
        for frame in table["frames"]:
            frame |= {"fl_x": 150.0, "cx": 83.0}

    edit(tmp_path, own)
    assert_dots_are_found(Nerfstudio().load(tmp_path, SceneOptions()))


def test_scaled_copies_of_the_photographs(tmp_path: Path) -> None:
    """Intrinsics for twice the size of the files on disk."""
    double = {"w": 320, "h": 240, "fl_x": 300.0, "fl_y": 310.0, "cx": 166.0, "cy": 116.0}
    write(tmp_path, ring(8, distortion=opencv), {**DISTORTED, **double})
    assert_dots_are_found(Nerfstudio().load(tmp_path, SceneOptions()))


@pytest.mark.parametrize("orientation", [3, 6])
@pytest.mark.parametrize("sized", [True, False])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_exif_turns_no_calibrated_photograph(tmp_path: Path, orientation: int, sized: bool, suffix: str) -> None:
    write(tmp_path, ring(9), {}, suffix="")
    for path in sorted((tmp_path / "images").iterdir()):
        picture = Image.open(path)
        exif = picture.getexif()
        exif[0x0112] = orientation
        path.unlink()
        picture.save(path.with_suffix(suffix), exif=exif)
    edit(tmp_path, lambda table: None if sized else (table.pop("w"), table.pop("h")))
    assert_dots_are_found(Nerfstudio().load(tmp_path, SceneOptions()))


def test_exif_turns_photographs_whose_cameras_have_the_turned_shape_only(tmp_path: Path) -> None:
    write(tmp_path, ring(9), {})
    for path in (tmp_path / "images").iterdir():
        picture = Image.open(path).transpose(Image.Transpose.ROTATE_90)
        exif = picture.getexif()
        exif[0x0112] = 6
        picture.save(path, exif=exif)
    assert_dots_are_found(Nerfstudio().load(tmp_path, SceneOptions()))


def _set_matrix(entry: tuple[int, int], value: object):
    def change(table: dict) -> None:
        table["frames"][2]["transform_matrix"][entry[0]][entry[1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda table: table.pop("frames"), "has no list of 'frames'"),
        (lambda table: table["frames"][2].pop("transform_matrix"), r"frame 2 \('images/0006.png'\) has no 'transform_matrix'"),
        (lambda table: table["frames"][2].pop("file_path"), "frame 2, has no 'file_path'"),
        (lambda table: (table.pop("fl_x"), table.pop("fl_y")), "has no focal length"),
        (lambda table: table.update(fl_x=-3), r"frame 0 .* is -3, 155, not positive"),
        (lambda table: table.update(k1="lots"), "'k1' of .* is 'lots', not a finite number"),
        (lambda table: table.update(w=0), "not a size in pixels"),
        (lambda table: table.update(camera_model="EQUIRECTANGULAR"), "camera model 'EQUIRECTANGULAR'"),
        (_set_matrix((0, 3), float("nan")), r"pose of .*frame 2 \('images/0006.png'\) has entries that are not finite"),
        (_set_matrix((0, 0), 7.0), "frame 2 .* is not rigid"),
        (_set_matrix((0, 0), "x"), "frame 2 .* is not a 4x4 matrix of numbers"),
        (lambda table: [f.update(file_path="no/" + f["file_path"]) for f in table["frames"]], "None of the 9 pictures"),
        (lambda table: table.update(frames=table["frames"][:1]), "1 photograph is too few"),
    ],
)
def test_bad_input_is_a_sentence(tmp_path: Path, change, sentence: str) -> None:
    write(tmp_path, ring(9), {})
    edit(tmp_path, change)
    with pytest.raises(InputError, match=sentence):
        Nerfstudio().load(tmp_path, SceneOptions())


def test_mirrored_pose_is_refused(tmp_path: Path) -> None:
    write(tmp_path, ring(9), {})
    edit(tmp_path, lambda t: [row.__setitem__(0, -row[0]) for row in t["frames"][1]["transform_matrix"]])
    with pytest.raises(InputError, match=r"frame 1 .* is left-handed"):
        Nerfstudio().load(tmp_path, SceneOptions())


def test_broken_json_names_line_and_column(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text('{\n  "w": 3,\n  "h" 4\n}')
    with pytest.raises(InputError, match=r"transforms\.json is not valid JSON: .* at line 3, column 7"):
        Nerfstudio().load(tmp_path, SceneOptions())


@pytest.mark.data
def test_fox_reports_what_is_absent(data) -> None:
    scene = validate(Nerfstudio().load(data("fox"), SceneOptions(size=480, train_views=12)))
    assert scene.notes["missing"].startswith("17 of 67 listed files are absent: images/0005.jpg")
    assert scene.notes["train_views"].startswith("12 of 43")
    assert scene.notes["test_views"].startswith("7 of 7")
    assert scene.train[0].image.shape == (480, 270, 3)
    assert scene.has_alpha is False
    assert sampson_distance(scene.train[4], scene.train[5]) < 1.0


def sampson_distance(first, second) -> float:
    """Median distance in pixels of matched features from the epipolar lines of our cameras."""
    from skimage.feature import ORB, match_descriptors

    found = []
    for view in (first, second):
        orb = ORB(n_keypoints=500, fast_threshold=0.05)
        orb.detect_and_extract(view.colour().mean(-1).numpy())
        found.append((orb.keypoints[:, ::-1] + 0.5, orb.descriptors))
    pairs = match_descriptors(found[0][1], found[1][1], cross_check=True, max_ratio=0.8)
    assert len(pairs) > 40
    inverse = [np.linalg.inv(intrinsics(view)) for view in (first, second)]
    motion = second.camera.world_to_cam.double().numpy() @ first.camera.cam_to_world.double().numpy()
    x, y, z = motion[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion[:3, :3]
    fundamental = inverse[1].T @ essential @ inverse[0]
    a, b = (np.concatenate([points[pairs[:, i]], np.ones((len(pairs), 1))], axis=1) for i, (points, _) in enumerate(found))
    lines_b, lines_a = a @ fundamental.T, b @ fundamental
    gradient = (lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1)
    return float(np.median(np.abs((b * lines_b).sum(1)) / np.sqrt(gradient)))


def intrinsics(view) -> np.ndarray:
    (fx, fy), (cx, cy) = view.camera.focal.tolist(), view.camera.principal_point.tolist()
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def test_the_dots_are_well_placed() -> None:
    """The helper itself: all dots are inside all pictures and apart from each other."""
    for eye in ring(20):
        pixels = eye.pixels(POINTS)
        assert (pixels > 8).all()
        assert (pixels < np.array(eye.size) - 8).all()


@pytest.mark.parametrize("grey", [None, 255, 90])
def test_an_object_by_itself_is_in_a_box(tmp_path: Path, grey: int | None) -> None:
    eyes = ring(14, distance=40.0)
    path = write(tmp_path, eyes, {"camera_model": "PINHOLE"})
    for index, eye in enumerate(eyes):
        rgba = eye.picture(with_alpha=True)
        save(rgba if grey is None else composited(rgba, grey), path / "images" / f"{index:04}.png")
    scene = validate(Nerfstudio().load(path, SceneOptions()))
    assert scene.bounds.space == "box"
    assert scene.bounds.hi.tolist() == [1.5, 1.5, 1.5]
    assert torch.allclose(scene.world_from_local[:3, 3], torch.zeros(3), atol=1e-4)
    distance = 40 * np.hypot(0.9, 0.43)
    assert scene.scale == pytest.approx(1.05 * distance * 80 / 150 / 1.5, rel=0.01)
    assert scene.background.tolist() == pytest.approx([1.0 if grey is None else grey / 255] * 3)


def test_a_black_border_may_be_the_rim_of_a_lens(tmp_path: Path) -> None:
    scene = Nerfstudio().load(write(tmp_path, ring(14), {}), SceneOptions())
    assert scene.bounds.space == "contracted"


def test_transparent_corners_may_be_what_undistortion_left(tmp_path: Path) -> None:
    path = write(tmp_path, ring(14), {})
    for file in (path / "images").iterdir():
        rgba = np.full((120, 160, 4), 255, np.uint8)
        rgba[..., :3] = np.random.default_rng(0).uniform(0, 255, (120, 160, 3))
        rgba[:20, :20, 3] = 0
        save(rgba, file)
    scene = validate(Nerfstudio().load(path, SceneOptions()))
    assert scene.bounds.space == "contracted"
    # Something is there, but not in the picture: not to be fitted or scored as empty.
    assert not scene.has_alpha and scene.notes["alpha"] == "transparent pixels (2.1 %) are masked"
    for view in (*scene.train, *scene.test):
        assert view.mask is not None
        assert not view.mask[:20, :20].any() and int(view.mask.sum()) == 120 * 160 - 400


def side_by_side() -> list[Eye]:
    eye = ring(1)[0]
    return [replace(eye, t=eye.t + np.array([0.1 * index, 0.0, 0.0])) for index in range(9)]


def outwards() -> list[Eye]:
    """The ring's cameras, turned around where they stand."""
    turn = np.diag([-1.0, 1.0, -1.0])
    return [replace(eye, R=turn @ eye.R, t=turn @ eye.t) for eye in ring(14)]


@pytest.mark.parametrize("cameras", [side_by_side, outwards])
def test_transparent_pictures_without_a_focus_before_them_are_of_endless_space(
    tmp_path: Path, cameras: Callable[[], list[Eye]]
) -> None:
    eyes = cameras()
    path = write(tmp_path, eyes, {})
    for index, eye in enumerate(eyes):
        save(eye.picture(with_alpha=True), path / "images" / f"{index:04}.png")
    scene = validate(Nerfstudio().load(path, SceneOptions()))
    assert scene.has_alpha
    assert scene.bounds.space == "contracted"


def test_scaled_copies_that_alone_were_kept_are_found(tmp_path: Path) -> None:
    write(tmp_path, ring(8, distortion=opencv), {**DISTORTED, "w": 160, "h": 120})
    (tmp_path / "images").rename(tmp_path / "images_2")
    for photo in (tmp_path / "images_2").iterdir():
        with Image.open(photo) as picture:
            picture.resize((80, 60), Image.Resampling.BOX).save(photo)
    scene = Nerfstudio().load(tmp_path, SceneOptions())
    assert {(view.camera.width, view.camera.height) for view in scene.train} == {(80, 60)}
    assert_dots_are_found(scene)
