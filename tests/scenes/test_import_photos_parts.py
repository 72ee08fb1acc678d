"""The stages of an import on their own: working copies, pairs, lens removal, and the process that does the work."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dots import save
from icc import P3_D50, matrix_profile
from PIL import Image

from invgraphics.errors import InputError
from invgraphics.scenes.photos import PhotoJob, job
from invgraphics.scenes.photos.maker import JOB, RESULT, WORK, reconstruct, result_folder
from invgraphics.scenes.photos.prepare import Preparation, prepare
from invgraphics.scenes.photos.result import _move_points, max_distortion, write_scene
from invgraphics.scenes.photos.sfm import pairs
from invgraphics.scenes.photos.sources import find_sources, natural
from invgraphics.scenes.pictures.lens import Lens, straighten
from invgraphics.scenes.process import run_worker


def quiet(done: int, total: int, what: str) -> None:
    assert 0 <= done <= total
    assert what


def noise(seed: int, width: int, height: int, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def prepared(folder: Path, tmp_path: Path, **options) -> Preparation:
    work = tmp_path / "work"
    work.mkdir(exist_ok=True)
    preparation = prepare(PhotoJob(str(folder), **options), work, quiet)
    preparation.write(tmp_path / "p.json")
    assert Preparation.read(tmp_path / "p.json") == preparation
    return preparation


def test_copies_are_upright_reduced_and_grouped(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    for index in range(3):
        save(noise(index, 200, 100), folder / f"IMG_{9 + index}.png")
    exif = Image.Exif()
    exif[0x0112] = 8  # counter-clockwise
    turned = noise(3, 200, 100)
    Image.fromarray(turned).save(folder / "IMG_12.png", exif=exif)
    preparation = prepared(folder, tmp_path, max_size=100)
    assert [photo.name for photo in preparation.photos] == ["IMG_9.png", "IMG_10.png", "IMG_11.png", "IMG_12.png"]
    assert [(photo.width, photo.height) for photo in preparation.photos] == [(100, 50)] * 3 + [(50, 100)]
    assert [photo.orientation for photo in preparation.photos] == [1, 1, 1, 8]
    assert len({photo.group for photo in preparation.photos}) == 2
    small = np.array(Image.open(tmp_path / "work/photos/IMG_12.png"))
    averaged = np.rot90(turned).reshape(100, 2, 50, 2, 3).mean(axis=(1, 3))
    assert np.abs(small - averaged).max() <= 0.51
    separate = prepared(folder, tmp_path, cameras="per-photo")
    assert len({photo.group for photo in separate.photos}) == 4


def test_working_copies_are_srgb_and_name_the_profile_they_had(tmp_path: Path) -> None:
    picture = np.full((64, 64, 3), (200, 60, 60), np.uint8)
    for index in range(3):
        picture[0, 0] = index
        profile = matrix_profile(P3_D50) if index else None
        (tmp_path / "photos").mkdir(exist_ok=True)
        Image.fromarray(picture).save(tmp_path / f"photos/{index}.png", icc_profile=profile)
    found = prepared(tmp_path / "photos", tmp_path).photos
    assert [photo.profile for photo in found] == ["", "wide", "wide"]
    copies = [np.array(Image.open(tmp_path / f"work/photos/{index}.png"))[9, 9].tolist() for index in range(3)]
    assert copies[0] == [200, 60, 60] and copies[1] == copies[2] and copies[1][0] > 210
    assert "icc_profile" not in Image.open(tmp_path / "work/photos/1.png").info


def test_transparent_parts_are_masked_and_kept(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    for index in range(3):
        picture = noise(index, 64, 64, 4)
        picture[..., 3] = np.where(np.arange(64) < 20, 0, 255)
        save(picture, folder / f"{index}.png")
    preparation = prepared(folder, tmp_path)
    assert all(photo.masked for photo in preparation.photos)
    mask = np.array(Image.open(tmp_path / "work/masks/0.png.png"))
    np.testing.assert_array_equal(mask, np.broadcast_to(np.where(np.arange(64) < 20, 0, 255), (64, 64)))
    assert np.array(Image.open(tmp_path / "work/photos/0.png")).shape == (64, 64, 4)


def test_exif_focal_length_is_known(tmp_path: Path) -> None:
    """24 mm on 35 mm film at a 3:2 picture: 24/36 of the width."""
    folder = tmp_path / "photos"
    folder.mkdir()
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 24
    for index in range(2):
        Image.fromarray(noise(index, 300, 200)).save(folder / f"{index}.jpg", exif=exif)
    Image.fromarray(noise(2, 300, 200)).save(folder / "2.jpg")
    photos = prepared(folder, tmp_path, max_size=150).photos
    assert photos[0].focal == pytest.approx(24 / 36 * 150, rel=0.05)
    assert photos[2].focal is None
    assert photos[0].group == photos[1].group != photos[2].group


def test_the_pictures_of_a_data_set_are_taken_as_fits_see_them(tmp_path: Path) -> None:
    """Straight, with the calibrated camera, and told apart by their own names."""
    table = {"fl_x": 90.0, "fl_y": 90.0, "cx": 50.0, "cy": 42.0, "w": 96, "h": 80, "camera_model": "PINHOLE", "frames": []}
    for index in range(9):
        save(noise(index, 96, 80), tmp_path / f"set/images/{index}.png")
        table["frames"].append({"file_path": f"images/{index}.png", "transform_matrix": np.diag([1.0, 1, 1, 1]).tolist()})
        table["frames"][-1]["transform_matrix"][0][3] = float(index)
    (tmp_path / "set/transforms.json").write_text(json.dumps(table))
    photos = prepared(tmp_path / "set", tmp_path).photos
    assert [photo.source for photo in photos] == [f"{index}.png" for index in range(9)]
    assert {(photo.focal, photo.centre) for photo in photos} == {(90.0, (50.0, 42.0))}
    for index in range(9):
        copy = np.array(Image.open(tmp_path / f"work/photos/{index}.png"))
        np.testing.assert_array_equal(copy, noise(index, 96, 80))


def test_the_pictures_of_a_data_set_are_reduced_while_they_are_read(tmp_path: Path, monkeypatch) -> None:
    """None is kept at its full size; the copies and their cameras are as if each had been reduced by itself."""
    from invgraphics.scenes.nerfstudio import Nerfstudio

    table = {"fl_x": 180.0, "cx": 100.0, "cy": 84.0, "w": 192, "h": 160, "camera_model": "PINHOLE", "frames": []}
    for index in range(9):
        save(noise(index, 192, 160), tmp_path / f"set/images/{index}.png")
        pose = np.eye(4)
        pose[0, 3] = index
        table["frames"].append({"file_path": f"images/{index}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "set/transforms.json").write_text(json.dumps(table))
    load, scenes = Nerfstudio.load, []
    monkeypatch.setattr(Nerfstudio, "load", lambda *arguments: scenes.append(load(*arguments)) or scenes[-1])
    photos = prepared(tmp_path / "set", tmp_path, max_size=96).photos
    assert {view.image.shape for view in (*scenes[0].train, *scenes[0].test)} == {(80, 96, 3)}
    assert {(photo.width, photo.height, photo.focal, photo.centre) for photo in photos} == {(96, 80, 90.0, (50.0, 42.0))}
    for index in range(9):
        copy = np.array(Image.open(tmp_path / f"work/photos/{index}.png"))
        assert np.abs(copy - noise(index, 192, 160).reshape(80, 2, 96, 2, 3).mean((1, 3))).max() <= 0.51


def test_names_are_told_apart(tmp_path: Path) -> None:
    for index, name in enumerate(["my photo.png", "my photo.jpg", "other.png"]):
        save(noise(index, 64, 64), tmp_path / "photos" / name)
    names = [photo.name for photo in prepared(tmp_path / "photos", tmp_path).photos]
    assert names == ["my_photo.jpg.png", "my_photo.png.png", "other.png.png"]


def test_names_that_no_text_file_takes(tmp_path: Path) -> None:
    """Not UTF-8, a comment of COLMAP's list of pairs, a digit that is no number, letters that become the same."""
    (tmp_path / "photos").mkdir()
    for index, name in enumerate((b"foto_\xe9_1.png", b"foto_\xe8_1.png", b"#3.png", "1²3.png".encode(), b"a\nb.png")):
        save(noise(index, 64, 64), tmp_path / "a.png")
        (tmp_path / "a.png").rename(tmp_path / "photos" / os.fsdecode(name))
    photos = prepared(tmp_path / "photos", tmp_path).photos
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+\.png", photo.name) for photo in photos)
    assert len({photo.name for photo in photos}) == len({photo.source for photo in photos}) == 5
    "".join(photo.source for photo in photos).encode()
    assert any("foto_\\udce9_1" in photo.source for photo in photos)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_progress_is_reported_in_any_encoding(encoding: str) -> None:
    """A name is no reason to end the work."""
    script = "from invgraphics.scenes.process import write_progress; write_progress(1, 2, 'foto \\udce9\\n \u0444')"
    environment = os.environ | {"PYTHONIOENCODING": encoding}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.decode(encoding) == (
        "progress 1 2 foto ? \u0444\n" if encoding == "utf-8" else "progress 1 2 foto ? ?\n"
    )


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"a.txt": b"x"}, "no photograph"),
        ({"below/a.png": b"x"}, "photographs in .*below: name that folder"),
        ({"one/a.avif": b"x", "two/b.jpg": b"x"}, "photographs in .*one, .*two: name one of these folders, or put all"),
        ({"a.heic": b"\0\0\0\x18ftypheic"}, "decodes HEIC"),
        ({"a.jpg": b"broken", "b.jpg": b"broken too"}, "cannot be read as a picture"),
    ],
)
def test_folders_without_photographs(content: dict[str, bytes], expected: str, tmp_path: Path) -> None:
    for name, data in content.items():
        (tmp_path / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "photos" / name).write_bytes(data)
    with pytest.raises(InputError, match=expected):
        prepared(tmp_path / "photos", tmp_path)


def test_photographs_in_folders_below_are_told_of(tmp_path: Path) -> None:
    for seed, name in enumerate(("a.png", "b.png", "c.png", "second camera/d.png")):
        save(noise(seed, 64, 64), tmp_path / "photos" / name)
    save(np.full((64, 64), 255, np.uint8), tmp_path / "photos/masks/a.png.png")
    (tmp_path / "photos/notes").mkdir()
    found = prepared(tmp_path / "photos", tmp_path)
    assert [photo.source for photo in found.photos] == ["a.png", "b.png", "c.png"]
    assert found.skipped == {"second camera/": "a folder with photographs of its own; put all of them into one"}


@pytest.mark.parametrize("kind", ["jpg", "webp"])
def test_focal_lengths_of_files_that_colmap_cannot_read(kind: str, tmp_path: Path) -> None:
    """A 26 mm equivalent, as telephones write it: 26 of the film's 36 mm; COLMAP, by the film's diagonal, has a little more."""
    image = Image.fromarray(noise(0, 64, 48))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26
    (tmp_path / "photos").mkdir()
    for name in "ab":
        image.save(tmp_path / "photos" / f"{name}.{kind}", exif=exif)
    sources = find_sources(PhotoJob(str(tmp_path / "photos")), {})
    assert [source.focal_share for source in sources] == [pytest.approx(26 / 36, rel=0.05)] * 2


def test_a_decoder_that_is_installed_later_makes_another_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The advice for a HEIC file is to install one; what was imported without it is then made again."""
    save(noise(0, 64, 64), tmp_path / "photos/a.png")
    request = PhotoJob(str(tmp_path / "photos"))
    before = request.key()
    assert request.key() == before
    known = {"pycolmap": "4", "pillow": "12", "pillow-heif": "1"}
    monkeypatch.setattr(job, "version", known.__getitem__)
    after = request.key()
    monkeypatch.setitem(known, "pillow-heif", "2")
    assert len({before, after, request.key()}) == 3


def test_one_camera_cannot_have_two_sizes(tmp_path: Path) -> None:
    save(noise(0, 64, 48), tmp_path / "photos/a.png")
    for index in (1, 2):
        save(noise(index, 48, 64), tmp_path / f"photos/{index}.png")
    with pytest.raises(InputError, match="48x64, 64x48"):
        prepared(tmp_path / "photos", tmp_path, cameras="single")


def test_two_photographs_are_refused_before_any_feature_is_sought(tmp_path: Path) -> None:
    for index in range(2):
        save(noise(index, 64, 64), tmp_path / f"photos/{index}.png")
    with pytest.raises(InputError, match=r"only two photographs \(0\.png, 1\.png\)") as refused:
        prepared(tmp_path / "photos", tmp_path)
    assert "at least 3" in str(refused.value)


def test_numbers_in_names_count_as_numbers() -> None:
    assert sorted(["b10", "B9", "a2b11", "a2b3"], key=natural) == ["a2b3", "a2b11", "B9", "b10"]
    assert sorted(["1²3", "1²10", "٣"], key=natural) == ["1²3", "1²10", "٣"], "raised to a power is no number, any script's is"


def test_pairs() -> None:
    assert len(pairs(200, "auto")) == 200 * 199 // 2
    near = pairs(300, "auto")
    assert near == pairs(300, "sequential")
    assert {j - i for i, j in near} == {*range(1, 11), 16, 32, 64, 128, 256}
    assert all(0 <= i < j < 300 for i, j in near)
    assert len(pairs(300, "exhaustive")) == 300 * 299 // 2


def test_masks_and_calibrations_of_a_data_set_are_kept(tmp_path: Path) -> None:
    """What the data set masks is not matched, and masked in the scene too; other focal lengths are other cameras."""
    table: dict[str, Any] = {"w": 96, "h": 80, "camera_model": "PINHOLE", "frames": []}
    for index in range(9):
        save(noise(index, 96, 80), tmp_path / f"set/images/{index}.png")
        mask = np.full((80, 96), 255, np.uint8)
        mask[:, : 10 * (index % 2)] = 0
        save(mask, tmp_path / f"set/masks/{index}.png")
        focal, pose = 90.0 if index < 5 else 120.0, np.eye(4)
        pose[0, 3] = index
        frame = {"file_path": f"images/{index}.png", "mask_path": f"masks/{index}.png", "fl_x": focal, "fl_y": focal}
        table["frames"].append(frame | {"cx": 50.0, "cy": 42.0, "transform_matrix": pose.tolist()})
    (tmp_path / "set/transforms.json").write_text(json.dumps(table))
    photos = prepared(tmp_path / "set", tmp_path).photos
    assert sorted({photo.group: photo.focal for photo in photos}.values()) == [90.0, 120.0]
    assert [photo.own_mask and photo.masked for photo in photos] == [bool(index % 2) for index in range(9)]
    for index, photo in enumerate(photos):
        left_out = np.array(Image.open(tmp_path / f"work/masks/{photo.name}.png")) == 0
        assert left_out.sum() == 80 * 10 * (index % 2) and not left_out[:, 10 * (index % 2) :].any()


@pytest.mark.parametrize("place", ["masks", "photos/masks"])
def test_masks_beside_photographs_are_used(place: str, tmp_path: Path) -> None:
    """By COLMAP's names or the photographs' own, at another size, in part, and of photographs that EXIF turns."""
    folder, exif = tmp_path / "photos", Image.Exif()
    exif[0x0112] = 6
    for index in range(5):
        save(noise(index, 192, 128), folder / f"{index}.png")
    for index in (3, 4):
        Image.fromarray(noise(index, 192, 128)).save(folder / f"{index}.png", exif=exif)
    left = np.full((128, 192), 255, np.uint8)
    left[:, :48] = 0
    save(left, tmp_path / place / "0.png.png")
    save(left[::2, ::2], tmp_path / place / "1.png")
    save(left, tmp_path / place / "3.png")  # drawn on the photograph as it is stored
    save(np.rot90(left, -1), tmp_path / place / "4.png")  # drawn on it as it is shown
    photos = prepared(folder, tmp_path, max_size=96).photos
    assert [photo.own_mask for photo in photos] == [True, True, False, True, True]
    for photo, turns in zip(photos, (0, 0, None, -1, -1), strict=True):
        expected = np.full((64, 96), 255, np.uint8) if turns is None else np.rot90(left[::2, ::2], turns)
        np.testing.assert_array_equal(np.array(Image.open(tmp_path / f"work/masks/{photo.name}.png")), expected)
        if turns is not None:
            np.testing.assert_array_equal(np.array(Image.open(tmp_path / f"work/own-masks/{photo.name}.png")), expected)
    key = PhotoJob(str(folder)).key()
    (tmp_path / place / "other.png").write_bytes(b"of no photograph")
    assert PhotoJob(str(folder)).key() == key
    save(left.T, tmp_path / place / "4.png")
    assert PhotoJob(str(folder)).key() != key


def test_a_mask_that_cannot_be_used_leaves_its_photograph_out(tmp_path: Path) -> None:
    for index in range(6):
        save(noise(index, 64, 64), tmp_path / f"photos/{index}.png")
    save(np.zeros((64, 64), np.uint8), tmp_path / "masks/0.png")
    save(np.full((64, 32), 255, np.uint8), tmp_path / "masks/1.png")
    save(np.eye(64, dtype=np.uint8) * 255, tmp_path / "masks/2.png")
    preparation = prepared(tmp_path / "photos", tmp_path, max_size=64)
    assert set(preparation.skipped) == {"0.png", "1.png"}
    assert "is black" in preparation.skipped["0.png"] and "has 32x64 pixels" in preparation.skipped["1.png"]
    work = tmp_path / "again"
    work.mkdir()
    job = PhotoJob(str(tmp_path / "photos"), max_size=64)
    save(np.eye(640, dtype=np.uint8) * 255, tmp_path / "masks/2.png")
    save(noise(2, 640, 640), tmp_path / "photos/2.png")
    assert prepare(job, work, quiet).skipped["2.png"] == "Its mask leaves no pixel"


def test_masks_are_straightened_with_their_pictures(tmp_path: Path) -> None:
    """A dark disc in the picture is masked: in the straight picture, too, the mask covers it, and little more."""
    import pycolmap

    grid = np.hypot(*np.meshgrid(np.arange(160) - 30.0, np.arange(120) - 30.0))
    picture, mask = np.where(grid < 12, 0, 255).astype(np.uint8), np.where(grid < 13, 0, 255).astype(np.uint8)
    model = pycolmap.Reconstruction()
    params = [150.0, 80.0, 60.0, -0.2]
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=160, height=120, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for number in (1, 2, 3):
        changed = picture.copy()
        changed[-1, -number] = 7  # no two may be the same
        save(np.repeat(changed[..., None], 3, axis=2), tmp_path / f"photos/{number}.png")
        save(mask, tmp_path / f"masks/{number}.png")
        image = pycolmap.Image(f"{number}.png", [], 1, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([np.eye(3), [number, 0, 0]])))
    photos = prepared(tmp_path / "photos", tmp_path).photos
    assert write_scene(model, photos, tmp_path / "work", tmp_path / "result", quiet) > 3
    for number in (1, 2, 3):
        dark = np.array(Image.open(tmp_path / f"result/images/{number}.png"))[:100, :100, 0] < 250
        left_out = np.array(Image.open(tmp_path / f"result/masks/{number}.png.png"))[:100, :100] == 0
        assert dark.sum() > 300 and (left_out | ~dark).all()
        assert left_out.sum() < 1.6 * dark.sum()


def test_a_lens_is_removed_from_pictures_and_model_alike(tmp_path: Path) -> None:
    """COLMAP's own synthetic scene through a bent lens: afterwards a plain pinhole explains the same observations."""
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 4, 60
    options.camera_width, options.camera_height = 160, 120
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [150.0, 80.0, 60.0, -0.1]
    model = pycolmap.synthesize_dataset(options)
    folder = tmp_path / "photos"
    for number, image in enumerate(model.images.values()):
        image.name = f"{number}.png"
        save(noise(number, 160, 120), folder / image.name)
    preparation = prepared(folder, tmp_path)
    own = replace(preparation.photos[0], own_mask=True)  # as of a data set
    save(np.eye(120, 160, dtype=np.uint8) * 255, tmp_path / "work/own-masks/0.png.png")
    preparation = replace(preparation, photos=(own, *preparation.photos[1:]))
    moved = write_scene(model, preparation.photos, tmp_path / "work", tmp_path / "result", quiet)
    # The corner is at radius 100/150 of the focal length: x k r³ f.
    assert moved == pytest.approx(150 * 0.1 * (100 / 150) ** 3, rel=0.5)
    written = pycolmap.Reconstruction(str(tmp_path / "result/sparse/0"))
    assert {camera.model_name for camera in written.cameras.values()} == {"PINHOLE"}
    errors = []
    for image in written.images.values():
        for point in image.points2D:
            if point.has_point3D():
                errors.append(np.linalg.norm(image.project_point(written.points3D[point.point3D_id].xyz) - point.xy))
    assert len(errors) > 100
    assert max(errors) < 0.02
    assert Image.open(tmp_path / "result/images/0.png").size == (160, 120)
    assert [path.name for path in (tmp_path / "result/masks").iterdir()] == ["0.png.png"]


def test_the_lens_of_a_removed_photograph_does_not_matter(tmp_path: Path) -> None:
    """The last of five cameras has a lens that nothing straightens, and no photograph in the scene."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for number in range(1, 6):
        save(noise(number, 160, 106), tmp_path / f"photos/{number}.png")
        params = [120.0, 80.0, 53.0, -1.0] if number == 5 else [190.0, 80.0, 53.0, 0.01]
        camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=160, height=106, params=params, camera_id=number)
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(f"{number}.png", [], number, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([np.eye(3), [number, 0, 0]])))
    photos = prepared(tmp_path / "photos", tmp_path).photos
    model.deregister_frame(model.images[5].frame_id)
    moved = write_scene(model, photos, tmp_path / "work", tmp_path / "result", quiet)
    assert 0 < moved < 1, "of the pictures that are written"
    assert len(list((tmp_path / "result/images").iterdir())) == 4
    written = pycolmap.Reconstruction(str(tmp_path / "result/sparse/0"))
    assert written.num_reg_images() == 4
    assert {camera.model_name for camera in written.cameras.values()} == {"PINHOLE"}


def test_features_without_a_ray_are_outside_the_straight_picture() -> None:
    """In the corners of strong barrel distortion the lens has no inverse; a model must hold no NaN."""
    import pycolmap

    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1000, height=750, params=[700.0, 500.0, 375.0, -0.25])
    middle, corner = SimpleNamespace(xy=np.array([500.0, 375.0])), SimpleNamespace(xy=np.array([0.0, 0.0]))
    assert np.isnan(camera.cam_from_img(corner.xy[None])).any()
    image = SimpleNamespace(points2D=[middle, corner], num_points2D=lambda: 2)
    _move_points(image, camera, straighten(Lens("SIMPLE_RADIAL", (700.0, 500.0, 375.0, -0.25), 1000, 750)))
    assert corner.xy.tolist() == [-1, -1] and np.abs(middle.xy - [500, 375]).max() < 5


def test_how_much_a_lens_bends() -> None:
    assert max_distortion(Lens("PINHOLE", (100.0, 100.0, 50.0, 50.0), 100, 100)) == 0
    assert max_distortion(Lens("SIMPLE_RADIAL", (100.0, 50.0, 50.0, 1e-4), 100, 100)) == pytest.approx(
        100 * 1e-4 * 0.5**1.5, rel=0.01
    )


@pytest.mark.parametrize(("focal", "k"), [(550.0, -0.15), (700.0, -0.2), (700.0, -0.25), (800.0, -0.25)])
def test_a_strong_lens_bends_though_its_corners_have_no_rays(focal: float, k: float) -> None:
    lens = Lens("SIMPLE_RADIAL", (focal, 500.0, 375.0, k), 1000, 750)
    moved = max_distortion(lens)
    # On the picture's shorter axis, where the lens has an inverse: r - k r³ = 375 / f is at least that much longer.
    assert np.isfinite(moved) and moved > focal * abs(k) * (375 / focal) ** 3
    assert all(np.isfinite(straighten(lens).focal))


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_FISHEYE", (100.0, 100.0, 75.0)),
        ("OPENCV_FISHEYE", (100.0, 100.0, 100.0, 75.0, 0.0, 0.0, 0.0, 0.0)),
        ("RADIAL_FISHEYE", (100.0, 100.0, 75.0, 0.0, 0.0)),
    ],
)
def test_a_fisheye_without_coefficients_is_no_pinhole(model: str, parameters: tuple[float, ...]) -> None:
    """It draws angles: a ray 45 degrees off the axis meets the picture at f π/4, where a pinhole has f."""
    lens = Lens(model, parameters, 200, 150)
    assert not lens.is_pinhole()
    assert max_distortion(lens) > 10
    assert Lens("OPENCV", (100.0, 100.0, 100.0, 75.0, 0.0, 0.0, 0.0, 0.0), 200, 150).is_pinhole()
    straight = straighten(lens)
    seen = np.array([[150.0, 75.0]])  # what the straight picture shows there comes from where the angle says
    angle = np.arctan((seen[0, 0] - straight.principal_point[0]) / straight.focal[0])
    place = (straight.grid[75, 150, 0] + straight.grid[74, 150, 0]).item() / 2  # rows on both sides of the axis
    assert (place + 1) * 100 == pytest.approx(100 + 100 * angle, abs=0.6)


def test_settings_are_checked() -> None:
    for wrong in ({"matching": "all"}, {"lens": "bent"}, {"max_size": 10}, {"seed": -1}):
        with pytest.raises(InputError, match="cannot be"):
            PhotoJob("photos", **wrong)


def test_a_worker_that_is_killed_is_a_sentence(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "executable", _script(tmp_path, "echo 'progress 1 2 working'; kill -9 $$"))
    told = []
    with pytest.raises(InputError, match=r"It failed: its process died of SIGKILL") as caught:
        run_worker("some.module", tmp_path, lambda *step: told.append(step), "It failed", "Try again.")
    assert caught.value.remedy == "Try again."
    assert told == [(1, 2, "working")]


def test_a_worker_that_fails_is_quoted(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "executable", _script(tmp_path, "echo Traceback >&2; echo 'ValueError: why' >&2; exit 1"))
    with pytest.raises(InputError, match="It failed: ValueError: why"):
        run_worker("some.module", tmp_path, quiet, "It failed", "")
    monkeypatch.setattr(sys, "executable", _script(tmp_path, """echo 'error ["What", "Do"]'; exit 1"""))
    with pytest.raises(InputError, match="What\nDo"):
        run_worker("some.module", tmp_path, quiet, "It failed", "")


def _script(folder: Path, body: str) -> str:
    path = folder / "worker"
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return str(path)


def test_a_request_is_known_by_what_is_read(tmp_path: Path, monkeypatch) -> None:
    """However its folder is spelled, whatever else lies there; of photographs, size and date count."""
    folder = tmp_path / "photos"
    for index in range(3):
        save(noise(index, 64, 64), folder / f"{index}.png")
    job = PhotoJob(str(folder))
    keys = [job.key(), job.matches_key()]
    monkeypatch.chdir(tmp_path)
    for spelled in ("photos", "./photos/", "photos/../photos"):
        assert [PhotoJob(spelled).key(), PhotoJob(spelled).matches_key()] == keys
    for name in (".DS_Store", "._0.png", "Thumbs.db", "notes.txt", ".hidden.jpg", "below/0.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"anything")
        assert [job.key(), job.matches_key()] == keys, name
    assert len(prepared(folder, tmp_path).photos) == 3
    (folder / "3.dng").write_bytes(b"told as left out")
    assert job.key() != keys[0]
    (folder / "3.dng").unlink()
    save(noise(9, 64, 64), folder / "0.png")
    assert job.key() != keys[0] and job.matches_key() != keys[1]


def test_the_files_of_a_data_set_count_but_for_hidden_ones(tmp_path: Path) -> None:
    save(noise(0, 64, 64), tmp_path / "images/0.png")
    (tmp_path / "transforms.json").write_text("{}")
    key = PhotoJob(str(tmp_path)).key()
    for name in (".DS_Store", "images/.DS_Store", "images/Thumbs.db", ".git/index"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"anything")
        assert PhotoJob(str(tmp_path)).key() == key, name
    (tmp_path / "transforms.json").write_text('{"w": 1}')
    assert PhotoJob(str(tmp_path)).key() != key


def test_an_import_is_gone_on_with_from_another_folder(tmp_path: Path, monkeypatch) -> None:
    """Working copies that a command with a relative path has left are used by one with an absolute path."""
    for index in range(3):
        save(noise(index, 64, 64), tmp_path / f"photos/{index}.png")

    def interrupted(*args, **kwargs):
        (tmp_path / "out" / WORK / "left").write_text("something")
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", interrupted)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(PhotoJob("photos"), Path("out"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    left = tmp_path / "out" / WORK / "left"
    left.write_text("not written again")
    monkeypatch.setattr(subprocess, "Popen", lambda *args, **kwargs: pytest.fail(left.read_text()))
    with pytest.raises(pytest.fail.Exception, match="not written again"):
        reconstruct(PhotoJob(str(tmp_path / "photos")), tmp_path / "out")


def test_an_interrupted_import_is_gone_on_with(tmp_path: Path, monkeypatch) -> None:
    """Working copies of the first attempt are used; those of another request are not."""
    for index in range(3):
        save(noise(index, 64, 64), tmp_path / f"photos/{index}.png")
    job, out = PhotoJob(str(tmp_path / "photos")), tmp_path / "out"
    started = []

    def interrupted(*args, **kwargs):
        started.append((out / WORK / JOB).read_text())
        (out / WORK / "left").write_text("something")
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", interrupted)
    left = []
    for request in (job, job, PhotoJob(str(tmp_path / "photos"), seed=1)):
        left.append((out / WORK / "left").exists())
        with pytest.raises(KeyboardInterrupt):
            reconstruct(request, out)
    assert [first == second for first, second in pairwise(started)] == [True, False]
    assert left == [False, True, True]


def test_a_refused_result_replaces_no_usable_one(tmp_path: Path, monkeypatch) -> None:
    """It lies beside it and answers its own request; the next usable result replaces both."""
    save(noise(0, 64, 64), tmp_path / "photos/0.png")
    out, calls = tmp_path / "out", []

    def work(module: str, folder: Path, *args, **kwargs) -> None:
        asked = json.loads((folder / JOB).read_text())
        seed = asked["job"]["seed"]
        calls.append(seed)
        (folder / RESULT / "images").mkdir(parents=True)
        (folder / RESULT / "images" / f"{seed}.png").write_text("")
        report = {"key": asked["key"], "job": asked["job"], "usable": seed % 2 == 0}
        (folder / RESULT / "quality.json").write_text(json.dumps(report))

    monkeypatch.setattr("invgraphics.scenes.photos.maker.run_worker", work)

    def left(seed: int) -> tuple[bool, Path, list[str]]:
        quality = reconstruct(PhotoJob(str(tmp_path / "photos"), seed=seed), out)
        files = sorted(str(path.relative_to(out)) for path in out.glob("**/images/*"))
        return quality["usable"], result_folder(out, quality), files

    assert left(1) == (False, out, ["images/1.png"])
    assert left(0) == (True, out, ["images/0.png"])
    assert left(3) == left(3) == (False, out / "refused", ["images/0.png", "refused/images/3.png"])
    assert left(0) == (True, out, ["images/0.png", "refused/images/3.png"])
    assert calls == [1, 0, 3]
    assert left(2) == (True, out, ["images/2.png"])
