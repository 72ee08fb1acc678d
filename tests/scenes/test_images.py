"""Reading, resizing and undistorting photographs."""

import io
import json
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from icc import P3_D50, SRGB_D50, matrix_profile
from PIL import Image, ImageCms, ImageOps

from invgraphics.core import Camera
from invgraphics.errors import InputError
from invgraphics.scenes.pictures.images import (
    Photo,
    image_files,
    image_size,
    match_sizes,
    profiles_note,
    read_pixels,
    stored_size,
)
from invgraphics.scenes.pictures.lens import Lens, straighten, undistort
from invgraphics.scenes.pictures.resize import area_resize, wanted_size
from invgraphics.scenes.pictures.views import load_view


def camera(width: int, height: int) -> Camera:
    double = torch.float64
    focal = torch.tensor([100.0, 110.0], dtype=double)
    return Camera(torch.eye(4, dtype=double), focal, torch.tensor([width / 2, height / 2], dtype=double), width, height)


@pytest.mark.parametrize("size", [(7, 5), (20, 9), (3, 1), (19, 13)])
def test_area_resize_is_the_exact_integral(size: tuple[int, int]) -> None:
    """Against brute force: repeat every pixel until old and new edges fall on one lattice, then average whole blocks."""
    width, height = size
    values = np.random.default_rng(0).random((13, 20, 3))
    fine = values.repeat(height, axis=0).repeat(width, axis=1)
    expected = fine.reshape(height, 13, width, 20, 3).mean((1, 3))
    np.testing.assert_allclose(area_resize(values, width, height), expected, atol=1e-12)
    np.testing.assert_allclose(area_resize(values.astype(np.float32), width, height), expected, atol=1e-6)


def test_transparent_pixels_do_not_bleed(tmp_path: Path) -> None:
    """Averaging red with an invisible green neighbour gives half-transparent red, not brown."""
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[:, 0::2] = (200, 0, 0, 255)
    pixels[:, 1::2] = (0, 255, 0, 0)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    view = load_view(Photo(tmp_path / "a.png", camera(4, 4), "a"), 2)
    assert view.alpha is not None
    assert view.image.tolist() == [[[200, 0, 0]] * 2] * 2
    assert view.alpha.tolist() == [[128] * 2] * 2
    assert view.camera.focal.tolist() == [50.0, 55.0]


def test_unchanged_size_keeps_every_byte(tmp_path: Path) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (6, 5, 4), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    view = load_view(Photo(tmp_path / "a.png", camera(5, 6), "a"))
    assert view.alpha is not None
    np.testing.assert_array_equal(np.dstack([view.image.numpy(), view.alpha.numpy()]), pixels)


@pytest.mark.parametrize("channels", [3, 4])
def test_wide_colours_become_srgb(tmp_path: Path, channels: int) -> None:
    """Against the matrices of the primaries in numpy; alpha is kept, and a loader's note names the profile."""
    pixels = np.random.default_rng(0).integers(60, 190, (12, 16, channels), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=matrix_profile(P3_D50))
    encoded = pixels[..., :3] / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    linear = (linear @ (np.linalg.inv(SRGB_D50) @ P3_D50).T).clip(0, 1)
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055) * 255
    found = read_pixels(tmp_path / "a.png")
    assert np.abs(found[..., :3] - expected).max() < 1.6
    assert np.abs(expected - pixels[..., :3]).max() > 5
    np.testing.assert_array_equal(found[..., 3:], pixels[..., 3:])
    photos = [Photo(tmp_path / "a.png", camera(16, 12), "a")]
    assert profiles_note(photos) == {"colour_profile": "of 1 photographs converted to sRGB: 1 from wide"}
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png", clip=True), pixels)  # numbers of labels are no colours


def test_bytes_stay_under_srgb_and_broken_profiles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    built_in = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    profiles = {"built-in": built_in, "matrix": matrix_profile(SRGB_D50), "none": None}
    for name, profile in profiles.items():
        Image.fromarray(pixels).save(tmp_path / f"{name}.png", icc_profile=profile)
        np.testing.assert_array_equal(read_pixels(tmp_path / f"{name}.png"), pixels)
        assert profiles_note([Photo(tmp_path / f"{name}.png", camera(16, 12), name)]) == {}
    assert capsys.readouterr().err == ""
    for name, profile in {"cut": matrix_profile(P3_D50)[:200], "noise": b"anything"}.items():
        Image.fromarray(pixels).save(tmp_path / f"{name}.png", icc_profile=profile)
        np.testing.assert_array_equal(read_pixels(tmp_path / f"{name}.png"), pixels)
        assert f"the colour profile of {tmp_path / name}.png is broken" in capsys.readouterr().err


def test_a_grey_picture_of_any_profile_keeps_its_levels(tmp_path: Path) -> None:
    grey = np.arange(192, dtype=np.uint8).reshape(12, 16)
    Image.fromarray(grey).save(tmp_path / "a.png", icc_profile=matrix_profile(P3_D50, gamma=1.8))
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png")[..., 0], grey)


def test_opaque_alpha_channel_is_no_alpha(tmp_path: Path) -> None:
    Image.new("RGBA", (4, 4), (9, 8, 7, 255)).save(tmp_path / "a.png")
    assert load_view(Photo(tmp_path / "a.png", camera(4, 4), "a")).alpha is None


@pytest.mark.parametrize(("mode", "value", "expected"), [("L", 77, 77), ("I;16", 257 * 77, 77), ("P", 5, None), ("1", 1, 255)])
def test_kinds_of_pixels(tmp_path: Path, mode: str, value: int, expected: int | None) -> None:
    image = Image.new(mode, (3, 2), value)
    if mode == "P":
        image.putpalette([0] * 15 + [10, 20, 30])
    image.save(tmp_path / "a.png")
    pixels = read_pixels(tmp_path / "a.png")
    assert pixels.shape == (2, 3, 3)
    assert pixels[0, 0].tolist() == ([10, 20, 30] if expected is None else [expected] * 3)


def test_floating_point_pixels_are_refused(tmp_path: Path) -> None:
    """Nothing says whether white is 1, 255 or 65535, or whether light is linear."""
    Image.fromarray(np.full((4, 4), 0.5, np.float32)).save(tmp_path / "a.tif")
    for read in (read_pixels, image_size):
        with pytest.raises(InputError, match=r"a\.tif has floating-point pixels, whose range is not known\.\nConvert it to 8"):
            read(tmp_path / "a.tif")


def test_exif_orientation_is_applied_unless_the_camera_contradicts(tmp_path: Path) -> None:
    picture = Image.fromarray(np.arange(6, dtype=np.uint8).reshape(2, 3) * 40)
    exif = picture.getexif()
    exif[0x0112] = 6  # the camera was held upright: rotate by 90 degrees clockwise
    path = tmp_path / "a.png"
    picture.save(path, exif=exif)
    assert image_size(path) == (2, 3)
    assert read_pixels(path)[:, :, 0].tolist() == [[120, 0], [160, 40], [200, 80]]
    assert image_size(path, like=(300, 200)) == (3, 2), "calibrated on the pixels as they are stored"
    assert read_pixels(path, like=(300, 200)).shape == (2, 3, 3)
    assert image_size(path, like=(200, 300)) == (2, 3)


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_calibrated_pixels_are_taken_as_stored(tmp_path: Path, orientation: int, suffix: str) -> None:
    """As COLMAP reads them, whatever EXIF says; without a camera they are upright, as Pillow turns them."""
    import pycolmap

    rng, path = np.random.default_rng(0), tmp_path / f"a.{suffix}"
    for size in ((6, 6), (8, 6)):
        picture = Image.fromarray(rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8))
        exif = picture.getexif()
        exif[0x0112] = orientation
        picture.save(path, exif=exif)
        assert image_size(path, like=size) == size
        np.testing.assert_array_equal(read_pixels(path, like=size), pycolmap.Bitmap.read(str(path), True).to_array())
        np.testing.assert_array_equal(read_pixels(path), np.asarray(ImageOps.exif_transpose(Image.open(path))))


WRONG_TAGS = {
    "no other tag": [],
    "XResolution as text": [(0x011A, 2, 4, b"72\0\0")],
    "ImageWidth negative": [(0x0100, 9, 1, struct.pack("<l", -1))],
    "ImageHeight as a signed short": [(0x0101, 8, 1, struct.pack("<hh", -5, 0))],
    "BitsPerSample as a signed byte": [(0x0102, 6, 1, b"\xff\0\0\0")],
    "an EXIF folder as text": [(0x8769, 2, 4, b"abc\0")],
    "an EXIF folder beyond the end": [(0x8769, 4, 1, struct.pack("<L", 99999))],
    "GPS that points to itself": [(0x8825, 4, 1, struct.pack("<L", 8))],
    "an unknown type": [(0x9999, 99, 1, bytes(4))],
    "a count beyond the end": [(0x9999, 3, 0x7FFFFFFF, bytes(4))],
}


def jpeg_with_tags(picture: np.ndarray, tags: list[tuple[int, int, int, bytes]]) -> bytes:
    """A JPEG file with an EXIF segment of these entries: tag, type, count, value."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "JPEG", quality=95)
    plain = stream.getvalue()
    entries = b"".join(struct.pack("<HHL", tag, kind, count) + value for tag, kind, count, value in tags)
    exif = b"Exif\0\0II*\0" + struct.pack("<LH", 8, len(tags)) + entries + bytes(4)
    return plain[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + plain[2:]


@pytest.mark.parametrize("tags", WRONG_TAGS.values(), ids=WRONG_TAGS)
def test_tags_of_wrong_types_do_not_keep_a_photograph_from_being_turned(tmp_path: Path, tags: list) -> None:
    """Of all EXIF only the orientation counts."""
    picture = np.zeros((16, 32, 3), np.uint8)
    picture[:8, :16] = 255  # the upper left quarter
    turn = (0x0112, 3, 1, struct.pack("<HH", 6, 0))  # by 90 degrees clockwise: the upper right one
    (tmp_path / "a.jpg").write_bytes(jpeg_with_tags(picture, [turn, *tags]))
    assert image_size(tmp_path / "a.jpg") == (16, 32)
    expected = np.rot90(picture, -1).astype(int)
    assert np.abs(read_pixels(tmp_path / "a.jpg").astype(int) - expected).max() < 8


def test_an_orientation_that_is_no_number_is_none(tmp_path: Path) -> None:
    picture = np.zeros((16, 32, 3), np.uint8)
    (tmp_path / "a.jpg").write_bytes(jpeg_with_tags(picture, [(0x0112, 2, 4, b"6\0\0\0")]))
    assert image_size(tmp_path / "a.jpg") == (32, 16)
    assert read_pixels(tmp_path / "a.jpg").shape == (16, 32, 3)


@pytest.mark.parametrize("error", [TypeError, KeyError, OverflowError, struct.error])
def test_whatever_pillow_raises_about_tags_is_a_sentence(tmp_path: Path, monkeypatch, error: type[Exception]) -> None:
    def fail(image):
        raise error("wrong tag")

    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    monkeypatch.setattr(Image.Image, "getexif", fail)
    monkeypatch.setattr("PIL.PngImagePlugin.PngImageFile.getexif", fail)
    for read in (read_pixels, image_size):
        with pytest.raises(InputError, match=r"a\.png is damaged \(4x4\): '?wrong tag"):
            read(tmp_path / "a.png")


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("suffix", ["tif", "jpg", "png", "webp"])
def test_every_format_is_turned_once(tmp_path: Path, suffix: str, orientation: int) -> None:
    """The upper left quarter is white as stored; sizes and pixels agree with each other, upright and stored."""
    stored = np.zeros((16, 32, 3), np.uint8)
    stored[:8, :16] = 255
    quarters = {1: 0, 3: 2, 6: -1, 8: 1}[orientation]  # anticlockwise, as numpy turns
    upright = np.rot90(stored, quarters)
    path, exif = tmp_path / f"a.{suffix}", Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored).save(path, exif=exif, **{"webp": {"lossless": True}, "jpg": {"quality": 95}}.get(suffix, {}))

    def same(pixels: np.ndarray, expected: np.ndarray) -> bool:
        return pixels.shape == expected.shape and np.abs(pixels.astype(int) - expected).max() < 8

    assert stored_size(path) == image_size(path, like=(64, 32)) == (32, 16)
    assert image_size(path) == upright.shape[1::-1]
    assert same(read_pixels(path), upright)
    assert same(read_pixels(path, like=(64, 32)), stored), "the camera has the stored shape"
    turned = orientation in (6, 8)
    assert image_size(path, like=(32, 64)) == ((16, 32) if turned else (32, 16))
    assert same(read_pixels(path, like=(32, 64)), upright if turned else stored)


def test_truncated_png_is_named(tmp_path: Path) -> None:
    path = tmp_path / "cut.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(InputError, match=r"cut\.png is damaged"):
        read_pixels(path)
    with pytest.raises(InputError, match=r"cut\.png is damaged"):
        image_size(path)
    path.write_bytes(b"not a picture")
    with pytest.raises(InputError, match=r"cut\.png cannot be read as a picture"):
        read_pixels(path)
    with pytest.raises(InputError, match=r"gone\.png does not exist"):
        read_pixels(tmp_path / "gone.png")


def test_a_picture_of_too_many_pixels_is_no_damaged_file(tmp_path: Path) -> None:
    """A phone's 200 megapixels, of which the header is enough."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 16320, 12240, 8, 2, 0, 0, 0))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", b"x") + chunk(b"IEND", b""))
    for read in (read_pixels, image_size):
        with pytest.raises(
            InputError, match=r"a\.png has 200 million pixels; no more than 179 million are read\.\nMake it smaller"
        ):
            read(tmp_path / "a.png")


def test_shadow_files_of_macos_are_no_photographs(tmp_path: Path) -> None:
    for name in ("b.JPG", "._b.JPG", "a.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in image_files(tmp_path)] == ["a.png", "b.JPG"]


def test_wanted_size() -> None:
    assert wanted_size(1080, 1920, 480) == (270, 480)
    assert wanted_size(100, 50, 480) == (100, 50), "never enlarged"
    assert wanted_size(1080, 1920, (270, 480)) == (270, 480)
    assert wanted_size(1080, 1920, None) == (1080, 1920)
    with pytest.raises(InputError, match="squash"):
        wanted_size(1080, 1920, (480, 270))
    with pytest.raises(InputError, match="larger"):
        wanted_size(100, 50, (200, 100))


def test_scaled_copies_keep_their_calibration(tmp_path: Path) -> None:
    lens = Lens("OPENCV", (100.0, 110.0, 40.0, 30.0, 0.1, 0.0, 0.0, 0.0), 80, 60)
    photos = []
    for name in "ab":
        Image.new("RGB", (40, 30)).save(tmp_path / f"{name}.png")
        photos.append(Photo(tmp_path / f"{name}.png", camera(80, 60), name, lens))
    small = match_sizes(photos)[0]
    assert (small.camera.width, small.camera.height) == (40, 30)
    assert small.camera.focal.tolist() == [50.0, 55.0]
    assert small.lens == Lens("OPENCV", (50.0, 55.0, 20.0, 15.0, 0.1, 0.0, 0.0, 0.0), 40, 30)
    Image.new("RGB", (80, 60)).save(tmp_path / "b.png")
    with pytest.raises(InputError, match=r"b\.png has 80x60 pixels, which is scaled unlike a\.png"):
        match_sizes(photos)
    Image.new("RGB", (50, 30)).save(tmp_path / "b.png")
    with pytest.raises(InputError, match=r"b\.png has 50x30 pixels, its camera says 80x60"):
        match_sizes(photos)


def test_images_of_different_cameras_may_differ_in_size(tmp_path: Path) -> None:
    photos = []
    for name, size in (("a", (40, 30)), ("b", (32, 32))):
        Image.new("RGB", size).save(tmp_path / f"{name}.png")
        photos.append(Photo(tmp_path / f"{name}.png", camera(*size), name))
    assert [photo.camera.width for photo in match_sizes(photos)] == [40, 32]


@pytest.mark.parametrize(
    "lens",
    [
        Lens("OPENCV", (120.0, 125.0, 83.0, 58.0, 0.1, -0.05, 0.004, -0.003), 160, 120),
        Lens("OPENCV", (120.0, 125.0, 75.0, 63.0, -0.2, 0.05, 0.0, 0.0), 160, 120),
        Lens("OPENCV_FISHEYE", (60.0, 60.0, 80.0, 60.0, 0.02, 0.0, 0.0, 0.0), 160, 120),
        Lens("OPENCV_FISHEYE", (30.0, 30.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0), 160, 120),  # beyond 180 degrees
    ],
)
def test_no_blank_pixel_and_little_lost(lens: Lens) -> None:
    straight = straighten(lens)
    assert float(straight.grid.abs().max()) <= 1.0
    assert straight.focal[0] / straight.focal[1] == pytest.approx(lens.params[0] / lens.params[1])
    if lens.model == "OPENCV":
        assert float(straight.grid.abs().max()) > 0.98, "the viewport touches the photograph's border"


def test_identity_lens_changes_nothing() -> None:
    picture = np.random.default_rng(0).random((60, 80, 3)).astype(np.float32)
    straight = straighten(Lens("FULL_OPENCV", (90.0, 90.0, 41.0, 29.0, *[0.0] * 8), 80, 60))
    # The viewport leaves out half a pixel of border, hence a zoom of 1/80.
    assert straight.focal[0] == pytest.approx(90 * 60 / 59, rel=1e-6)
    flat = np.full_like(picture, 0.25)
    np.testing.assert_allclose(undistort(flat, straight), flat, atol=1e-6)


def test_unknown_lens_is_refused() -> None:
    with pytest.raises(InputError, match="'GLASS' is not a known camera model"):
        Lens("GLASS", (1.0,), 8, 8).colmap()
    with pytest.raises(InputError, match="3 parameters"):
        Lens("OPENCV", (1.0, 2.0, 3.0), 8, 8).colmap()


def test_mask_file_of_another_size_is_refused(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    Image.new("L", (8, 4)).save(tmp_path / "m.png")
    photo = Photo(tmp_path / "a.png", camera(8, 8), "a")
    with pytest.raises(InputError, match=r"m\.png has 8x4 pixels, its photograph has 8x8"):
        load_view(replace(photo, alpha=tmp_path / "m.png"))


MEMORY = """
import resource, sys
from pathlib import Path
import torch, pycolmap, PIL.Image, PIL.ImageOps
from invgraphics.scenes.layout import SceneOptions
from invgraphics.scenes.nerfstudio import Nerfstudio
torch.set_num_threads(1)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for size in (250, None):
    scene = Nerfstudio().load(Path(sys.argv[1]), SceneOptions(test_views=None, size=size))
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


def test_only_final_pixels_are_kept_in_memory(tmp_path: Path) -> None:
    """30 distorted photographs of 1 MP: 6 MB of bytes at a quarter, 90 MB at full size, and one picture's work space."""
    noise = np.random.default_rng(0).integers(0, 255, (1000, 1000, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "0.jpg", quality=50)
    frames = []
    for index in range(30):
        if index:
            (tmp_path / f"{index}.jpg").symlink_to(tmp_path / "0.jpg")
        pose = np.eye(4)
        pose[0, 3] = index
        frames.append({"file_path": f"{index}.jpg", "transform_matrix": pose.tolist()})
    table = {"fl_x": 900.0, "k1": 0.05, "w": 1000, "h": 1000, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    done = subprocess.run([sys.executable, "-c", MEMORY, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    small, full = (float(megabytes) for megabytes in done.stdout.split())
    assert small < 150
    assert full < 240


def test_no_flipped_bit_of_a_png_passes(tmp_path: Path) -> None:
    """Pillow alone decodes every sixteenth of them to another picture."""
    rng = np.random.default_rng(0)
    picture = (np.linspace(0, 200, 40)[None, :, None] + rng.integers(0, 20, (30, 40, 3))).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "a.png")
    good = (tmp_path / "a.png").read_bytes()
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png"), picture)
    for bit in rng.permutation(8 * len(good))[:500]:
        data = bytearray(good)
        data[bit // 8] ^= 1 << bit % 8
        (tmp_path / "a.png").write_bytes(data)
        with pytest.raises(InputError, match=r"a\.png"):
            read_pixels(tmp_path / "a.png")


def test_a_png_without_its_end_is_cut_off(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:-12])
    with pytest.raises(InputError, match="its end is missing"):
        read_pixels(tmp_path / "a.png")
