"""Photographs of a traced box through structure from motion; the tracer knows where its cameras stood."""

import io
import json
import shutil
import sqlite3
import subprocess
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dots import save
from in_process import work_here
from photo_box import Box, orbit, poses, shoot
from PIL import Image, ImageFilter

from invgraphics.core.transforms import apply_similarity
from invgraphics.errors import InputError
from invgraphics.metrics.poses import pose_errors
from invgraphics.scenes.open import SceneOptions, open_scene
from invgraphics.scenes.photos import PhotoJob, mapping, reconstruct
from invgraphics.scenes.photos.job import DATABASE, MODELS
from invgraphics.scenes.photos.pairs import read_verified_matches
from invgraphics.scenes.photos.prepare import prepare
from invgraphics.scenes.photos.quality import describe
from invgraphics.scenes.photos.strategies import WIDE_ANGLE, Strategy

SIZE = 240
EYES = orbit(10, SIZE, arc=90)
ORIENTATION, FOCAL_35 = 0x0112, 0xA405


@pytest.fixture(scope="module")
def box_photos(tmp_path_factory) -> Path:
    return shoot(tmp_path_factory.mktemp("box"), Box(repeated=False), EYES)


@pytest.fixture(scope="module")
def imported(box_photos: Path, tmp_path_factory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("imported") / "scene"
    steps: list[tuple[int, int, str]] = []
    quality = reconstruct(PhotoJob(str(box_photos), lens="pinhole"), out, progress=lambda *step: steps.append(step))
    assert [done for done, _, _ in steps] == sorted(done for done, _, _ in steps)
    assert {what.split()[0] for _, _, what in steps} >= {"reading", "features", "matching", "placing", "checking"}
    return out, quality


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reconstruct in this process."""
    work_here(monkeypatch)


def truth_errors(quality: dict, eyes=EYES):
    """By the number at the beginning of each photograph's name."""
    estimated = torch.tensor([camera["cam_to_world"] for camera in quality["cameras"]], dtype=torch.float64)
    index = [int(camera["source"][:3]) for camera in quality["cameras"]]
    return pose_errors(estimated, poses(eyes)[index])


def test_poses_points_and_figures_are_right(imported) -> None:
    out, quality = imported
    assert (quality["registered"], quality["used"], quality["usable"], quality["skipped"]) == (10, 10, True, {})
    errors = truth_errors(quality)
    # Ten photographs of a quarter turn tell the focal length from the distance only so far.
    assert float(errors.rotation_degrees.max()) < 1.5
    assert float(errors.translation_per_cent.max()) < 3
    assert 0 < quality["reprojection_error_px"] < 1
    assert quality["track_length"] > 2.5
    assert not quality["consistency"]["suspicious"]
    assert [row["kept"] for row in quality["attempts"]] == [True]
    assert quality["choice"] == "incremental mapper, pinhole lens"
    assert Image.open(out / "top-view.png").size == (1200, 600)
    kept = {path.name for path in (out / ".import").iterdir()}
    assert {"database.db"} < kept <= {"job.json", "lock", "database.db", "database.db-wal", "database.db-shm"}


def test_the_folder_opens_as_a_scene_with_its_points_on_the_box(imported) -> None:
    out, quality = imported
    scene = open_scene(str(out), SceneOptions(test_views=None))
    assert (len(scene.train), len(scene.test)) == (8, 2)
    assert scene.points is not None
    assert len(scene.points) == quality["points"] > 300
    by_name = {camera["name"]: torch.tensor(camera["cam_to_world"]) for camera in quality["cameras"]}
    for view in scene.train:
        world = apply_similarity(scene.world_from_local.double(), view.camera.cam_to_world.double())
        torch.testing.assert_close(world.float(), by_name[view.name], atol=1e-4, rtol=0)
    world = scene.points.position.double() @ scene.world_from_local[:3, :3].double().T + scene.world_from_local[:3, 3].double()
    x, y, z = truth_errors(quality).similarity.points(world).numpy().T
    on_floor = np.abs(z)
    outside = np.maximum(np.maximum(np.abs(x), np.abs(y)) - 0.5, np.abs(z - 0.5) - 0.5)
    assert np.median(np.minimum(on_floor, np.abs(outside))) < 0.02


def test_pictures_of_a_pinhole_are_not_resampled(imported, box_photos: Path) -> None:
    for source in sorted(box_photos.iterdir()):
        np.testing.assert_array_equal(np.array(Image.open(imported[0] / "images" / source.name)), np.array(Image.open(source)))


def test_the_same_request_is_answered_at_once(imported, box_photos: Path, monkeypatch) -> None:
    def refuse(*args, **kwargs):
        raise AssertionError("a process was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    out, quality = imported
    assert reconstruct(PhotoJob(str(box_photos), lens="pinhole"), out) == quality


@pytest.mark.usefixtures("in_process")
def test_another_mapper_finds_features_and_matches(imported, box_photos: Path, tmp_path: Path) -> None:
    """The data base that lies there is used: what another program has written into it is still there afterwards."""
    out = tmp_path / "scene"
    shutil.copytree(imported[0], out)
    database = out / ".import" / DATABASE
    with closing(sqlite3.connect(database)) as content:
        content.execute("create table other (x)")
    job = PhotoJob(str(box_photos), lens="pinhole", mapper="global")
    quality = reconstruct(job, out)
    assert quality["registered"] == 10
    assert quality["choice"].startswith("global mapper")
    assert float(truth_errors(quality).rotation_degrees.max()) < 2
    with closing(sqlite3.connect(database)) as content:
        assert content.execute("select count(*) from other").fetchone() == (0,)
    assert job.matches_key() == PhotoJob(str(box_photos)).matches_key()
    for other in ({"max_size": 200}, {"lens": "fisheye"}, {"seed": 1}, {"matching": "sequential"}):
        assert PhotoJob(str(box_photos), **other).matches_key() != job.matches_key()


@pytest.mark.parametrize(
    "strategy",
    [
        Strategy("global", "opencv"),
        Strategy("incremental", "radial", calibrated=True, initial_angle=WIDE_ANGLE),
        Strategy("global", "pinhole", guided=True),
    ],
    ids=lambda strategy: strategy.name,
)
def test_each_way_from_matches_to_poses(strategy: Strategy, imported, box_photos: Path, tmp_path: Path) -> None:
    job = PhotoJob(str(box_photos))
    photos = prepare(job, tmp_path, lambda *_: None).photos
    shutil.copy(imported[0] / ".import" / DATABASE, tmp_path)
    before = read_verified_matches(tmp_path / DATABASE, photos)
    models = mapping.reconstruct(strategy, mapping.Matched(job, photos, before, tmp_path), lambda *_: None)
    assert models[0].num_reg_images() >= 9
    assert {camera.model_name for camera in models[0].cameras.values()} == {MODELS[strategy.lens]}
    quality = describe(models[0], photos)
    assert float(truth_errors(quality).rotation_degrees.max()) < 3
    after = read_verified_matches(tmp_path / DATABASE, photos)
    assert [len(pair) for pair in after.pairs] == [len(pair) for pair in before.pairs]


def test_another_folders_scene_is_not_overwritten(imported, tmp_path: Path) -> None:
    save(np.zeros((64, 64, 3), np.uint8), tmp_path / "a.png")
    with pytest.raises(InputError, match="holds the scene of"):
        reconstruct(PhotoJob(str(tmp_path)), imported[0])


def test_another_folder_gets_the_same_bits(imported, box_photos: Path, tmp_path: Path) -> None:
    again = reconstruct(PhotoJob(str(box_photos), lens="pinhole"), tmp_path / "again")
    assert again["cameras"] == imported[1]["cameras"]
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "again/sparse/0" / name).read_bytes() == (imported[0] / "sparse/0" / name).read_bytes()


@pytest.mark.usefixtures("in_process")
def test_a_mixed_bag_keeps_what_can_be_used(box_photos: Path, tmp_path: Path) -> None:
    """Turned by EXIF, 16 bits, smaller, EXIF focal length, a copy, HEIC without a decoder, a stump, and a blurred one."""
    bag = tmp_path / "bag of photos"
    shutil.copytree(box_photos, bag)
    picture = Image.open(bag / "001.png")
    exif = Image.Exif()
    exif[ORIENTATION] = 6  # to be turned by 90 degrees clockwise
    picture.transpose(Image.Transpose.ROTATE_90).save(bag / "001 turned.png", exif=exif)
    (bag / "001.png").unlink()
    _save_16_bits(np.array(Image.open(bag / "002.png")), bag / "002.png")
    Image.open(bag / "003.png").resize((180, 180), Image.Resampling.BOX).save(bag / "003.png")
    exif = Image.Exif()
    exif.get_ifd(0x8769)[FOCAL_35] = round(1.3 * 36)
    Image.open(bag / "004.png").save(bag / "004.jpg", exif=exif, quality=95)
    (bag / "004.png").unlink()
    shutil.copy(bag / "005.png", bag / "005 copy.png")
    (bag / "006.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))
    (bag / "007.jpg").write_bytes(b"\xff\xd8\xff\xe0" + bytes(30))
    Image.open(bag / "008.png").filter(ImageFilter.GaussianBlur(12)).save(bag / "008.png")
    (bag / "009.dng").write_bytes(b"II*\0")
    (bag / "notes.txt").write_text("not a photograph")
    quality = reconstruct(PhotoJob(str(bag), lens="pinhole"), tmp_path / "scene")
    assert quality["registered"] == 9
    assert float(truth_errors(quality).rotation_degrees.max()) < 2
    assert set(quality["skipped"]) == {"005.png", "006.heic", "007.jpg", "009.dng"}
    assert "decodes HEIC" in quality["skipped"]["006.heic"]
    assert quality["skipped"]["005.png"] == "the same picture as 005 copy.png"
    assert "raw" in quality["skipped"]["009.dng"]
    assert set(quality["unplaced"]) == {"008.png"}
    assert "blurred" in quality["unplaced"]["008.png"]
    assert len(quality["lenses"]) == 3  # full size, small, and the one whose EXIF tells the focal length
    validated = open_scene(str(tmp_path / "scene"), SceneOptions(test_views=None))
    assert len(validated.train) + len(validated.test) == 9


@pytest.mark.usefixtures("in_process")
def test_masks_beside_the_photographs_come_with_the_scene(box_photos: Path, tmp_path: Path) -> None:
    """Nothing is matched where they are dark, and what the scene's views show there does not count."""
    shutil.copytree(box_photos, tmp_path / "images")
    mask = np.full((SIZE, SIZE), 255, np.uint8)
    mask[: SIZE // 3] = 0
    for name in ("000.png", "004.png"):
        save(mask, tmp_path / "masks" / name)
    quality = reconstruct(PhotoJob(str(tmp_path / "images"), lens="pinhole"), tmp_path / "scene")
    assert (quality["registered"], quality["masked"]) == (10, 2)
    scene = open_scene(str(tmp_path / "scene"), SceneOptions(test_views=None))
    assert scene.notes["masks"].startswith("2 of 10")
    for view in (*scene.train, *scene.test):
        if view.name in ("000.png", "004.png"):
            np.testing.assert_array_equal(view.mask.numpy(), mask == 255)
        else:
            assert view.mask is None
    import pycolmap

    model = pycolmap.Reconstruction(str(tmp_path / "scene/sparse/0"))
    for image in model.images.values():
        if image.name in ("000.png", "004.png"):
            assert image.num_points3D and min(point.xy[1] for point in image.points2D) > SIZE // 3 - 2


def _save_16_bits(pixels: np.ndarray, path: Path) -> None:
    """An RGB PNG of 16 bits per channel, which Pillow cannot write."""
    import struct
    import zlib

    height, width, _ = pixels.shape
    rows = (pixels.astype(">u2") * 257).astype(">u2").reshape(height, -1)
    data = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)), (b"IDAT", data), (b"IEND", b"")]
    content = io.BytesIO()
    content.write(b"\x89PNG\r\n\x1a\n")
    for kind, body in chunks:
        content.write(struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)))
    path.write_bytes(content.getvalue())


def made_of(pictures: list[np.ndarray], folder: Path) -> Path:
    for index, picture in enumerate(pictures):
        save(picture, folder / f"{index:03}.png")
    return folder


def refused(folder: Path, out: Path) -> str:
    """The sentence about photographs that go through all stages and make no scene."""
    quality = reconstruct(PhotoJob(str(folder)), out)
    assert not quality["usable"]
    assert json.loads((out / "quality.json").read_text()) == quality
    return " ".join(quality["refusal"])


@pytest.mark.usefixtures("in_process")
def test_blurred_photographs(box_photos: Path, tmp_path: Path) -> None:
    blurred = [np.array(Image.open(path).filter(ImageFilter.GaussianBlur(12))) for path in sorted(box_photos.iterdir())[:4]]
    message = refused(made_of(blurred, tmp_path / "blurred"), tmp_path / "out")
    assert "No photograph could be placed: they show too little" in message
    assert "sharp" in message


@pytest.mark.usefixtures("in_process")
def test_photographs_from_one_place(box_photos: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    still = np.array(Image.open(box_photos / "000.png")).astype(float)
    noisy = [(still + rng.normal(0, 2, still.shape)).clip(0, 255).astype(np.uint8) for _ in range(4)]
    message = refused(made_of(noisy, tmp_path / "still"), tmp_path / "out")
    assert "one and the same place" in message
    assert "Step sideways" in message


@pytest.mark.usefixtures("in_process")
def test_photographs_that_do_not_overlap(tmp_path: Path) -> None:
    """One face each."""
    box = Box(repeated=False, floor=False)
    folder = made_of([box.photograph(eye) for eye in _frontal_eyes()], tmp_path / "apart")
    assert "hardly overlap" in refused(folder, tmp_path / "out")


def _frontal_eyes():
    level = []
    for eye in orbit(4, 200, distance=2.2):
        forward = eye.R[2] * [1, 1, 0] / np.linalg.norm(eye.R[2][:2])
        rows = np.stack([eye.R[0], np.array([0.0, 0.0, -1.0]), forward])
        position = np.array([0, 0, 0.5]) - 2.2 * forward
        level.append(replace(eye, R=rows, t=-rows @ position, focal=(380.0, 380.0)))
    return level


@pytest.mark.usefixtures("in_process")
def test_what_little_could_be_placed_is_kept(box_photos: Path, tmp_path: Path) -> None:
    """Four good photographs among nine that show nothing."""
    folder = tmp_path / "few"
    folder.mkdir()
    for name in ("000.png", "001.png", "002.png", "003.png"):
        shutil.copy(box_photos / name, folder / name)
    rng = np.random.default_rng(0)
    for index in range(6):
        save(np.full((SIZE, SIZE, 3), rng.integers(255), np.uint8) + np.uint8(index), folder / f"1{index:02}.png")
    message = refused(folder, tmp_path / "out")
    assert message.startswith("Only 4 of 10 photographs could be placed")
    scene = open_scene(str(tmp_path / "out"))
    assert len(scene.train) + len(scene.test) == 4


def test_an_error_of_the_work_process_is_passed_on(box_photos: Path, tmp_path: Path) -> None:
    """Copies of one photograph."""
    (tmp_path / "photos").mkdir()
    for name in ("a.png", "b.png"):
        shutil.copy(box_photos / "000.png", tmp_path / "photos" / name)
    expected = r"only one photograph \(a\.png\) that can be used; b\.png: the same picture as a\.png"
    with pytest.raises(InputError, match=expected):
        reconstruct(PhotoJob(str(tmp_path / "photos")), tmp_path / "out")


def test_places_that_cannot_be_used(box_photos: Path, tmp_path: Path) -> None:
    job = PhotoJob(str(box_photos))
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    for out, expected in (("file", "is a file"), ("file/below", "cannot be written"), ("full", "holds something else")):
        with pytest.raises(InputError, match=expected):
            reconstruct(job, tmp_path / out)
    with pytest.raises(InputError, match="inside the folder"):
        reconstruct(job, box_photos / "scene")
    (tmp_path / "empty").mkdir()
    for source, expected in (("nowhere", "no folder"), ("file", "is no folder"), ("empty", "empty folder")):
        with pytest.raises(InputError, match=expected):
            reconstruct(PhotoJob(str(tmp_path / source)), tmp_path / "out")


@pytest.mark.slow
def test_a_repeated_picture_is_suspicious_and_a_unique_one_is_not(tmp_path: Path) -> None:
    """Everything is placed at a small reprojection error, and wrong: only pairs against the whole show it."""
    found = {}
    for repeated in (False, True):
        eyes = orbit(36, 320)
        folder = shoot(tmp_path / f"repeated {repeated}", Box(repeated), eyes)
        quality = reconstruct(PhotoJob(str(folder), lens="pinhole"), tmp_path / f"scene {repeated}")
        found[repeated] = quality["consistency"]["suspicious"], float(truth_errors(quality, eyes).rotation_degrees.max())
        assert quality["registered"] >= 34
        assert quality["reprojection_error_px"] < 1
    assert found[False][0] is False and found[False][1] < 1
    assert found[True][0] is True and found[True][1] > 5
